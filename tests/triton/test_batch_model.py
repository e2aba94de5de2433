# SPDX-License-Identifier: MIT
"""What becomes of the requests of one batch, with a stand-in for the module that Triton gives to a model."""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from rfm.execution import Execution
from rfm.journal import Journal
from rfm.probe import blank_question
from rfm.triton_model import batch_model, cancellation, self_check
from rfm.triton_model.batch_model import BatchModel
from rfm.triton_model.metrics import Counted
from rfm.triton_model.placement import Placement
from rfm.triton_model.quarantine import Quarantine
from rfm.triton_model.request import Request as ModelRequest
from rfm.triton_model.request_digest import digest
from rfm_client import (
    FrameScores,
    InferenceFailedError,
    InvalidSampleError,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Result,
    RewardError,
    Sample,
)
from rfm_client.contract import wire
from rfm_client.contract.names import PROBE_PREFIX
from rfm_serve import PATIENCE_S, wait_for
from trajectories import random_trajectory

WIDTHS = (4, 3)
CONFIG = {
    "input": [
        {"name": "sample_type", "dims": [1]},
        {"name": "num_frames", "dims": [2]},
        {"name": "frame_steps", "dims": [1]},
        {"name": "video_embeddings", "dims": [-1, WIDTHS[0]]},
        {"name": "text_embedding", "dims": [WIDTHS[1]]},
    ],
    "max_batch_size": 8,
}
FINAL = 1  # what Triton wants with the last response to a request
REFUSED, BREAKS, FAILS = 2, 3, 4  # numbers of frames that the model below cannot bear


@dataclass
class Request:
    """As Triton hands it over, and what is sent in answer."""

    tensors: wire.Tensors
    id: str = ""
    is_given_up: bool = False
    timeout_us: int = 0
    responses: list[Response] = field(default_factory=list)

    def request_id(self) -> str:
        return self.id

    def requested_output_names(self) -> list[str]:
        return ["progress"]

    def timeout(self) -> int:
        return self.timeout_us

    def get_response_sender(self) -> Request:
        return self

    def is_cancelled(self) -> bool:
        return self.is_given_up

    def send(self, response: Response, flags: int) -> None:
        assert flags == FINAL
        self.responses.append(response)


@dataclass
class Response:
    output_tensors: Sequence[Any] = ()
    error: Any = None


class Model(BatchModel[Sample, Result]):
    """Scores each frame with how many there are."""

    def __init__(self, folder: Path, warmups: int = 0, settings: Mapping[str, str] = MappingProxyType({})) -> None:
        self.counted: list[Counted] = []
        self.at_work: list[int] = []
        self.batches: list[int] = []
        self.logged: list[str] = []
        self._quarantine = Quarantine(folder / "1_batch", (), 8)
        self._metrics = SimpleNamespace(at_work_on=self.working, add=self.counted.append, close=lambda: None)  # type: ignore[assignment]
        self._log = SimpleNamespace(  # type: ignore[assignment]
            report=lambda request: self.logged.append(str(request.error)),
            report_batch=lambda batch, error: self.logged.append(f"{len(batch)}: {error}"),
            report_end=lambda error: self.logged.append(f"ended: {error}"),
        )
        self.start(CONFIG | {"model_warmup": [{"count": 1}] * warmups}, settings)

    def respond(self, requests: Sequence[Request]) -> list[Response]:
        """What becomes of requests of which Triton hands over all at once."""
        self.take(requests)
        wait_for(lambda: all(request.responses for request in requests))
        return [response for request in requests for response in request.responses]

    def take(self, requests: Sequence[Request]) -> None:
        """Hands the requests over, as Triton does, and keeps the responses that come at once."""
        for request, response in zip(requests, self.execute(requests) or (), strict=False):
            request.responses.append(response)

    @contextmanager
    def working(self, batch: Sequence[ModelRequest[Sample]]) -> Iterator[None]:
        self.at_work.append(sum(request.is_counted for request in batch))
        yield
        self.at_work.append(0)

    def decode(self, tensors: wire.Tensors) -> list[Sample]:
        return wire.decode_samples(tensors)

    def answer(self, questions: Sequence[Sample], execution: Execution) -> list[Result | RewardError]:
        self.batches.append(len(questions))
        counts = [question.trajectories[0].num_frames for question in questions]
        if BREAKS in counts:
            raise RuntimeError("made up")
        errors = {
            REFUSED: InvalidSampleError.at("num_frames", "others", "these"),
            FAILS: InferenceFailedError("failed"),
        }
        scores = [np.full(count, count, np.float32) for count in counts]
        return [
            errors.get(count) or ProgressResult(progress=score, success=score)
            for count, score in zip(counts, scores, strict=True)
        ]

    def encode(self, answers: Sequence[Result], tensors: wire.Tensors, outputs: Collection[str]) -> wire.Tensors:
        return wire.encode_results(answers, wire.num_positions(tensors), outputs)

    @property
    def samples(self) -> Counter[tuple[str, str]]:
        return sum((counted.samples for counted in self.counted), Counter())


