# SPDX-License-Identifier: MIT
"""How one model is healed, against a Triton that is a list of what it was asked to do."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any

import pytest

from clock import Clock
from rfm.launch.repository_api import ModelVersion, RepositoryApiError
from rfm.supervise import back_off, background, model_reload, model_watch
from rfm.supervise.model_reload import OwedAnswersError
from rfm.supervise.model_states import Event, State
from rfm.supervise.model_watch import RETRY_S, ModelWatch
from rfm.supervise.status import NO_REASON, Status
from rfm_serve import MODEL

CONFIG = {"name": MODEL, "of": 1}
LOADED, UNLOADED = ("READY", ""), ("UNAVAILABLE", "unloaded")


class Triton:
    """Its repository API, with one model. while_loading: what happens within a load"""

    def __init__(self, state: tuple[str, str] = LOADED) -> None:
        self.asked: list[str] = []
        self.while_loading: Callable[[], object] = lambda: None
        self.be(*state)

    def be(self, state: str, reason: str = "", version: int = 1) -> None:
        self.entry = ModelVersion(MODEL, version, state, reason)

    def __enter__(self) -> Triton:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def index(self) -> list[ModelVersion]:
        return [self.entry]

    def config(self, model: str, version: int) -> dict[str, Any]:
        return {"name": model, "of": version}

    def unload(self, model: str) -> None:
        self.asked.append("unload")
        self.be(*UNLOADED)

    def load(self, model: str, config: Mapping[str, Any]) -> None:
        self.asked.append(f"load {config['of']}")
        self.while_loading()
        self.be(*LOADED)


class Process:
    """A process of the model that ends when it is killed. num_owed: answers that it still owes then"""

    def __init__(self, num_owed: int = 0) -> None:
        self.is_alive, self.is_blamed = True, True
        self.journal = SimpleNamespace(close=lambda: setattr(self, "is_blamed", False), num_owed=num_owed)

    def kill(self) -> None:
        self.is_alive = False


class Bench:
    """A model under test: its clock, its Triton, its probe's next answer, and what is known of its processes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, is_probed: bool = True) -> None:
        self.clock, self.triton, self.status = Clock(), Triton(), Status()
        self.said: list[str] = []
        self.processes: list[Process] = []
        self.num_owed = 0  # by processes that do not run
        self.forgotten: list[Process] = []
        self.probed: Event | None = None
        self.is_getting_on = False
        self.renewed = 0
        for module in (back_off, model_watch, model_reload):
            monkeypatch.setattr(module, "time", self.clock)
        monkeypatch.setattr(background, "in_background", at_once)
        probe = SimpleNamespace(look=lambda: self.probed, renew=self.renew)
        processes = SimpleNamespace(
            of_model=lambda _: list(self.processes),
            num_owed=lambda _: self.num_owed,
            forget=self.forgotten.extend,
            is_getting_on=lambda _: self.is_getting_on,
        )
        server = SimpleNamespace(repository_api=lambda: self.triton)
        given = probe if is_probed else None
        self.model = ModelWatch(MODEL, given, server, processes, self.status, self.said.append)  # type: ignore[arg-type]

    def renew(self) -> None:
        self.renewed += 1

    def look(self, probed: Event | None = None, died: str | None = None) -> str | None:
        self.probed = probed
        return self.model.look(died, CONFIG)

    def wait(self, duration_s: float) -> None:
        """Time passes, and the model is looked at often enough."""
        self.clock.now_s += duration_s
        for _ in range(4):
            self.look()

    @property
    def is_probe_ok(self) -> bool:
        return f'rfm_serve_canary_ok{{model="{MODEL}"}} 1.0' in self.status.metrics().decode()


def at_once(_: str, call: Callable[[], None]) -> Future[None]:
    """A call that has ended when it has begun."""
    future: Future[None] = Future()
    try:
        future.set_result(call())
    except (RepositoryApiError, OwedAnswersError, LookupError) as error:
        future.set_exception(error)
    return future


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


def damaged() -> None:
    raise RepositoryApiError("the weights are damaged")


def test_readiness_follows_the_probe(bench: Bench) -> None:
    said = []
    for event in (None, Event.LATE, Event.ANSWERED, Event.LATE, Event.ABSENT):
        assert bench.look(event) is None
        said.append((bench.model.reason, bench.is_probe_ok))
    assert said == [
        ("it was not probed yet", False),
        ("it gives no answer in time", False),
        (NO_REASON, True),
        (NO_REASON, False),
        ("it is not loaded", False),
    ]
    assert bench.triton.asked == []


