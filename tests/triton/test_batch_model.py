# SPDX-License-Identifier: MIT
"""The requests of a batch, with a stand-in for Triton's Python module."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from batch_models import BREAKS, CONFIG, FAILS, LOGGED, METRICS, REFUSED, WIDTHS, Model, Request, backend, request  # noqa: F401  a fixture
from rfm.engine import Execution
from rfm.engine.threads import num_preparing, use_threads
from rfm.probe_request import probe_request
from rfm.triton_model import batch_model
from rfm.triton_model.batch_model import ASKING_S
from rfm.triton_model.placement import Placement
from rfm.triton_model.watchdog import FAILED_BATCHES, Watchdog
from rfm_client import (
    InferenceFailedError,
    InvalidSampleError,
    ProgressResult,
    Result,
    RewardError,
    Sample,
)
from rfm_client.contract import wire
from rfm_client.contract.description import Description
from rfm_client.contract.wire import PROBE_PREFIX
from servers import PATIENCE_S

REASON = "scoring failed; the server's log has the reason"


def test_requests_are_answered_together_and_each_gets_its_own(tmp_path: Path) -> None:
    model = Model(tmp_path)
    responses = model.respond(request(1), request(5, 1), request(6))
    assert model.batches == [4]
    tensors = [response.output_tensors for response in responses]
    assert tensors[0] == [("progress", [[1]])]
    ((name, ((*five,), (one, *padding))),) = tensors[1]
    assert (name, five, one) == ("progress", [5] * 5, 1)
    assert np.isnan(padding).all()
    assert tensors[2] == [("progress", [[6] * 6])]
    assert model.samples == {("progress", "scored"): 4}
    assert model.told("frames_total") == {(): 1 + 5 + 1 + 6}
    assert LOGGED == []


def test_refused_and_failed_requests_fail_alone(tmp_path: Path) -> None:
    """Fail like a request with missing or unreadable tensors."""
    model = Model(tmp_path)
    unreadable = Request(request(1).tensors | {"num_frames": np.zeros((1, 2), np.int32)})
    responses = model.respond(
        request(REFUSED), request(1), request(FAILS), unreadable, request(1, REFUSED), Request({})
    )
    assert [response.error for response in responses] == [
        ("invalid", "num_frames: expected others, got these"),
        None,
        ("internal", "failed"),
        ("invalid", "num_frames: expected [at least 1, 0] for progress, got [0, 0]"),
        ("invalid", "samples[1].num_frames: expected others, got these"),
        ("internal", REASON),
    ]
    assert model.batches == [5]  # two requests cannot be read, another has two samples
    assert model.samples == {
        ("progress", "refused"): 3, ("progress", "scored"): 1, ("progress", "failed"): 1,
        ("unknown", "refused"): 1, ("unknown", "failed"): 1,
    }  # fmt: skip
    assert model.told("frames_total") == {(): 1}  # of scored samples
    refused = [line for line in LOGGED if re.search(r" DEBUG rfm/1\[\d+\]: refused \((progress|unknown)\): ", line)]
    failed = [line for line in LOGGED if re.search(r" ERROR rfm/1\[\d+\]: failed \((progress|unknown)\): ", line)]
    assert (len(refused), len(failed)) == (3, 2)


def test_a_question_that_cannot_be_prepared_is_refused_with_its_place(tmp_path: Path) -> None:
    class Picky(Model):
        def prepare(self, question: Sample) -> tuple[Any, int]:
            if question.trajectories[0].num_frames == 7:
                raise InvalidSampleError.at("num_frames", "another", "7")
            return super().prepare(question)

    model = Picky(tmp_path)
    outcomes = [response.error for response in model.respond(request(7), request(1, 7), request(5))]
    expected = ("num_frames: expected another, got 7", "samples[1].num_frames: expected another, got 7")
    assert outcomes == [("invalid", expected[0]), ("invalid", expected[1]), None]
    assert model.batches == [1]


def test_a_request_that_breaks_a_batch_is_found(tmp_path: Path) -> None:
    model = Model(tmp_path)
    responses = model.respond(request(1, id="a"), request(BREAKS, id="b"), request(5, id="c"))
    assert [response.error for response in responses] == [None, ("internal", REASON), None]
    assert model.batches == [3, 1, 1, 1]
    together = [line for line in LOGGED if " request=a,b,c: " in line]
    alone = [line for line in LOGGED if " request=b: " in line]
    assert [*together, *alone] == LOGGED
    assert together[0].endswith("the batch failed, now each request is scored alone")
    assert alone[0].endswith(f": failed (progress): {REASON}")
    assert [lines[-1].endswith(": RuntimeError: made up") for lines in (together, alone)] == [True, True]
    assert model.samples == {("progress", "scored"): 2, ("progress", "failed"): 1}


def test_answers_that_cannot_be_written_fail_alone(tmp_path: Path) -> None:
    class Large(Model):
        def encode(self, answers: Sequence[Result], tensors: wire.Tensors, outputs: Collection[str]) -> wire.Tensors:
            if len(answers) == 2:
                raise MemoryError
            return super().encode(answers, tensors, outputs)

    model = Large(tmp_path)
    good, bad = model.respond(request(1), request(5, 6))
    assert (good.error, bad.error) == (None, ("internal", REASON))
    assert model.samples == {("progress", "scored"): 1, ("progress", "failed"): 2}


def test_a_log_that_cannot_be_written_costs_no_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError("no space")

    model = Model(tmp_path)
    monkeypatch.setattr("rfm.triton_model.request.logger.log", full)
    responses = model.respond(request(1), request(BREAKS))
    assert [response.error for response in responses] == [None, ("internal", REASON)]
    assert model.samples == {("progress", "scored"): 1, ("progress", "failed"): 1}


class Slow(Model):
    """Takes ``seconds`` of a stopped clock for a batch of several questions."""

    seconds = now_s = 0.0

    def answer(self, questions: Sequence[Sample], execution: Execution) -> list[Result | RewardError]:
        self.now_s += self.seconds if len(questions) > 1 else 0.0
        return super().answer(questions, execution)


@pytest.fixture
def slow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Slow:
    model = Slow(tmp_path)
    monkeypatch.setattr(batch_model, "time", SimpleNamespace(monotonic=lambda: model.now_s))
    return model


def test_a_cancelled_request_is_not_scored(slow: Slow) -> None:
    """Also after a split batch whose last request took no time."""
    slow.seconds = 1.5 * ASKING_S
    slow.respond(request(1), request(BREAKS))
    cancelled, scored = slow.respond(request(5, is_given_up=True), request(6))
    assert cancelled.error == ("cancelled", "cancelled by the client")
    assert scored.error is None
    (scored,) = slow.respond(request(5, is_given_up=True))  # asking would take longer than a batch that took no time
    assert scored.error is None
    assert slow.samples[("progress", "cancelled")] == 1


def test_all_cancelled_requests_ahead_of_the_others_are_dropped_behind_a_short_batch(slow: Slow) -> None:
    """Asking behind a living request is worth it only behind a long batch."""
    slow.seconds = 1.5 * ASKING_S
    slow.respond(request(1, 1))
    asked = [request(5, is_given_up=True), request(6, is_given_up=True), request(7), request(8, is_given_up=True)]
    assert [response.error is None for response in slow.respond(*asked)] == [False, False, True, True]
    slow.seconds = 5 * ASKING_S
    slow.respond(request(1, 1))
    asked = [request(7), request(8, is_given_up=True)]
    assert [response.error is None for response in slow.respond(*asked)] == [True, False]


def test_a_request_without_samples_is_refused(tmp_path: Path) -> None:
    model = Model(tmp_path)
    empty = Request({name: array[:0] for name, array in request(1).tensors.items()})
    without_axis = Request({name: array[0] for name, array in request(1).tensors.items()})
    *refused, scored = model.respond(empty, without_axis, request(1))
    told = ("invalid", "num_frames: expected a batch of at least 1 sample, got 0 samples")
    assert [response.error for response in refused] == [told, told]
    assert scored.error is None
    assert [line.endswith(f": refused (unknown): {told[1]}") for line in LOGGED] == [True, True]


def test_warm_ups_and_probes_are_not_counted(tmp_path: Path) -> None:
    model = Model(tmp_path, warmups=2)
    blank = Request(probe_request(CONFIG), id=f"{PROBE_PREFIX}-rfm")
    model.respond(request(1), request(5), blank, request(1, id="caller"))
    assert model.samples == {("progress", "scored"): 1}
    model.respond(request(1), request(1, id="caller"))
    assert model.samples == {("progress", "scored"): 3}


def test_metrics_report_the_costs_of_an_execution(tmp_path: Path) -> None:
    class Working(Model):
        def answer(self, questions: Sequence[Sample], execution: Execution) -> list[Result | RewardError]:
            execution.collate_s, execution.forward_s = 0.25, 0.5
            execution.add_tokens(6, 8)
            execution.num_encoded, execution.num_found, execution.cache_bytes = 3, 2, 1000
            execution.out_of_memory_count, execution.num_unclear, execution.num_unreadable = 1, 2, 3
            execution.on_forward()
            return super().answer(questions, execution)

    model = Working(tmp_path)
    model.respond(request(1), request(5, 6))
    model.respond(Request(probe_request(CONFIG), id=PROBE_PREFIX))
    model.finalize()
    told = {metric.name: metric.value for metric in METRICS if metric.value and metric.name != "rfm_samples_total"}
    assert told == {
        "rfm_frames_total": 12, "rfm_out_of_memory_retries_total": 2, "rfm_frames_encoded_total": 6,
        "rfm_unclear_answers_total": 2, "rfm_unreadable_answers_total": 3,
        "rfm_feature_cache_hits_total": 4, "rfm_feature_cache_misses_total": 6, "rfm_feature_cache_bytes": 1000,
        "rfm_forward_passes_total": 4, "rfm_batch_samples": 3, "rfm_batch_padding_ratio": 0.25,
        "rfm_collate_seconds": 0.25, "rfm_forward_seconds": 0.5,
    }  # fmt: skip


def test_a_model_without_its_metrics_serves_all_the_same_and_says_so_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Triton refuses the name of a metric of another kind."""

    def refused(*_: Any, **__: Any) -> None:
        raise ValueError("of another kind")

    monkeypatch.setattr("triton_python_backend_utils.MetricFamily.__init__", refused)
    model = Model(tmp_path)
    for _ in range(3):
        assert [response.error for response in model.respond(request(1), request(5))] == [None, None]
    assert [line.endswith(": metrics cannot be reported") for line in LOGGED].count(True) == 1
    assert LOGGED[-1].endswith(": ValueError: of another kind")