@pytest.fixture(autouse=True)
def backend(monkeypatch: pytest.MonkeyPatch) -> None:
    def tensor_of(request: Request, name: str) -> Any:
        return SimpleNamespace(as_numpy=lambda: request.tensors[name])

    def error_of(message: str, code: str) -> tuple[str, str]:
        return code, message

    codes = {"INVALID_ARG": "invalid", "INTERNAL": "internal", "CANCELLED": "cancelled", "UNAVAILABLE": "unavailable"}
    for name, code in codes.items():
        setattr(error_of, name, code)
    module = SimpleNamespace(
        get_input_tensor_by_name=tensor_of,
        InferenceResponse=Response,
        TritonError=error_of,
        Tensor=lambda name, array: (name, array.tolist()),
        TRITONSERVER_RESPONSE_COMPLETE_FINAL=FINAL,
    )
    monkeypatch.setitem(sys.modules, "triton_python_backend_utils", module)  # type: ignore[arg-type]


def request(*num_frames: int, **more: Any) -> Request:
    samples = [ProgressSample(random_trajectory(count, count, *WIDTHS)) for count in num_frames]
    return Request(wire.encode_samples(samples), **more)


def test_requests_are_answered_together_and_each_gets_its_own(tmp_path: Path) -> None:
    model = Model(tmp_path)
    responses = model.respond([request(1), request(5, 1), request(6)])
    assert model.batches == [4]
    assert model.at_work == [3, 0]
    tensors = [response.output_tensors for response in responses]
    assert tensors[0] == [("progress", [[1]])]
    ((name, ((*five,), (one, *padding))),) = tensors[1]
    assert (name, five, one) == ("progress", [5] * 5, 1)
    assert np.isnan(padding).all()
    assert tensors[2] == [("progress", [[6] * 6])]
    (counted,) = model.counted
    assert counted.samples == {("progress", "scored"): 4}
    assert (counted.num_frames, counted.num_executed) == (1 + 5 + 1 + 6, 4)
    assert model.logged == []


def test_refused_and_failed_requests_fail_alone(tmp_path: Path) -> None:
    model = Model(tmp_path)
    unreadable = Request(request(1).tensors | {"num_frames": np.zeros((1, 2), np.int32)})
    responses = model.respond([request(REFUSED), request(1), request(FAILS), unreadable, request(1, REFUSED)])
    assert [response.error for response in responses] == [
        ("invalid", "num_frames: expected others, got these"),
        None,
        ("internal", "failed"),
        ("invalid", "num_frames: expected [at least 1, 0] for progress, got [0, 0]"),
        ("invalid", "samples[1].num_frames: expected others, got these"),
    ]
    assert model.batches == [5]  # one request of five cannot be read, another has two samples
    assert model.samples == {
        ("progress", "refused"): 3, ("progress", "scored"): 1, ("progress", "failed"): 1, ("unknown", "refused"): 1,
    }  # fmt: skip
    assert sum(counted.num_frames for counted in model.counted) == 1  # frames of what was scored
    assert sum(counted.num_executed for counted in model.counted) == 5
    assert len(model.logged) == 4


def test_a_request_that_breaks_a_batch_is_found(tmp_path: Path) -> None:
    model = Model(tmp_path)
    responses = model.respond([request(1), request(BREAKS), request(5)])
    assert [response.error for response in responses] == [
        None, ("internal", "scoring failed; the server's log has the reason"), None,
    ]  # fmt: skip
    assert model.batches == [3, 1, 1, 1]
    assert model.at_work == [3, 0]
    assert model.logged == ["3: made up", "scoring failed; the server's log has the reason"]
    assert model.samples == {("progress", "scored"): 2, ("progress", "failed"): 1}


@pytest.mark.parametrize("answer_s", [cancellation.WORTH_CHECKING_S, 0.0])
def test_a_cancelled_request_costs_nothing_where_it_is_worth_a_question(tmp_path: Path, answer_s: float) -> None:
    model = Model(tmp_path)
    model._cancellation.answer_s = answer_s
    cancelled, _ = model.respond([request(1, is_given_up=True), request(5)])
    if answer_s:
        assert cancelled.error == ("cancelled", "cancelled by the client")
        assert model.batches == [1]
        assert model.samples == {("progress", "cancelled"): 1, ("progress", "scored"): 1}
    else:
        assert cancelled.error is None
        assert model.batches == [2]


def test_the_first_batch_asks_who_has_cancelled(tmp_path: Path) -> None:
    model = Model(tmp_path)
    (cancelled,) = model.respond([request(1, is_given_up=True)])
    assert cancelled.error is not None
    assert model.batches == []


