# SPDX-License-Identifier: MIT
"""What the supervisor does about each fault, with a stand-in for Triton and real model processes."""

from __future__ import annotations

import logging
import os
import re
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest

import stand_in_triton
from commands import running_models
from rfm.serve import probe, processes, status, supervisor, triton_server, watch
from rfm.serve.processes import LOADING_DEAD_S, UNKNOWN, ModelProcesses
from rfm.serve.repository_api import versions_of
from rfm.serve.status import NO_REASON, Status, StatusServer
from rfm.serve.supervisor import MOST, STEADY_S, CrashLoopError, FaultCount, GatewayProcess, Supervisor
from rfm.serve.triton_server import TritonServer
from servers import Endpoints, Serving, wait_for

SILENT_S, HANG_S = 1.5, 1.5


@pytest.fixture(autouse=True)
def _in_a_hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name, value in (
        (supervisor, "POLL_S", 0.01),
        (supervisor, "time", SimpleNamespace(monotonic=time.monotonic, sleep=time.sleep)),
        (watch, "LOOK_S", 0.02),
        (probe, "BROKEN_S", 0.1),
        (triton_server, "POLL_S", 0.02),
    ):
        monkeypatch.setattr(module, name, value)


@dataclass(frozen=True)
class Supervised:
    """A stand-in below a supervisor, which runs in a thread."""

    server: TritonServer
    serving: Serving
    ended: Future[None]

    @property
    def repository(self) -> Path:
        return self.server.repository

    def file(self, name: str) -> Path:
        """A file that changes what the stand-in does."""
        return self.repository.parent / name

    def signal(self, number: signal.Signals, model: str = "") -> None:
        """Send a signal to Triton, or to a model's process."""
        for pid in running_models(self.repository, model) if model else [self.server.pid]:
            os.kill(pid, number)


@contextmanager
def supervised(folder: Path, *models: str) -> Iterator[Supervised]:
    repository, program = stand_in_triton.repository(folder, *models), stand_in_triton.installation(folder)
    server = TritonServer(repository, Endpoints.free(), program, hang_s=HANG_S)  # type: ignore[arg-type]
    status_port = Endpoints.free().http_port
    watched = Supervisor(server, status_port=status_port, probe_s=0.05, triton_silent_s=SILENT_S)
    handlers: list[Callable[..., None]] = []

    def take(handler: Callable[..., None]) -> Any:
        handlers.append(handler)
        return nullcontext()

    with pytest.MonkeyPatch.context() as patched, ThreadPoolExecutor(1) as thread:
        patched.setattr(supervisor, "stop_signals_to", take)  # which only a main thread can take
        ended = thread.submit(watched.run)
        process: Any = SimpleNamespace(poll=lambda: ended.done() or None)
        serving = Serving(process, server.endpoints, f"http://127.0.0.1:{status_port}", folder / "log")
        try:
            serving.wait_ready()
            yield Supervised(server, serving, ended)
        finally:
            for handler in handlers:
                handler(signal.SIGTERM, None)
    if not isinstance(ended.exception(), CrashLoopError):
        ended.result()


def stand_still(stage: Supervised) -> None:
    """Put the supervisor's clock forward while it waits, as a pause of all processes does."""
    for _ in range(20):  # it may not wait at that moment
        before = supervisor.time.monotonic
        supervisor.time.monotonic = lambda before=before: before() + 20
        with suppress(AssertionError):
            wait_for(lambda: stage.serving.restarts("triton"), 0.3)
            return


