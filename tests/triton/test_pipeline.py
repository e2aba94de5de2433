# SPDX-License-Identifier: MIT
"""A model with work ahead: batches, the return of ``execute``, and faults."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from batch_models import BREAKS, CONFIG, MODELS, REFUSED, Model, Request, backend, request  # noqa: F401  a fixture
from rfm.engine import Execution
from rfm.triton_model.pipeline import Pipeline
from rfm.triton_model.placement import Placement
from rfm_client import Result, RewardError, Sample
from servers import PATIENCE_S, wait_for

MAX_BATCH = 8
assert CONFIG["max_batch_size"] == MAX_BATCH


class Ahead(Model):
    """Works ahead, and answers when it may."""

    def __init__(self, folder: Path, **more: Any) -> None:
        self.may_answer, self.may_prepare = threading.Event(), threading.Event()
        self.may_prepare.set()
        self.prepared: list[int] = []
        self.threads: set[str] = set()
        super().__init__(folder, **more)

    @property
    def works_ahead(self) -> bool:
        return True

    def prepare(self, question: Sample) -> tuple[Sample, int]:
        return question, question.trajectories[0].num_frames

    def work_ahead(self, prepared: Sample) -> None:
        assert self.may_prepare.wait(PATIENCE_S)
        self.prepared.append(prepared.trajectories[0].num_frames)

    def answer(self, questions: Sequence[Sample], execution: Execution) -> list[Result | RewardError]:
        self.threads.add(threading.current_thread().name)
        outcome = super().answer(questions, execution)
        assert self.may_answer.wait(PATIENCE_S)
        return outcome

    def finalize(self) -> None:
        self.may_prepare.set()
        super().finalize()

    def begin(self) -> list[Request]:
        """Start to score one or two prepared requests, which ``open`` lets answer."""
        first = [request(1), request(1)]
        self.take(*first)
        wait_for(lambda: self.batches and len(self.prepared) == 2)
        return first

    def open(self, *requests: Request) -> None:
        self.may_answer.set()
        wait_for(lambda: all(len(request.responses) == 1 for request in requests))


def test_a_lone_request_on_an_idle_model_is_answered_by_execute(tmp_path: Path) -> None:
    model = Ahead(tmp_path)
    model.may_answer.set()
    lone = request(5)
    model.take(lone)
    assert [response.error for response in lone.responses] == [None]
    assert model.prepared == []  # other requests are prepared in turn


def test_requests_that_come_while_a_batch_is_scored_are_prepared_and_form_the_next(tmp_path: Path) -> None:
    model = Ahead(tmp_path)
    first = model.begin()
    later = [request(count) for count in (5, 6, 7)]
    for each in later:
        model.take(each)
    wait_for(lambda: sorted(model.prepared)[-3:] == [5, 6, 7])
    model.open(*first, *later)
    assert model.batches in ([2, 3], [1, 4])
    assert model.threads == {"rfm-score"}
    assert model.samples == {("progress", "scored"): 5}


def test_requests_that_are_not_prepared_wait_for_another_batch(tmp_path: Path) -> None:
    model = Ahead(tmp_path)
    first = model.begin()
    model.may_prepare.clear()
    late = [request(5), request(6)]
    model.take(*late)
    model.may_answer.set()
    wait_for(lambda: all(each.responses for each in first))
    assert not any(each.responses for each in late)
    model.may_prepare.set()
    model.open(*late)


def test_execute_returns_when_less_than_a_batch_waits_and_no_batch_is_larger_than_triton_s(tmp_path: Path) -> None:
    model = Ahead(tmp_path)
    first = model.begin()
    many = [request(5) for _ in range(MAX_BATCH + 1)]
    with ThreadPoolExecutor(1) as pool:
        taken = pool.submit(model.take, *many)
        wait_for(lambda: len(model.prepared) == len(first) + len(many))
        assert not taken.done()  # the rest waits in Triton, where another instance can take it
        model.open(*first, *many)
        taken.result(PATIENCE_S)
    assert max(model.batches) <= MAX_BATCH
    assert sum(model.batches) == len(first) + len(many)


def test_a_batch_has_no_more_tokens_than_its_budget(tmp_path: Path) -> None:
    model = Ahead(tmp_path, settings={"token_budget": "12"})
    first = model.begin()
    later = [request(5), request(6)]  # two frames more are too many
    more = request(7)
    with ThreadPoolExecutor(1) as pool:  # the first call waits if these requests and one of the first fill a batch
        pool.submit(model.take, *later)
        pool.submit(model.take, more)
        wait_for(lambda: 6 in model.prepared)
        model.open(*first, *later, more)
    assert model.batches in ([2, 2, 1], [1, 3, 1])


def test_a_batch_is_filled_up_to_exactly_its_limit_of_tokens() -> None:
    may_score, prepared, batches = threading.Event(), list[Any](), list[list[int]]()

    def score(batch: Sequence[Any]) -> Sequence[Any]:
        batches.append([each.num_tokens for each in batch])
        assert may_score.wait(PATIENCE_S)
        return batch

    pipeline = Pipeline(prepared.append, score, id, Placement(torch.device("cpu"), 1), MAX_BATCH, 12)
    first, *full, last = (cast(Any, SimpleNamespace(num_samples=1, num_tokens=count)) for count in (2, 5, 3, 4, 1))
    pipeline.put([first])
    wait_for(lambda: batches)
    with ThreadPoolExecutor(2) as pool:
        taken = pool.submit(pipeline.put, full)
        wait_for(lambda: len(prepared) == 4)
        assert not taken.done()
        pool.submit(pipeline.put, [last])
        wait_for(lambda: len(prepared) == 5)
        may_score.set()
    pipeline.close()
    assert batches == [[2], [5, 3, 4], [1]]


def test_refused_failed_and_cancelled_requests_fail_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rfm.triton_model.batch_model.ASKING_S", 1e-9)  # any batch is long enough to ask
    model = Ahead(tmp_path)
    first = model.begin()
    unreadable = Request(request(1).tensors | {"num_frames": np.zeros((1, 2), np.int32)})
    requests = [request(REFUSED), request(BREAKS), unreadable, request(5, is_given_up=True), request(6)]
    model.take(*requests)
    model.open(*first, *requests)
    assert [response.error and response.error[0] for each in requests for response in each.responses] == [
        "invalid", "internal", "invalid", "cancelled", None,
    ]  # fmt: skip


def test_a_request_for_which_there_is_no_memory_fails_alone(tmp_path: Path) -> None:
    model = Ahead(tmp_path)
    model.may_answer.set()

    class Large(np.ndarray):  # type: ignore[type-arg]
        def copy(self, order: Any = None) -> Any:
            raise MemoryError

    large = request(5)
    large.tensors["video_embeddings"] = large.tensors["video_embeddings"].view(Large)
    failed, scored = model.respond(large, request(6))
    assert failed.error == ("internal", "scoring failed; the server's log has the reason")
    assert scored.error is None


def test_a_model_is_unloaded_when_all_are_answered(tmp_path: Path) -> None:
    model = Ahead(tmp_path)
    requests = [*model.begin(), request(5)]
    model.take(*requests[-1:])
    with ThreadPoolExecutor(1) as pool:
        unloaded = pool.submit(model.finalize)
        wait_for(lambda: 5 in model.prepared)
        assert not unloaded.done()
        model.may_answer.set()
        unloaded.result(PATIENCE_S)
    assert all(len(each.responses) == 1 for each in requests)


@pytest.fixture(autouse=True)
def _all_may_answer() -> Iterator[None]:
    yield
    for model in MODELS:
        model.may_answer.set()  # type: ignore[attr-defined]


BROKEN = """
import os
from types import SimpleNamespace
import torch
from rfm.triton_model.pipeline import Pipeline
from rfm.triton_model.placement import Placement
def broken(_):
    raise SystemError("made up")
for stage in ("score", "reply"):
    if not os.fork():
        stages = {"score": lambda batch: batch, "reply": broken, stage: broken}
        pipeline = Pipeline(id, stages["score"], stages["reply"], Placement(torch.device("cpu"), 1), 8, 8)
        pipeline.put([SimpleNamespace(num_samples=1, num_tokens=1)] * 2)
        pipeline.close()
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.wait()[1]))
"""


@pytest.mark.slow
def test_a_pipeline_that_breaks_ends_the_process() -> None:
    """In either stage, since nothing would be answered any more."""
    command = [sys.executable, "-c", BROKEN]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert ended.stdout == "1\n1\n", ended.stderr
    assert ended.stderr.count("\nSystemError: made up") == 2
    assert ended.stderr.count("the model process ends: its pipeline has failed") == 2
