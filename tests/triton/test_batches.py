# SPDX-License-Identifier: MIT
"""What waits for a batch: what shares it, is prepared ahead of it, or finds no room."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from batch_models import BREAKS, CONFIG, REFUSED, Model, Request, backend, request  # noqa: F401  a fixture
from clock import Clock
from rfm import journal
from rfm.execution import Execution
from rfm.journal import Journal
from rfm.probe import blank_question
from rfm.steps import one_step_further
from rfm.triton_model import batch_model, self_check, triton_queue
from rfm.triton_model.quarantine import Quarantine
from rfm.triton_model.request_digest import digest
from rfm_client import (
    InvalidSampleError,
    Result,
    RewardError,
    Sample,
)
from rfm_client.contract.names import PROBE_PREFIX
from rfm_serve import PATIENCE_S, wait_for


def test_a_lone_request_is_answered_before_execute_returns(tmp_path: Path) -> None:
    model = Model(tmp_path)
    model.respond([request(1)])  # only now it is known how long an answer takes
    model._cheap_answer_s = 0.0
    lone, broken = request(5), request(BREAKS)
    model.take([lone])
    model.take([broken])
    assert [response.error for response in (*lone.responses, *broken.responses)] == [
        None,
        ("internal", "scoring failed; the server's log has the reason"),
    ]
    assert model.batches == [1, 1, 1]


def test_cheap_answers_are_given_together_unless_more_wait(tmp_path: Path) -> None:
    model = Model(tmp_path)
    model.respond([request(1)])
    model._cheap_answer_s = 1.0
    cheap = [request(5), request(REFUSED), Request(request(1).tensors | {"num_frames": np.zeros((1, 2), np.int32)})]
    model.take(cheap)
    assert [len(each.responses) for each in cheap] == [1, 1, 1]
    full = [request(1) for _ in range(CONFIG["max_batch_size"])]  # type: ignore[call-overload]  # it is an int
    assert model.execute(full) is None
    wait_for(lambda: all(each.responses for each in full))
    assert model.batches == [1, 2, 8]
    assert model.samples == {("progress", "scored"): 10, ("progress", "refused"): 1, ("unknown", "refused"): 1}


class Gate(Model):
    """Answers when it may."""

    def __init__(
        self, folder: Path, settings: Mapping[str, str] = MappingProxyType({}), num_instances: int = 1
    ) -> None:
        self.may_answer = threading.Event()
        super().__init__(folder, settings=settings, num_instances=num_instances)
        self._sample_s = 1.0  # so long that others are taken in meanwhile

    def answer(self, questions: Sequence[Sample], execution: Execution) -> list[Result | RewardError]:
        assert self.may_answer.wait(PATIENCE_S)
        return super().answer(questions, execution)

    def open(self, *requests: Request) -> None:
        self.may_answer.set()
        wait_for(lambda: all(len(request.responses) == 1 for request in requests))


def test_what_comes_while_a_batch_is_scored_makes_up_the_next(tmp_path: Path) -> None:
    model = Gate(tmp_path)
    requests = [request(count) for count in (1, 5, 6, 7)]
    for each in requests:
        model.take([each])
        wait_for(lambda: model._pipeline._is_scoring)
    model.open(*requests)
    assert model.batches == [1, 3]


def test_what_finds_no_room_is_rejected_at_once_and_counted(tmp_path: Path) -> None:
    model = Gate(tmp_path, {"max_queue_size": "2"})
    scored, *waiting = first = [request(1), request(5), request(6)]
    model.take([scored])
    wait_for(lambda: model._pipeline.num_waiting == 0)
    model.take(waiting)
    late, probe = request(7), Request(blank_question(CONFIG), id=f"{PROBE_PREFIX}-rfm")
    model.take([late, probe])
    assert [response.error for response in late.responses] == [
        ("unavailable", "the queue is full: 3 requests wait already")
    ]
    assert probe.responses == []  # it waits like those that were in time
    model.open(*first, probe)
    assert model.samples == {("progress", "scored"): 3, ("progress", "rejected"): 1}


@pytest.mark.parametrize(("max_queue_size", "expected"), [("19", 10), ("9", 8), ("3", 3)])
def test_several_instances_share_the_bound_of_what_may_wait(tmp_path: Path, max_queue_size: str, expected: int) -> None:
    """Each has room for what fits into a batch, if the bound allows for it."""
    model = Gate(tmp_path, {"max_queue_size": max_queue_size}, num_instances=2)
    scored, *waiting = requests = [request(count) for count in (1, *[5] * 12)]
    model.take([scored])
    wait_for(lambda: model._pipeline.num_waiting == 0)
    model.take(waiting)
    assert sum(not each.responses for each in waiting) == expected
    model.open(*requests)


def test_cheap_requests_wait_for_what_is_under_way_and_are_answered_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else they would be sent one by one for as long as there is always something under way."""
    model = Gate(tmp_path)
    first, cheap = request(1), [request(5), request(6)]
    model.take([first])
    wait_for(lambda: model._pipeline._is_scoring)
    monkeypatch.setattr(batch_model, "AT_ONCE_S", PATIENCE_S)
    monkeypatch.setattr(batch_model, "UNSEEN_S", PATIENCE_S)
    model._cheap_answer_s = PATIENCE_S
    waits = threading.Event()
    wait_for_idle = model._pipeline.wait_for
    monkeypatch.setattr(model._pipeline, "wait_for", lambda *of_wait: (waits.set(), wait_for_idle(*of_wait)))
    with ThreadPoolExecutor(1) as pool:
        answered = pool.submit(model.execute, cheap)
        assert waits.wait(PATIENCE_S)
        assert not answered.done()
        model.may_answer.set()
        responses = answered.result(PATIENCE_S)
    assert responses is not None and len(responses) == 2
    assert model.batches == [1, 2]