@pytest.mark.parametrize("probed", [Event.LATE, Event.HUNG])
def test_who_works_on_a_batch_that_gets_on_is_ready(bench: Bench, probed: Event) -> None:
    bench.is_getting_on = True
    assert bench.look(probed) is None
    assert (bench.model.reason, bench.is_probe_ok) == (NO_REASON, False)


@pytest.mark.parametrize("fault", [Event.HUNG, Event.DEAD, Event.BROKEN])
def test_a_fault_is_healed_at_once(bench: Bench, fault: Event) -> None:
    bench.look(Event.ANSWERED)
    bench.processes = [Process()]
    assert bench.look(fault) == fault.value
    assert (bench.model.is_healing, bench.model.reason, bench.is_probe_ok) == (True, "it is loaded anew", False)
    assert bench.triton.asked == ["unload", "load 1"]
    assert bench.look(fault) is None  # of the old processes
    assert (bench.model.state, bench.forgotten, bench.renewed) == (State.NEW, bench.processes, 1)
    assert [process.is_alive for process in bench.processes] == [False]
    assert bench.clock.now_s == pytest.approx(2.0)  # they had this time
    # What a process worked on is to blame if it hung, and not if it was killed for another's fault.
    assert bench.processes[0].is_blamed is (fault is Event.HUNG)


@pytest.mark.parametrize("event", [Event.HUNG, Event.BROKEN])
def test_processes_that_end_owing_answers_are_told_of_and_the_model_stays_out(bench: Bench, event: Event) -> None:
    bench.processes = [Process(num_owed=2), Process(), Process(num_owed=3)]
    bench.look(event)
    bench.look()
    assert bench.model.owing == f"processes of {MODEL} have ended, and owe 5 answers"
    assert [process.is_alive for process in bench.processes] == [False, False, False]
    assert (bench.triton.asked, bench.forgotten) == (["unload"], bench.processes)
    assert bench.model.reason == f"it is loaded anew, after: {bench.model.owing}"


def test_who_owes_answers_and_does_not_run_is_left_to_the_restart_of_triton(bench: Bench) -> None:
    bench.look(Event.ANSWERED)
    bench.num_owed = 3
    assert bench.look(Event.BROKEN) is None  # one fault is one restart
    assert (bench.model.owing, bench.triton.asked) == (f"processes of {MODEL} do not run, and owe 3 answers", [])
    assert not bench.is_probe_ok


def test_a_process_that_has_died_says_how(bench: Bench) -> None:
    assert bench.look(Event.ANSWERED, died="stopped for 3 s") == "stopped for 3 s"


def test_processes_that_have_ended_are_not_waited_for(bench: Bench) -> None:
    bench.processes = [Process()]
    bench.processes[0].kill()
    bench.look(died="its process is dead")
    assert (bench.clock.now_s, bench.processes[0].is_blamed) == (0.0, True)


def test_what_fails_is_tried_again_after_longer_and_longer_pauses_and_then_seldom(bench: Bench) -> None:
    bench.triton.while_loading = damaged
    bench.look(Event.ANSWERED)
    bench.look(died="its process is dead")
    tried = []
    for pause_s in (0.5, 1.0, 2.0, 4.0):
        bench.wait(0.0)
        assert bench.model.reason == "it is loaded anew, after: the weights are damaged"
        bench.wait(pause_s - 0.01)
        tried.append(bench.triton.asked.count("load 1"))
        bench.wait(0.01)
    assert tried == [1, 2, 3, 4]
    wanted = "model rfm: expected to run, got 6 ends, each within 60 s of a start; the last: the weights are damaged"
    assert bench.said == [f"{wanted}; it is not ready, and tried again every 5 minutes"]
    assert bench.model.state is State.GIVEN_UP
    assert bench.model.reason == "it is loaded anew every 5 minutes, after: the weights are damaged"
    bench.wait(RETRY_S - 0.01)
    assert bench.triton.asked.count("load 1") == 5
    bench.wait(0.01)
    assert bench.triton.asked.count("load 1") == 6
    assert (len(bench.said), bench.model.state) == (1, State.GIVEN_UP)
    bench.triton.while_loading = lambda: None
    bench.wait(RETRY_S)
    bench.look(Event.ANSWERED)
    assert bench.model.reason == NO_REASON
    assert bench.triton.asked.count("unload") == 1


