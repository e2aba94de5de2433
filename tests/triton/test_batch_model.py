# SPDX-License-Identifier: MIT
"""What becomes of the requests of one batch, with a stand-in for the module that Triton gives to a model."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from batch_models import BREAKS, CONFIG, FAILS, REFUSED, WIDTHS, Model, Request, backend, request  # noqa: F401  a fixture
from rfm.engine.execution import Execution
from rfm.probe import blank_question
from rfm.triton_model import batch_model
from rfm.triton_model.batch_model import GIVEN_UP_S
from rfm.triton_model.placement import Placement, use_threads
from rfm_client import (
    FrameScores,
    InferenceFailedError,
    InvalidSampleError,
    PreferenceSample,
    ProgressResult,
    Result,
    RewardError,
    Sample,
)
from rfm_client.contract import wire
from rfm_client.contract.names import PROBE_PREFIX
from rfm_serve import PATIENCE_S
from trajectories import random_trajectory


def test_requests_are_answered_together_and_each_gets_its_own(tmp_path: Path) -> None:
    model = Model(tmp_path)
    responses = model.respond([request(1), request(5, 1), request(6)])
    assert model.batches == [4]
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


def test_a_request_whose_tensors_cannot_be_had_is_one_that_failed(tmp_path: Path) -> None:
    model = Model(tmp_path)
    lost, other = model.respond([Request({}), request(1)])
    assert lost.error == ("internal", "scoring failed; the server's log has the reason")
    assert other.error is None
    assert model.batches == [1]
    assert model.samples == {("unknown", "failed"): 1, ("progress", "scored"): 1}


def test_a_request_that_breaks_a_batch_is_found(tmp_path: Path) -> None:
    model = Model(tmp_path)
    responses = model.respond([request(1), request(BREAKS), request(5)])
    assert [response.error for response in responses] == [
        None, ("internal", "scoring failed; the server's log has the reason"), None,
    ]  # fmt: skip
    assert model.batches == [3, 1, 1, 1]
    assert model.logged == ["3: made up", "scoring failed; the server's log has the reason"]
    assert model.samples == {("progress", "scored"): 2, ("progress", "failed"): 1}


def test_behind_a_batch_that_took_long_a_cancelled_request_is_not_scored(tmp_path: Path) -> None:
    """Also if the batch was split, and its last request alone took no time."""

    class Slow(Model):
        def answer(self, questions: Sequence[Sample], execution: Execution) -> list[Result | RewardError]:
            time.sleep(2 * GIVEN_UP_S if len(questions) > 1 else 0.0)
            return super().answer(questions, execution)

    model = Slow(tmp_path)
    model.respond([request(1), request(BREAKS)])
    cancelled, scored = model.respond([request(5, is_given_up=True), request(6)])
    assert cancelled.error == ("cancelled", "cancelled by the client")
    assert scored.error is None
    assert model.samples[("progress", "cancelled")] == 1


def test_warm_ups_and_probes_are_not_counted(tmp_path: Path) -> None:
    model = Model(tmp_path, warmups=2)
    blank = Request(blank_question(CONFIG), id=f"{PROBE_PREFIX}-rfm")
    model.respond([request(1), request(5), blank])
    assert model.samples == {}
    model.respond([request(1), request(1, id="caller")])
    assert model.samples == {("progress", "scored"): 2}


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


@pytest.mark.parametrize(
    "error", [None, InvalidSampleError("made up"), InferenceFailedError("no memory"), RuntimeError]
)
def test_only_an_exception_at_the_blank_sample_says_that_an_instance_is_broken(
    tmp_path: Path, error: Exception | type[Exception] | None
) -> None:
    """A checkpoint may refuse blank frames, and memory may be short for a moment; a lost device raises."""

    class Blank(Model):
        def answer(self, questions: Sequence[Sample], execution: Execution) -> list[Result | RewardError]:
            if error is RuntimeError:
                raise RuntimeError("CUDA error")
            score = np.zeros(questions[0].trajectories[0].num_frames, np.float32)
            return [error if isinstance(error, RewardError) else ProgressResult(progress=score, success=score)]

    model = Blank(tmp_path)
    if error is RuntimeError:
        with pytest.raises(RuntimeError, match="CUDA error"):
            model._score_blank()
    else:
        model._score_blank()


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


@pytest.fixture
def _own_number_of_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    use_threads(before)


@pytest.mark.usefixtures("_own_number_of_threads")
def test_what_is_loaded_is_computed_in_a_thread_that_ends() -> None:
    seen: list[tuple[threading.Thread, int]] = []
    use_threads(2)
    placement = Placement(torch.device("cpu"), num_threads=3)
    placement.run(lambda: seen.append((threading.current_thread(), torch.get_num_threads())))
    ((thread, num_threads),) = seen
    assert not thread.is_alive()
    assert num_threads == 3
    assert torch.get_num_threads() == 1  # the calling thread starts no team of its own

    def broken() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        placement.run(broken)
    with pytest.raises(RuntimeError, match="positive"):  # PyTorch's own words, not those of a pool of threads
        Placement(torch.device("cpu"), num_threads=0).run(lambda: None)


@pytest.mark.usefixtures("_own_number_of_threads")
def test_a_thread_computes_with_its_own_number_of_threads_whatever_others_set() -> None:
    has_set, may_look = threading.Event(), threading.Event()

    def number() -> int:
        use_threads(3)
        has_set.set()
        assert may_look.wait(PATIENCE_S)
        return torch.get_num_threads()

    with ThreadPoolExecutor(2) as pool:
        seen = pool.submit(number)
        assert has_set.wait(PATIENCE_S)
        pool.submit(use_threads, 2).result()
        may_look.set()
        assert seen.result() == 3


def test_requests_are_scored_in_the_thread_that_calls_execute(tmp_path: Path) -> None:
    """Warm-ups, too: else OpenMP has two teams of threads."""
    model = Model(tmp_path, warmups=1)
    threads = []
    answer = model.answer

    def watched(questions: Sequence[Sample], execution: Execution) -> Any:
        threads.append(threading.current_thread())
        return answer(questions, execution)

    model.answer = watched  # type: ignore[method-assign]
    model.execute([request(1)])
    model.execute([request(5), request(6)])
    assert threads == [threading.current_thread()] * 2


@pytest.mark.parametrize("parameter", ["max_queue_size", "queue_timeout_ms"])
def test_an_older_export_s_bound_of_the_queue_is_ignored_with_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], parameter: str
) -> None:
    model = Model(tmp_path, settings={parameter: "1"})
    assert "of an older export have no effect: export again" in capsys.readouterr().out
    assert [response.error for response in model.respond([request(1), request(5)])] == [None, None]