def test_cheap_requests_that_take_long_together_are_sent_as_they_come(tmp_path: Path) -> None:
    model = Model(tmp_path)
    model._cheap_answer_s = PATIENCE_S
    model._sample_s = batch_model.AT_ONCE_S / 4
    requests = [request(5) for _ in range(4)]
    assert model.execute(requests) is None
    wait_for(lambda: all(each.responses for each in requests))
    model._sample_s = batch_model.AT_ONCE_S / 4
    responses = model.execute([request(5) for _ in range(3)])
    assert responses is not None and len(responses) == 3


@pytest.mark.parametrize("num_samples", [[8], [4, 4], [5]])
def test_a_full_batch_of_samples_is_sent_as_it_comes(tmp_path: Path, num_samples: list[int]) -> None:
    """More may wait behind it, and some of them may have to be rejected. Another request of 5 samples would not fit."""
    model = Model(tmp_path)
    model._sample_s = 0.0
    requests = [request(*[5] * count) for count in num_samples]
    assert model.execute(requests) is None
    wait_for(lambda: all(each.responses for each in requests))


def test_cheap_requests_do_not_wait_for_many_that_wait_already(tmp_path: Path) -> None:
    model = Gate(tmp_path)
    first, waiting, late = request(1), [request(5), request(6)], request(7)
    model.take([first])
    wait_for(lambda: model._pipeline._is_scoring)
    model.take(waiting)
    model._sample_s = batch_model.AT_ONCE_S / 3
    model._cheap_answer_s = PATIENCE_S
    model._pipeline.wait_for = None  # type: ignore[assignment, method-assign]  nobody calls it
    model.take([late])
    assert late.responses == []
    model.open(first, *waiting, late)


class Slow(Model):
    """Takes a millisecond for each sample."""

    def answer(self, questions: Sequence[Sample], execution: Execution) -> list[Result | RewardError]:
        time.sleep(1e-3 * len(questions))
        return super().answer(questions, execution)