def test_what_dies_again_and_again_is_taken_out_and_loaded_by_somebody(bench: Bench) -> None:
    for _ in range(back_off.MOST):
        bench.look(died="its process is dead")
        bench.wait(back_off.LONGEST_PAUSE_S)
        assert bench.model.state is State.NEW
    bench.look(died="its process is dead")
    bench.wait(0.0)
    assert bench.model.reason == "it is loaded anew every 5 minutes, after: its process is dead"
    assert bench.triton.asked[-1] == "unload"  # so that nobody waits for it
    out_s = bench.clock.now_s
    bench.triton.be("READY", version=2)
    bench.model.record_ready(out_s)  # the request is older, or as old
    bench.look()
    assert bench.model.state is State.GIVEN_UP
    bench.model.record_ready(out_s + 1.0)
    bench.look()
    assert bench.model.state is State.NEW
    assert bench.triton.asked[-1] == "unload"


def test_the_version_that_is_served_is_loaded_and_not_what_was_known(bench: Bench) -> None:
    bench.triton.be("READY", version=3)
    bench.look(died="its process is dead")
    assert bench.triton.asked == ["unload", "load 3"]


def test_what_was_served_is_loaded_also_where_it_cannot_be_read_any_more(bench: Bench) -> None:
    bench.triton.be("UNAVAILABLE", "its process is dead")
    bench.look(died="its process is dead")
    assert bench.triton.asked == ["unload", "load 1"]


def test_what_somebody_has_unloaded_stays_so(bench: Bench) -> None:
    bench.triton.be(*UNLOADED)
    assert bench.look(died="its process is dead") is not None
    bench.wait(0.0)
    assert (bench.triton.asked, bench.model.is_healing) == ([], False)


def test_what_somebody_has_loaded_meanwhile_stays(bench: Bench) -> None:
    def somebody_loads() -> None:
        bench.triton.be("READY", version=2)
        damaged()

    bench.triton.while_loading = somebody_loads
    bench.look(died="its process is dead")
    bench.wait(0.0)
    bench.wait(1.0)
    assert (bench.triton.asked, bench.model.state) == (["unload", "load 1"], State.NEW)


def test_what_somebody_loads_while_processes_end_stays(bench: Bench) -> None:
    bench.processes = [Process()]
    sleep = bench.clock.sleep

    def somebody_loads(duration_s: float) -> None:
        sleep(duration_s)
        state = "READY" if bench.clock.now_s > 60.0 else "LOADING"  # it takes longer than the processes
        bench.triton.be(state, version=2)

    bench.clock.sleep = somebody_loads  # type: ignore[method-assign]
    bench.look(died="its process is dead")
    bench.wait(0.0)
    assert (bench.triton.asked, bench.triton.entry.version, bench.model.state) == (["unload"], 2, State.NEW)
    assert not bench.processes[0].is_alive


def test_what_was_served_is_loaded_where_the_load_of_somebody_fails(bench: Bench) -> None:
    bench.processes = [Process()]
    sleep = bench.clock.sleep

    def somebody_loads(duration_s: float) -> None:
        sleep(duration_s)
        bench.triton.be(*(("UNAVAILABLE", "its weights are damaged") if bench.clock.now_s > 60.0 else ("LOADING", "")))

    bench.clock.sleep = somebody_loads  # type: ignore[method-assign]
    bench.look(died="its process is dead")
    assert bench.triton.asked == ["unload", "load 1"]


def test_what_is_closed_changes_nothing_more(bench: Bench) -> None:
    unload = bench.triton.unload
    bench.triton.unload = lambda model: (unload(model), bench.model.close())  # type: ignore[method-assign,assignment,func-returns-value]
    bench.look(died="its process is dead")
    assert bench.triton.asked == ["unload"]  # what is loaded next may be another Triton's


def test_a_model_is_restored_into_a_new_triton(bench: Bench) -> None:
    bench.triton.be(*UNLOADED)
    bench.model.restore(CONFIG)
    bench.wait(0.0)
    assert (bench.triton.asked, bench.model.state) == (["load 1"], State.NEW)


def test_an_ensemble_is_restored_once_and_ready_when_triton_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, is_probed=False)
    bench.triton.be(*UNLOADED)
    assert bench.look() is None
    assert bench.model.state is State.WAITING
    bench.model.restore(CONFIG)
    bench.wait(0.0)
    assert (bench.triton.asked, bench.model.state) == (["load 1"], State.NEW)
    bench.model.record_ready(bench.clock.now_s)
    assert bench.model.state is State.READY


def test_a_load_that_fails_unexpectedly_is_logged(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    bench.triton.while_loading = lambda: [].pop()
    bench.look(died="its process is dead")
    bench.wait(0.0)
    assert caplog.messages == [f"rfm-heal-{MODEL}: an unexpected error"]
    assert bench.model.reason == "it is loaded anew, after: pop from empty list"
    bench.triton.while_loading = damaged
    bench.wait(0.5)
    assert bench.model.reason == "it is loaded anew, after: the weights are damaged"
    assert len(caplog.messages) == 1
