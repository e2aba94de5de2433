# SPDX-License-Identifier: MIT
"""What a probe tells of a model, against answers that are given to it by hand."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import pytest

from clock import Clock
from rfm.launch.http import Http
from rfm.launch.process import Endpoints
from rfm.supervise import background, model_probe
from rfm.supervise.model_probe import ModelProbe, can_be_probed
from rfm.supervise.model_states import Event
from rfm_serve import MODEL, wait_for


class Answers:
    """An Http that answers a probe with what it is given, and says how many requests the model has answered."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.latency_s = 0.0  # of an answer to a probe
        self.next: tuple[int, str] | None = (200, "{}")
        self.success: list[dict[str, int]] | None = [{}]
        self.error: Exception = TimeoutError()  # instead of an answer
        self.sent: list[bytes] = []
        self.timeouts_s: set[float] = set()
        self.got: list[str] = []

    def request(self, method: str, path: str, timeout_s: float, body: bytes) -> tuple[int, str]:
        self.sent.append(body)
        self.timeouts_s.add(timeout_s)
        if self.next is None:
            raise self.error
        self.clock.now_s += self.latency_s
        return self.next

    def get_json(self, path: str) -> Any:
        self.got.append(path.rpartition("/")[2])
        if path.endswith("/stats"):
            if self.success is None:
                raise self.error
            return {"model_stats": [{"inference_stats": {"success": success}} for success in self.success]}
        inputs = [{"name": "num_frames", "dims": [2]}, {"name": "task", "dims": [1]}]
        return {"input": inputs, "output": [{"name": "progress"}, {"name": "success"}]}


class Prober:
    """A probe under test, with a clock of its own. observed: what answers took"""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock = Clock()
        self.clock.now_s = 100.0
        self.http = Answers(self.clock)
        self.observed: list[float] = []
        monkeypatch.setattr(model_probe, "time", self.clock)
        monkeypatch.setattr(background, "in_background", self.at_once)
        self.has_stats = True  # else that they never come
        self.probe = ModelProbe(self.http, MODEL, 2.0, 30.0, self.observed.append)  # type: ignore[arg-type]

    def at_once(self, name: str, call: Callable[[], Any]) -> Future[Any]:
        future: Future[Any] = Future()
        if "stats" in name and not self.has_stats:
            return future
        try:
            future.set_result(call())
        except (TimeoutError, TypeError) as error:
            future.set_exception(error)
        return future

    def after(self, duration_s: float) -> Event | None:
        """What is known then; an answer of just now included."""
        self.clock.now_s += duration_s
        self.probe.look()
        return self.probe.look()


@pytest.fixture
def prober(monkeypatch: pytest.MonkeyPatch) -> Prober:
    return Prober(monkeypatch)


@pytest.mark.parametrize(
    ("answer", "event"),
    [
        ((200, "{}"), Event.ANSWERED),
        ((400, "frames: expected others"), Event.ANSWERED),
        ((500, "scoring failed"), Event.ANSWERED),  # blank frames need not be readable
        ((500, "Stub process 'rfm' is not healthy."), Event.DEAD),
        ((400, "Request for unknown model: 'rfm' is not found"), Event.ABSENT),
        ((503, "Exceeds maximum queue size"), None),
        (None, None),
    ],
)
def test_an_answer_says_what_a_model_does(prober: Prober, answer: tuple[int, str] | None, event: Event | None) -> None:
    prober.http.next = answer
    assert prober.after(0.0) is event
    assert len(prober.observed) == (event is not None)


def test_a_model_is_broken_that_fails_three_times_at_what_it_could_answer(prober: Prober) -> None:
    assert prober.after(0.0) is Event.ANSWERED
    prober.http.next = (500, "scoring failed")
    assert [prober.after(2.0) for _ in range(2)] == [Event.ANSWERED] * 2
    prober.http.next = (200, "{}")
    assert prober.after(2.0) is Event.ANSWERED
    prober.http.next = (500, "scoring failed")
    assert [prober.after(2.0) for _ in range(3)] == [Event.ANSWERED, Event.ANSWERED, Event.BROKEN]
    prober.probe.renew()
    assert [prober.after(2.0) for _ in range(4)] == [Event.ANSWERED] * 4


def test_a_probe_without_an_answer_is_late_and_then_hung(prober: Prober) -> None:
    assert prober.after(0.0) is Event.ANSWERED
    prober.http.next = None
    assert prober.after(2.0) is Event.ANSWERED
    assert prober.after(2.5) is Event.ANSWERED
    assert prober.after(0.1) is Event.LATE
    assert prober.after(27.4) is Event.LATE
    assert prober.after(0.1) is Event.HUNG
    prober.http.next = (200, "{}")
    assert prober.after(2.0) is Event.ANSWERED