def test_metrics_have_the_checkpoint_and_each_sample_type(tmp_path: Path) -> None:
    Model(tmp_path, description=Description(source="org/name", network={"class": "Rewind"}))
    (told,) = (metric for metric in METRICS if metric.name == "rfm_checkpoint_info")
    assert told.value == 1
    assert told.labels == {
        "model": "rfm", "version": "1", "source": "org/name", "revision": "", "weights_digest": "", "network": "Rewind",
    }  # fmt: skip
    kinds = {metric.labels["sample_type"] for metric in METRICS if metric.name == "rfm_samples_total"}
    assert kinds == {"progress", "preference", "similarity", "unknown"}


@pytest.mark.parametrize(
    ("outcome", "is_broken"),
    [
        (None, False),
        (InvalidSampleError("made up"), False),
        (InferenceFailedError("no memory"), False),
        (RuntimeError, True),
    ],
)
def test_an_instance_that_raises_at_the_blank_sample_after_failed_batches_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, outcome: Any, is_broken: bool
) -> None:
    """A checkpoint may refuse blank frames, and memory may be short for a moment; a lost device raises."""
    ended: list[str] = []
    monkeypatch.setattr("rfm.triton_model.watchdog.end", ended.append)

    class Blank(Model):
        has_warmed_up = False

        def answer(self, questions: Sequence[Sample], execution: Execution) -> list[Result | RewardError]:
            if not self.has_warmed_up:
                self.has_warmed_up = True
                return super().answer(questions, execution)
            if outcome is RuntimeError or len(questions[0].trajectories[0].positions) == BREAKS:
                raise RuntimeError("CUDA error")
            score = np.zeros(questions[0].trajectories[0].num_frames, np.float32)
            return [outcome or ProgressResult(progress=score, success=score)]

    model = Blank(tmp_path, warmups=1)
    model.respond(request(1))
    for _ in range(FAILED_BATCHES):
        assert ended == []
        model.respond(request(BREAKS))
    assert bool(ended) is is_broken