def test_what_an_answer_takes_is_that_of_a_question(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([10.0, 16.0])
    monkeypatch.setattr(batch_model, "time", SimpleNamespace(perf_counter=lambda: next(times)))
    model = Model(tmp_path)
    model.respond([request(1), request(1, 1)])
    assert model._cancellation.answer_s == 2
    assert model._request_s == 3


def test_warm_ups_and_probes_are_not_counted(tmp_path: Path) -> None:
    model = Model(tmp_path, warmups=2)
    blank = Request(blank_question(CONFIG), id=f"{PROBE_PREFIX}-rfm")
    model.respond([request(1), request(5), blank])
    assert (model.at_work, model.samples) == ([0, 0], {})
    model.respond([request(1), request(1, id="caller")])
    assert (model.at_work, model.samples) == ([0, 0, 2, 0], {("progress", "scored"): 2})


def test_a_caller_is_no_warm_up(tmp_path: Path) -> None:
    model = Model(tmp_path, warmups=1)
    model.respond([request(1, id="caller")])
    assert model.samples == {("progress", "scored"): 1}


def test_metrics_know_what_a_model_can_be_asked_about() -> None:
    assert batch_model._sample_types(["frames", "sample_type"]) == ["progress", "preference", "similarity"]
    assert batch_model._sample_types(["frames", "task"]) == ["encode"]


def test_metrics_know_the_checkpoint() -> None:
    settings = {"source": "org/name", "network": '{"class": "Rewind"}'}
    told = batch_model._checkpoint(settings)
    assert told["network"] == "Rewind"
    assert "" in told.values()
    assert batch_model._checkpoint({})["network"] == ""


def test_pairs_are_counted_with_all_their_frames(tmp_path: Path) -> None:
    model = Model(tmp_path)
    first, second = random_trajectory(0, 5, *WIDTHS), random_trajectory(1, 7, *WIDTHS)
    score = FrameScores(progress=np.ones(1, np.float32), success=np.ones(1, np.float32))
    model.encode = lambda answers, tensors, outputs: {"progress": score.progress}  # type: ignore[method-assign]
    model.respond([Request(wire.encode_samples([PreferenceSample(first, second)]))])
    (counted,) = model.counted
    assert counted.samples == {("preference", "scored"): 1}
    assert counted.num_frames == 12


@pytest.mark.parametrize("kind", [None, InvalidSampleError, InferenceFailedError])
def test_only_a_refusal_of_the_blank_sample_is_no_failure(tmp_path: Path, kind: type[RewardError] | None) -> None:
    """A checkpoint may refuse blank frames; an instance that fails at them is broken."""

    class Blank(Model):
        def answer(self, questions: Sequence[Sample], execution: Execution) -> list[Result | RewardError]:
            score = np.zeros(questions[0].trajectories[0].num_frames, np.float32)
            return [ProgressResult(progress=score, success=score) if kind is None else kind("made up")]

    model = Blank(tmp_path)
    if kind is InferenceFailedError:
        with pytest.raises(InferenceFailedError, match="made up"):
            model._score_blank()
    else:
        model._score_blank()


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

    def __init__(self, folder: Path, settings: Mapping[str, str] = MappingProxyType({})) -> None:
        self.may_answer = threading.Event()
        super().__init__(folder, settings=settings)
        self._request_s = 1.0  # so long that others are taken in meanwhile

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


@pytest.mark.parametrize(("settings", "timeout_us"), [({"queue_timeout_ms": "20"}, 0), ({}, 20_000)])
def test_what_has_waited_for_too_long_is_rejected(tmp_path: Path, settings: dict[str, str], timeout_us: int) -> None:
    model = Gate(tmp_path, settings)
    first, late = request(1), Request(request(5).tensors, timeout_us=timeout_us)
    model.take([first])
    wait_for(lambda: model._pipeline._is_scoring)
    model.take([late])
    time.sleep(0.03)
    model.open(first, late)
    ((code, message),) = (response.error for response in late.responses)
    assert code == "unavailable"
    assert message.startswith("the request has waited for longer than 0.02 s")
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


def test_answers_that_cannot_be_written_fail_alone(tmp_path: Path) -> None:
    model = Model(tmp_path)
    encode = model.encode

    def encode_most(answers: Sequence[Result], tensors: wire.Tensors, outputs: Collection[str]) -> wire.Tensors:
        if len(answers) == 2:
            raise MemoryError
        return encode(answers, tensors, outputs)

    model.encode = encode_most  # type: ignore[method-assign]  # one request of two samples cannot be written
    good, bad = model.respond([request(1), request(5, 6)])
    assert (good.error, bad.error) == (None, ("internal", "scoring failed; the server's log has the reason"))
    assert model.samples == {("progress", "scored"): 1, ("progress", "failed"): 2}


@pytest.mark.parametrize(("kind", "gpus"), [("CPU", []), ("GPU", [0, 1, 2, 3])])
def test_the_cores_of_a_machine_are_shared_among_the_instances(
    kind: str, gpus: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 16)
    args = {"model_instance_kind": kind, "model_instance_device_id": "3"}
    config = {"instance_group": [{"count": 2, "gpus": gpus}]}
    placement = Placement.of(args, config, {"torch_threads": "0"})
    assert placement.num_threads == (2 if gpus else 8)
    assert placement.num_preparing == (2 if gpus else 1)
    assert Placement.of(args, config, {"torch_threads": "5"}).num_threads == 5


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
