# SPDX-License-Identifier: MIT
"""What becomes of the requests of one batch, with a stand-in for the module that Triton gives to a model."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rfm.execution import Execution
from rfm.probe import blank_question
from rfm.triton_model import batch_model, cancellation
from rfm.triton_model.batch_model import BatchModel
from rfm.triton_model.cancellation import Cancellation
from rfm.triton_model.metrics import Counted
from rfm.triton_model.quarantine import Quarantine
from rfm.triton_model.request import Origins
from rfm.triton_model.request import Request as ModelRequest
from rfm.triton_model.request_digest import digest
from rfm.triton_model.self_check import SelfCheck
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
from trajectories import random_trajectory

WIDTHS = (4, 3)
CONFIG = {
    "input": [
        {"name": "sample_type", "dims": [1]},
        {"name": "num_frames", "dims": [2]},
        {"name": "frame_steps", "dims": [1]},
        {"name": "video_embeddings", "dims": [-1, WIDTHS[0]]},
        {"name": "text_embedding", "dims": [WIDTHS[1]]},
    ]
}
REFUSED, BREAKS, FAILS = 2, 3, 4  # numbers of frames that the model below cannot bear


@dataclass(frozen=True)
class Request:
    tensors: wire.Tensors
    id: str = ""
    is_given_up: bool = False

    def request_id(self) -> str:
        return self.id

    def requested_output_names(self) -> list[str]:
        return ["progress"]

    def is_cancelled(self) -> bool:
        return self.is_given_up


@dataclass
class Response:
    output_tensors: Sequence[Any] = ()
    error: Any = None


class Model(BatchModel[Sample, Result]):
    """Scores each frame with how many there are."""

    def __init__(self, folder: Path, warmups: int = 0) -> None:
        self.input_names = [tensor["name"] for tensor in CONFIG["input"]]
        self.counted: list[Counted] = []
        self.at_work: list[int] = []
        self.batches: list[int] = []
        self.logged: list[str] = []
        self._quarantine = Quarantine(folder / "1_batch", (), 8)
        self._cancellation = Cancellation()
        self._blank_tensors = blank_question(CONFIG)
        self._origins = Origins(warmups, digest(self._blank_tensors))
        self._self_check = SelfCheck(self._score_blank, lambda error: self.logged.append(f"ended: {error}"))
        self._metrics = SimpleNamespace(at_work_on=self.working, add=self.counted.append)  # type: ignore[assignment]
        self._log = SimpleNamespace(  # type: ignore[assignment]
            report=lambda request: self.logged.append(str(request.error)),
            report_batch=lambda batch, error: self.logged.append(f"{len(batch)}: {error}"),
        )

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

    codes = {"INVALID_ARG": "invalid", "INTERNAL": "internal", "CANCELLED": "cancelled"}
    for name, code in codes.items():
        setattr(error_of, name, code)
    module = SimpleNamespace(
        get_input_tensor_by_name=tensor_of,
        InferenceResponse=Response,
        TritonError=error_of,
        Tensor=lambda name, array: (name, array.tolist()),
    )
    monkeypatch.setitem(sys.modules, "triton_python_backend_utils", module)  # type: ignore[arg-type]


def request(*num_frames: int, **more: Any) -> Request:
    samples = [ProgressSample(random_trajectory(count, count, *WIDTHS)) for count in num_frames]
    return Request(wire.encode_samples(samples), **more)


def test_requests_are_answered_together_and_each_gets_its_own(tmp_path: Path) -> None:
    model = Model(tmp_path)
    responses = model.execute([request(1), request(5, 1), request(6)])
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
    responses = model.execute([request(REFUSED), request(1), request(FAILS), unreadable, request(1, REFUSED)])
    assert [response.error for response in responses] == [
        ("invalid", "num_frames: expected others, got these"),
        None,
        ("internal", "failed"),
        ("invalid", "num_frames: expected [at least 1, 0] for progress, got [0, 0]"),
        ("invalid", "samples[1].num_frames: expected others, got these"),
    ]
    assert model.batches == [5]
    (counted,) = model.counted
    assert counted.samples == {
        ("progress", "refused"): 3, ("progress", "scored"): 1, ("progress", "failed"): 1, ("unknown", "refused"): 1,
    }  # fmt: skip
    assert (counted.num_frames, counted.num_executed) == (1, 5)  # frames of what was scored
    assert len(model.logged) == 4


def test_a_request_that_breaks_a_batch_is_found(tmp_path: Path) -> None:
    model = Model(tmp_path)
    responses = model.execute([request(1), request(BREAKS), request(5)])
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
    cancelled, _ = model.execute([request(1, is_given_up=True), request(5)])
    if answer_s:
        assert cancelled.error == ("cancelled", "cancelled by the client")
        assert model.batches == [1]
        assert model.samples == {("progress", "cancelled"): 1, ("progress", "scored"): 1}
    else:
        assert cancelled.error is None
        assert model.batches == [2]


def test_the_first_batch_asks_who_has_cancelled(tmp_path: Path) -> None:
    model = Model(tmp_path)
    (cancelled,) = model.execute([request(1, is_given_up=True)])
    assert cancelled.error is not None
    assert model.batches == []


def test_what_an_answer_takes_is_that_of_a_question(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([10.0, 16.0])
    monkeypatch.setattr(cancellation, "time", SimpleNamespace(perf_counter=lambda: next(times)))
    model = Model(tmp_path)
    model.execute([request(1), request(1, 1)])
    assert model._cancellation.answer_s == 2


def test_warm_ups_and_probes_are_not_counted(tmp_path: Path) -> None:
    model = Model(tmp_path, warmups=2)
    blank = Request(blank_question(CONFIG), id=f"{PROBE_PREFIX}-rfm")
    model.execute([request(1), request(5), blank])
    assert (model.at_work, model.samples) == ([0, 0], {})
    model.execute([request(1), request(1, id="caller")])
    assert (model.at_work, model.samples) == ([0, 0, 2, 0], {("progress", "scored"): 2})


def test_a_caller_is_no_warm_up(tmp_path: Path) -> None:
    model = Model(tmp_path, warmups=1)
    model.execute([request(1, id="caller")])
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
    model.execute([Request(wire.encode_samples([PreferenceSample(first, second)]))])
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