def test_who_answers_others_is_not_late(prober: Prober) -> None:
    assert prober.after(0.0) is Event.ANSWERED
    prober.http.next = None
    prober.after(2.0)
    for number in range(40):
        prober.http.success = [{"count": number}]
        assert prober.after(2.0) in ({Event.ANSWERED} if number else {Event.ANSWERED, Event.LATE})
    assert prober.after(2.6) is Event.LATE


def test_the_first_request_that_a_model_answers_counts(prober: Prober) -> None:
    prober.http.next = None
    prober.after(0.0)
    assert prober.after(2.6) is Event.LATE
    prober.http.success = [{"count": 1}]
    prober.after(0.1)
    assert prober.after(2.5) is None  # nothing is known of it, but that it answers somebody


@pytest.mark.parametrize("has_stats", [True, False], ids=["they cannot be had", "they do not come"])
@pytest.mark.parametrize("first", [None, (200, "{}")], ids=["never answered", "answered once"])
def test_a_model_does_not_hang_as_long_as_triton_gives_no_statistics(
    prober: Prober, first: tuple[int, str] | None, has_stats: bool
) -> None:
    prober.http.next, prober.http.success, prober.has_stats = first, None, has_stats
    prober.after(0.0)
    prober.http.next = None
    prober.after(2.0)
    assert prober.after(100.0) is Event.LATE


def test_statistics_are_only_asked_of_a_model_that_is_half_late(prober: Prober) -> None:
    prober.http.next = None
    prober.after(0.0)
    prober.after(model_probe.LATE_S / 2)
    assert "stats" not in prober.http.got
    prober.after(0.01)
    assert "stats" in prober.http.got


def test_a_model_that_has_never_answered_is_late_as_any(prober: Prober) -> None:
    prober.http.next = None
    assert prober.after(0.0) is None
    assert prober.after(2.5) is None
    assert prober.after(0.01) is Event.LATE
    assert len(prober.http.sent) == 2  # and is asked again all the same
    assert prober.http.timeouts_s == {60.0}


def test_a_probe_is_a_small_request_that_is_made_once(prober: Prober) -> None:
    prober.after(0.0)
    prober.after(2.0)
    assert prober.http.got == ["config"]
    first, second = prober.http.sent
    assert first == second
    assert json.loads(first)["outputs"] == [{"name": "progress"}]


@pytest.mark.parametrize("num_fast", [19, 20])
def test_who_was_slow_of_late_may_be_three_times_as_slow(prober: Prober, num_fast: int) -> None:
    prober.http.latency_s = 1.0
    prober.after(0.0)
    prober.http.latency_s = 0.0
    for _ in range(num_fast):
        prober.after(10.0)
    assert len(prober.observed) == 1 + num_fast
    prober.http.next = None
    prober.after(10.0)
    assert prober.after(2.9) is (Event.ANSWERED if num_fast == 19 else Event.LATE)  # the 20 last answers count
    assert prober.after(0.11) is Event.LATE


def test_what_no_probe_should_end_with_is_logged_once_and_counts_as_no_answer(
    prober: Prober, caplog: pytest.LogCaptureFixture
) -> None:
    def after(duration_s: float) -> list[str]:
        """What was logged since then."""
        caplog.clear()
        prober.after(duration_s)
        assert all(record.exc_info is not None for record in caplog.records)
        return caplog.messages

    prober.http.next = prober.http.success = None
    assert after(0.0) + after(2.0) == []  # no answer in time
    prober.http.error = TypeError("a mistake of ours")
    assert after(2.0) == [f"rfm-{what}-{MODEL}: an unexpected error" for what in ("probe", "stats")]
    assert "TypeError: a mistake of ours" in caplog.text
    assert after(2.0) == []
    assert prober.after(0.0) is Event.LATE
    prober.http.next, prober.http.success = (200, "{}"), [{}]
    assert after(2.0) == []
    prober.http.next = None
    assert after(2.0) == [f"rfm-probe-{MODEL}: an unexpected error"]


@pytest.mark.parametrize(
    ("backend", "tensor", "is_ours"),
    [("python", "num_frames", True), ("python", "INPUT0", False), ("onnxruntime", "num_frames", False)],
)
def test_only_models_of_ours_are_probed(backend: str, tensor: str, is_ours: bool) -> None:
    assert can_be_probed({"backend": backend, "input": [{"name": tensor}]}) is is_ours


def test_probes_take_a_tenth_of_a_model_s_time_at_most(prober: Prober) -> None:
    prober.http.latency_s = 1.0
    prober.after(0.0)
    assert prober.observed == [1.0]
    prober.after(9.9)
    assert len(prober.http.sent) == 1
    prober.after(0.2)
    assert len(prober.http.sent) == 2


def test_a_model_of_a_triton_that_tells_nothing_does_not_hang() -> None:
    """It may be busy with a model that it loads; and if it is not, it is Triton that is started again."""
    endpoints = Endpoints.free()
    probe = ModelProbe(Http(endpoints.http_host, endpoints.http_port), MODEL, 0.1, 0.0, lambda _: None)
    wait_for(lambda: probe.look() is Event.LATE)