@pytest.mark.parametrize("batches", [[[1, 1, 1], [7]], [[1]]], ids=["of two sizes", "each alone"])
@pytest.mark.parametrize("settings", [{"max_queue_size": "8"}, {"max_queue_size": "100"}], ids=["8 wait", "100 wait"])
def test_what_waits_in_triton_behind_small_batches_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, batches: list[list[int]], settings: dict[str, str]
) -> None:
    """Triton ends a batch also where the next request does not fit in, or has other inputs, however many wait."""
    monkeypatch.setattr(triton_queue, "CALL_S", PATIENCE_S)
    model = Slow(tmp_path, settings=settings)
    model.respond([request(1)])
    backlog = [[request(*[5] * size) for size in batch] for batch in batches * (600 // len(batches))]
    for batch in backlog:
        model.take(batch)
    requests = [each for batch in backlog for each in batch]
    wait_for(lambda: all(each.responses for each in requests))
    errors = [each.responses[0].error for each in requests if each.responses[0].error is not None]
    assert 0 < len(errors) < len(requests)
    assert all(f"the queue is full: {settings['max_queue_size']} requests wait" in message for _, message in errors)


def test_a_short_timeout_has_triton_looked_at_more_often(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(triton_queue, "CALL_S", PATIENCE_S)
    monkeypatch.setattr(batch_model, "UNSEEN_S", PATIENCE_S)
    model = Slow(tmp_path, settings={"queue_timeout_ms": "10"})
    model.respond([request(1)])
    requests = [request(5) for _ in range(100)]
    answered_at_once = [model.execute([each]) is not None for each in requests]
    assert not all(answered_at_once)
    wait_for(lambda: len(model.batches) > 1 and model._pipeline.is_idle)


def test_a_lone_caller_s_requests_are_all_answered_before_execute_returns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes him a moment to send the next one, so that none can wait in Triton."""
    no_time = SimpleNamespace(monotonic=time.monotonic, perf_counter=lambda: 0.0)
    monkeypatch.setattr(batch_model, "time", no_time)  # no answer takes any time
    model = Model(tmp_path)
    model.respond([request(1)])
    ends_s = time.monotonic() + 2 * batch_model.UNSEEN_S
    while time.monotonic() < ends_s:
        time.sleep(3 * triton_queue.CALL_S)
        assert model.execute([request(5)]) is not None


def test_a_request_for_which_there_is_no_memory_fails_alone(tmp_path: Path) -> None:
    model = Model(tmp_path)
    model.respond([request(1)])
    model._sample_s = 1.0  # so long that they are answered later

    class Large(np.ndarray):  # type: ignore[type-arg]
        def copy(self, order: Any = None) -> Any:
            raise MemoryError

    large = request(5)
    large.tensors["video_embeddings"] = large.tensors["video_embeddings"].view(Large)
    failed, scored = model.respond([large, request(6)])
    assert failed.error == ("internal", "scoring failed; the server's log has the reason")
    assert scored.error is None
    wait_for(lambda: model._quarantine._journal.num_owed == 0)


@pytest.mark.parametrize(
    ("settings", "timeout_us", "whose"),
    [({"queue_timeout_ms": "20"}, 0, "queue_timeout_ms"), ({}, 20_000, "its own timeout")],
)
def test_what_has_waited_for_too_long_is_rejected(
    tmp_path: Path, settings: dict[str, str], timeout_us: int, whose: str
) -> None:
    model = Gate(tmp_path, settings)
    first, late = request(1), Request(request(5).tensors, timeout_us=timeout_us)
    model.take([first])
    wait_for(lambda: model._pipeline._is_scoring)
    model.take([late])
    time.sleep(0.03)
    model.open(first, late)
    ((code, message),) = (response.error for response in late.responses)
    assert code == "unavailable"
    assert message.startswith(f"the request has waited for longer than 0.02 s ({whose})")
    assert model.samples == {("progress", "scored"): 1, ("progress", "rejected"): 1}


def test_the_journal_says_how_many_answers_are_owed_and_nothing_is_owed_while_there_are_suspects(
    tmp_path: Path,
) -> None:
    model = Gate(tmp_path)
    journal = Journal.open(tmp_path / "1_batch")
    assert journal is not None
    requests = [request(1), request(5), Request(request(1).tensors | {"num_frames": np.zeros((1, 2), np.int32)})]
    model.execute(requests)
    wait_for(lambda: journal.num_owed == 2)  # one was refused at once
    model.open(*requests)
    wait_for(lambda: journal.num_owed == 0)
    model._quarantine._deaths[b"suspect!"] = 1
    assert len(model.execute([request(1), request(5)]) or ()) == 2


def test_a_broken_instance_rejects_what_waits_before_it_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(self_check, "ANSWERED_S", 3600.0)  # the process of this test does not end
    model = Gate(tmp_path)
    first, waiting = request(BREAKS), [request(5), request(6)]
    model.execute([first])
    wait_for(lambda: model._pipeline._is_scoring)
    model.execute(waiting)
    model._self_check.end(RuntimeError("a lost device"))
    model.open(first, *waiting)
    assert model._self_check.is_ending
    assert [response.error for each in waiting for response in each.responses] == [
        ("unavailable", "the instance is broken, and ends")
    ] * 2
    assert model.logged[0] == "ended: a lost device"
    assert model._quarantine._journal.num_owed == 0
    assert model._self_check._ending is not None
    model._self_check._ending.cancel()


def test_a_model_is_unloaded_when_all_are_answered(tmp_path: Path) -> None:
    model = Gate(tmp_path)
    requests = [request(count) for count in (1, 5, 6)]
    model.take(requests)
    with ThreadPoolExecutor(1) as pool:
        unloaded = pool.submit(model.finalize)
        time.sleep(0.05)
        assert not unloaded.done()
        model.may_answer.set()
        unloaded.result(PATIENCE_S)
    assert all(len(request.responses) == 1 for request in requests)
    assert not (tmp_path / "1_batch").exists()


class Ahead(Gate):
    """Works ahead in two threads, and notes what its journal names meanwhile."""

    def __init__(self, folder: Path) -> None:
        self.journal: list[list[bytes]] = []
        self.ahead: list[int] = []
        super().__init__(folder)

    def start(self, *arguments: Any, **more: Any) -> None:
        self._quarantine = Quarantine(self._quarantine._journal.file, (), 8, 2)
        super().start(*arguments, **more, num_preparing=2)

    def prepare(self, question: Sample) -> tuple[Sample, int]:
        if question.trajectories[0].num_frames == REFUSED:
            raise InvalidSampleError.at("num_frames", "others", "these")
        return question, 1

    def work_ahead(self, prepared: Sample) -> None:
        if prepared.trajectories[0].num_frames == BREAKS:
            raise MemoryError
        self.ahead.append(prepared.trajectories[0].num_frames)
        self.journal.append(self._quarantine._journal.digests)


def test_what_waits_is_worked_on_ahead_and_the_journal_names_it(tmp_path: Path) -> None:
    model = Ahead(tmp_path)
    first, *others = requests = [request(count) for count in (1, 5, 6)]
    model.take([first])
    wait_for(lambda: model._pipeline._is_scoring)
    for other in others:
        model.take([other])
        wait_for(lambda: model.ahead[-1] == other.tensors["num_frames"][0, 0])  # noqa: B023  it is called at once
    model.open(*requests)
    assert model.ahead == [1, 5, 6]
    assert [digest(other.tensors) in named for other, named in zip(others, model.journal[1:], strict=True)] == [
        True
    ] * 2
    assert all(digest(first.tensors) in named for named in model.journal)  # it is scored meanwhile
    assert model._quarantine._journal.digests == []


def test_what_cannot_be_answered_is_refused_before_its_turn(tmp_path: Path) -> None:
    model = Ahead(tmp_path)
    first, refused = request(1), request(5, REFUSED)
    model.take([first])
    wait_for(lambda: model._pipeline._is_scoring)
    model.take([refused])
    assert [answer.error for answer in refused.responses] == [
        ("invalid", "samples[1].num_frames: expected others, got these")
    ]
    model.open(first)


def test_what_goes_wrong_ahead_is_left_to_the_request_s_turn(tmp_path: Path) -> None:
    model = Ahead(tmp_path)
    requests = [request(1), request(BREAKS), request(5)]
    model.take(requests)
    model.open(*requests)
    assert [answer.error for each in requests for answer in each.responses] == [
        None, ("internal", "scoring failed; the server's log has the reason"), None,
    ]  # fmt: skip


def test_a_probe_is_not_rejected_however_long_it_waits(tmp_path: Path) -> None:
    model = Gate(tmp_path, {"queue_timeout_ms": "20"})
    first, probe = request(1), Request(blank_question(CONFIG), id=f"{PROBE_PREFIX}-rfm")
    model.execute([first])
    wait_for(lambda: model._pipeline._is_scoring)
    model.execute([probe])
    time.sleep(0.03)
    model.open(first, probe)
    ((code, _),) = (response.error for response in probe.responses)
    assert code == "invalid"  # it was scored: the model above refuses two frames, which the blank question has


class Stepwise(Ahead):
    """Prepares, ahead or in its turn, in steps of a second of a made-up time, and then stops in the midst of one."""

    def __init__(self, folder: Path, clock: Clock, *, is_ahead: bool) -> None:
        self.clock, self.is_ahead = clock, is_ahead
        self.busy_s: list[float] = []
        super().__init__(folder)
        self.may_answer.set()

    def work_ahead(self, prepared: Sample) -> None:
        if self.is_ahead:
            self.go_on()

    def answer(self, questions: Sequence[Sample], execution: Execution) -> list[Result | RewardError]:
        if not self.is_ahead:
            self.go_on()
        return super().answer(questions, execution)

    def go_on(self) -> None:
        for step_s in [1.0] * 100 + [50.0]:
            self.clock.now_s += step_s
            self.busy_s.append(self._quarantine._journal.busy_s)
            one_step_further()


@pytest.mark.parametrize("is_ahead", [True, False], ids=["ahead", "in its turn"])
def test_what_is_prepared_step_by_step_gets_on_until_it_stops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_ahead: bool
) -> None:
    clock = Clock()
    clock.now_s = 1.0
    monkeypatch.setattr(journal, "time", clock)
    model = Stepwise(tmp_path, clock, is_ahead=is_ahead)
    model._sample_s = 1.0  # long enough that requests are answered later
    model.respond([request(1)])
    assert model.busy_s == [1.0] * 100 + [50.0]
    one_step_further()  # of a thread that is late: the work has ended
    model._quarantine.renew()
    assert model._quarantine._journal.busy_s == 0