def test_requests_are_scored_in_the_thread_that_calls_execute_and_the_watchdog_knows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Warm-ups, too: else OpenMP has two teams of threads."""
    threads = []

    class Watched(Model):
        def answer(self, questions: Sequence[Sample], execution: Execution) -> list[Result | RewardError]:
            threads.append(threading.current_thread())
            assert is_working()
            return super().answer(questions, execution)

    watchdogs: list[Callable[[], bool]] = []

    class SeenWatchdog(Watchdog):
        def __init__(self, hang_s: float, is_working: Callable[[], bool]) -> None:
            watchdogs.append(is_working)
            super().__init__(hang_s, is_working)

    monkeypatch.setattr(batch_model, "Watchdog", SeenWatchdog)
    model = Watched(tmp_path, warmups=1)
    (is_working,) = watchdogs
    for requests in ([request(1)], [request(5), request(6)]):
        assert not is_working()
        model.execute(requests)
    assert not is_working()
    assert threads == [threading.current_thread()] * 2


RELEASE = torch.__version__.partition("+")[0]


@pytest.mark.parametrize(
    "told", ["", f"torch {torch.__version__}, sdpa", f"torch {RELEASE}+cu0, sdpa", "torch 1.0, sdpa"]
)
def test_an_instance_notes_that_labels_name_another_pytorch(tmp_path: Path, told: str) -> None:
    """Clients read the PyTorch of the export, and write it into label files."""
    Model(tmp_path, description=Description(computation=told))
    noted = [line for line in LOGGED if "labels will name" in line]
    assert len(noted) == ("torch 1.0" in told)
    assert all(f"export with torch {torch.__version__}" in note for note in noted)


@pytest.mark.parametrize(("kind", "gpus"), [("CPU", []), ("GPU", [0, 1, 2, 3])])
def test_the_cores_of_a_machine_are_shared_among_the_instances(
    kind: str, gpus: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 16)
    args = {"model_instance_kind": kind, "model_instance_device_id": "3"}
    config = {"instance_group": [{"count": 2, "gpus": gpus}]}
    placement = Placement.of(args, config, {"torch_threads": "0"})
    assert placement.device == (torch.device("cuda", 3) if gpus else torch.device("cpu"))
    assert placement.num_threads == (2 if gpus else 8)
    assert num_preparing(placement.device, placement.num_threads) == (2 if gpus else 1)
    assert Placement.of(args, config, {"torch_threads": "5"}).num_threads == 5


@pytest.fixture
def _own_number_of_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    use_threads(before)


@pytest.mark.usefixtures("_own_number_of_threads")
def test_a_placement_runs_functions_in_a_thread_that_ends() -> None:
    seen: list[tuple[threading.Thread, int]] = []
    use_threads(2)
    placement = Placement(torch.device("cpu"), num_threads=3)
    placement.run(lambda: seen.append((threading.current_thread(), torch.get_num_threads())))
    ((thread, num_threads),) = seen
    assert not thread.is_alive()
    assert num_threads == 3
    assert torch.get_num_threads() == 1  # the calling thread starts no team
    with pytest.raises(RuntimeError, match="positive"):  # PyTorch's message, not a thread pool's
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