Act = Callable[[Supervised], None]
FAULTS: dict[str, tuple[Act, str, str]] = {
    "a process dies": (
        lambda s: s.signal(signal.SIGKILL, "a"),
        "a",
        r"a: its process \d+ is dead \(killed by SIGKILL\)",
    ),
    "a process stops": (lambda s: s.signal(signal.SIGSTOP, "a"), "a", r"a: its process \d+ is stopped"),
    "triton dies": (lambda s: s.signal(signal.SIGKILL), "triton", "killed by SIGKILL"),
    "all stand still": (stand_still, "triton", "all processes stood still for 20 s"),
    "requests fail": (lambda s: s.file("fails").touch(), "a", "a: it has failed at 3 probes in a row"),
    "triton is silent": (lambda s: s.signal(signal.SIGSTOP), "triton", f"no answer for {SILENT_S:g} s"),
    "requests hang": (lambda s: s.file("hangs").touch(), "a", f"a: it has answered nothing for {HANG_S:g} s"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_triton_is_started_again_after_each_fault(tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str) -> None:
    act, what, why = FAULTS[name]
    caplog.set_level("INFO")
    with supervised(tmp_path, "a") as stage:
        before = stage.server.pid
        assert stage.serving.restarts(what) == 0
        act(stage)
        stage.serving.wait_ready(False)
        for file in ("fails", "hangs"):
            stage.file(file).unlink(missing_ok=True)
        wait_for(lambda: stage.serving.restarts(what) == 1)
        stage.serving.wait_ready()
        assert stage.serving.reasons() == {"a": NO_REASON}
        assert stage.server.pid != before
    (line,) = [line for line in caplog.messages if line.startswith("triton is started again")]
    assert re.fullmatch(rf"triton is started again: {why}; all models load, which took \d+ s last time", line)
    assert [message.startswith("ready again after ") for message in caplog.messages].count(True) == 1


@pytest.mark.slow
def test_a_model_that_works_on_long_requests_is_not_started_again(tmp_path: Path) -> None:
    with supervised(tmp_path, "a") as stage:
        stage.file("busy").touch()
        stage.file("hangs").touch()
        ends_s = time.monotonic() + 1.5 * HANG_S
        wait_for(lambda: time.monotonic() > ends_s)
        stage.file("hangs").unlink()
        assert stage.serving.restarts("a", "triton") == 0


def test_faults_in_a_row_end_the_supervisor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervisor, "MOST", 1)
    with supervised(tmp_path, "a") as stage:
        stage.signal(signal.SIGKILL)
        wait_for(lambda: stage.serving.restarts("triton") == 1)
        stage.serving.wait_ready()
        assert httpx.get(f"{stage.serving.status_url}/live").status_code == 200
        assert httpx.get(f"{stage.serving.status_url}/other").status_code == 404
        stage.file("deadly-a").touch()
        last = r"a: its process \d+ is dead"
        wanted = f"^triton: expected to run, got 2 faults in a row; the last: {last}$"
        with pytest.raises(CrashLoopError, match=wanted):
            stage.ended.result()


class Stubs(ModelProcesses):
    """Model processes in these states."""

    def __init__(self) -> None:
        super().__init__(0)
        self.states: dict[int, tuple[str, str]] = {}  # model and state by process

    def _states(self) -> dict[int, str]:
        self._models = {pid: model for pid, (model, _) in self.states.items()}
        return {pid: state for pid, (_, state) in self.states.items()}


ALIVE, DEAD, STOPPED = ("a", "sleeping"), ("a", "zombie"), ("a", "stopped")
NEVER = None
PROCESSES: dict[str, tuple[list[tuple[str, str]], dict[str, int] | None, bool, float | None]] = {
    # processes, wanted ones, does no model load, seconds until the fault counts
    "dead": ([DEAD], {"a": 1}, True, 0),
    "stopped": ([STOPPED], {"a": 1}, True, 0),
    "one of two is dead": ([ALIVE, DEAD], {"a": 2}, True, 0),
    "one of two is stopped": ([ALIVE, STOPPED], {"a": 2}, True, 0),
    "replaced": ([DEAD, ALIVE], {"a": 1}, True, NEVER),
    "replaced while another model loads": ([DEAD, ALIVE], {"a": 1}, False, NEVER),
    "dead after a failed load": ([DEAD], {"a": 0}, True, NEVER),
    "dead while another model loads": ([DEAD], {"a": 1}, False, LOADING_DEAD_S),
    "dead while its model loads": ([ALIVE, DEAD], {}, False, LOADING_DEAD_S),
    "dead in a start": ([DEAD], None, False, LOADING_DEAD_S),
    "dead before it was seen": ([ALIVE, (UNKNOWN, "zombie")], {"a": 1}, True, 0),
}


@pytest.mark.parametrize("name", PROCESSES)
def test_a_dead_process_counts_unless_it_was_replaced(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    states, wanted, is_settled, counts_s = PROCESSES[name]
    now_s = 0.0
    monkeypatch.setattr(processes, "time", SimpleNamespace(monotonic=lambda: now_s))
    stubs = Stubs()
    stubs.states = dict(enumerate(states))
    for now_s in (0.0, 0.1, LOADING_DEAD_S - 0.1, LOADING_DEAD_S, 100.0):
        found = stubs.fault(wanted, is_settled=is_settled)
        assert (found is not None) == (counts_s is not None and now_s > 0 and now_s >= counts_s)
    stubs.states = {9: ALIVE}
    assert stubs.fault(wanted, is_settled=is_settled) is None


@pytest.mark.slow
def test_a_fault_of_a_load_counts_for_the_model_that_loads_and_is_part_of_no_crash_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "MOST", 1)
    monkeypatch.setattr(processes, "LOADING_DEAD_S", 0.2)
    with supervised(tmp_path, "a", "b") as stage:
        for number in (1, 2):
            stage.file("loading-b").touch()
            wait_for(lambda: "b" in stage.serving.reasons())
            stage.signal(signal.SIGKILL, "b")
            wait_for(lambda number=number: stage.serving.restarts("b") == number)
            stage.file("loading-b").unlink()
            stage.serving.wait_ready()
        assert stage.serving.restarts("a", "triton") == 0


@pytest.mark.slow
def test_a_restart_serves_the_same_models_and_versions_and_no_newer_export(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Also what was loaded, and not what was unloaded, and the log tells both."""
    caplog.set_level(logging.INFO)
    with supervised(tmp_path, "a", "b") as stage:
        stand_in_triton.repository(tmp_path, "c")
        httpx.post(f"{stage.serving.endpoints.http_url}/v2/repository/models/c/load")
        httpx.post(f"{stage.serving.endpoints.http_url}/v2/repository/models/b/unload")
        wait_for(lambda: stage.serving.reasons() == {"a": NO_REASON, "c": NO_REASON})
        config = stage.repository / "a" / "config.pbtxt"
        config.write_text(config.read_text().replace("versions: 1", "versions: 2"))
        stage.signal(signal.SIGKILL)
        wait_for(lambda: stage.serving.restarts("triton") == 1)
        stage.serving.wait_ready()
        assert stage.serving.reasons() == {"a": NO_REASON, "c": NO_REASON}
        (state, _) = (stage.serving.ready().json()["models"][model] for model in ("a", "c"))
        assert (state["versions"], state["versions_in_file"]) == ([1], [2])
        for model in ("a", "c"):
            assert "versions: 1" in stage.file(f"loaded-{model}").read_text()
        httpx.post(f"{stage.serving.endpoints.http_url}/v2/repository/models/a/load")
        assert stage.file("loaded-a").read_text() == config.read_text()  # a later load reads the repository's files
    assert {"b: serves version none (before: 1)", "c: serves version 1 (before: none)"} <= {*caplog.messages}


@pytest.mark.parametrize(
    ("entry", "has_failed"),
    [
        ({"version": "1", "state": "READY"}, False),
        ({"version": "2", "state": "LOADING"}, False),  # a rollout goes on as soon as the port is open
        ({"version": "2", "state": "UNAVAILABLE", "reason": "unloaded"}, False),
        ({"version": "2", "state": "UNAVAILABLE", "reason": "no such file"}, True),
        ({}, True),
    ],
)
def test_a_start_fails_by_versions_that_could_not_be_loaded(entry: dict[str, str], has_failed: bool) -> None:
    assert [version.has_failed for version in versions_of([{"name": "a", **entry}])] == [has_failed]


def test_a_silent_gateway_is_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ASK_S", "GATEWAY_PAUSE_S"):
        monkeypatch.setattr(supervisor, name, 0.01)
    port = Endpoints.free().http_port
    listens = f"import socket, time; s = socket.create_server(('127.0.0.1', {port})); time.sleep(600)"
    gateway = GatewayProcess([sys.executable, "-c", listens], ("127.0.0.1", port), silent_s=0.2)
    gateway.start()
    try:
        told: list[str] = []
        wait_for(lambda: told.extend(filter(None, [gateway.look()])) or told)
        assert told == ["no answer for 0.2 s"]
    finally:
        gateway.stop()


def test_a_crash_loop_is_many_faults_each_soon_after_a_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """A long run begins a new count; failed starts do not, however long they take."""
    now_s = 0.0
    monkeypatch.setattr(supervisor, "time", SimpleNamespace(monotonic=lambda: now_s))

    def fault_after(*durations_s: float, starts: bool = True) -> None:
        nonlocal now_s
        for duration_s in durations_s:
            if starts:
                faults.started()
            now_s += duration_s
            faults.failed("why")

    faults = FaultCount()
    fault_after(*[1.0] * MOST)
    fault_after(STEADY_S, *[1.0] * (MOST - 1))
    in_a_row = r"^triton: expected to run, got 6 faults in a row; the last: why$"
    with pytest.raises(CrashLoopError, match=in_a_row):
        fault_after(1.0)
    faults = FaultCount()
    fault_after(5 * STEADY_S)
    fault_after(*[2 * STEADY_S] * (MOST - 1), starts=False)
    with pytest.raises(CrashLoopError, match=in_a_row):
        fault_after(2 * STEADY_S, starts=False)


def test_a_silent_connection_to_the_status_port_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status._Handler, "timeout", 0.1)
    port = Endpoints.free().http_port
    with closing(StatusServer("127.0.0.1", port, Status())), socket.create_connection(("127.0.0.1", port)) as silent:
        silent.send(b"G")
        assert silent.recv(1) == b""
        assert httpx.get(f"http://127.0.0.1:{port}/live").status_code == 200


def told(about: Status) -> dict[str, Any]:
    """Return the metrics of models by name and labels."""
    lines = [line for line in about.metrics().decode().splitlines() if line.startswith("rfm_serve_")]
    return {name: float(value) for name, value in (line.rsplit(" ", 1) for line in lines) if "ready" in name}


def test_the_status_drops_models_and_reasons_that_no_longer_apply() -> None:
    about = Status()
    about.record({"a": NO_REASON, "b": NO_REASON, "a_frames": NO_REASON})
    about.record({"a": NO_REASON, "a_frames": NO_REASON})
    assert told(about) == {'rfm_serve_ready{model="a"}': 1, 'rfm_serve_ready{model="a_frames"}': 1}
    about.record_down("restarted")
    about.record({"a": "it is loading", "a_frames": NO_REASON})
    assert told(about) == {
        'rfm_serve_ready{model="a"}': 0,
        'rfm_serve_ready{model="a_frames"}': 1,
        'rfm_serve_not_ready{model="a",reason="it is loading"}': 1,
    }
    about.record_down("restarted")
    assert about.ready[1]["models"]["a_frames"] == {"ready": False, "reason": "restarted"}
