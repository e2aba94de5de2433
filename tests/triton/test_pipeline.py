# SPDX-License-Identifier: MIT
"""The pipeline by itself: what is scored together, when, and what finds no room."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field

import pytest

from rfm.triton_model.pipeline import Bounds, Pipeline, Stages
from rfm_serve import PATIENCE_S, wait_for

BOUNDS = Bounds(batch_samples=4, batch_tokens=100, ahead_samples=4)


@dataclass(eq=False)
class Job:
    num_samples: int = 1
    num_tokens: int = 1
    may_be_rejected: bool = True
    may_be_prepared: threading.Event = field(default_factory=threading.Event)


@dataclass
class Work:
    """What a pipeline was seen to do. ``may_score``: batches are scored when it is set."""

    may_score: threading.Event = field(default_factory=threading.Event)
    prepared: list[Job] = field(default_factory=list)
    batches: list[list[Job]] = field(default_factory=list)
    replied: list[Job] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    threads: set[str] = field(default_factory=set)

    def prepare(self, job: Job) -> None:
        assert job.may_be_prepared.wait(PATIENCE_S)
        self.prepared.append(job)

    def score(self, batch: list[Job]) -> list[int]:
        self.batches.append(batch)
        self.threads.add(threading.current_thread().name)
        assert self.may_score.wait(PATIENCE_S)
        return [job.num_tokens for job in batch]

    def reply(self, batch: list[Job], scored: list[int]) -> None:
        assert scored == [job.num_tokens for job in batch]
        self.replied += batch

    def fail(self, error: BaseException) -> None:
        self.failures.append(repr(error))


@contextmanager
def running(work: Work, bounds: Bounds = BOUNDS, num_preparing: int = 0) -> Iterator[Pipeline[Job, list[int]]]:
    pipeline = Pipeline(
        Stages(work.score, work.reply, work.fail, prepare=work.prepare, num_preparing=num_preparing), bounds
    )
    try:
        yield pipeline
    finally:
        work.may_score.set()
        pipeline.close()


@contextmanager
def busy(work: Work, bounds: Bounds = BOUNDS, num_preparing: int = 0) -> Iterator[Pipeline[Job, list[int]]]:
    """A pipeline that has begun to score one job."""
    with running(work, bounds, num_preparing) as pipeline:
        first = Job()
        first.may_be_prepared.set()
        pipeline.put([first])
        wait_for(lambda: len(work.batches) == 1)
        yield pipeline


def sizes(work: Work) -> list[list[int]]:
    return [[job.num_samples for job in batch] for batch in work.batches]


def test_a_batch_holds_what_waits_up_to_its_samples() -> None:
    work = Work()
    with busy(work) as pipeline:
        assert pipeline.put([Job(2), Job(1), Job(1), Job(3), Job(2), Job(9), Job(1)]) == []
    assert sizes(work) == [[1], [2, 1, 1], [3], [2], [9], [1]]  # in order; what is larger than a batch is one
    assert work.replied == [job for batch in work.batches for job in batch]


def test_a_batch_holds_what_waits_up_to_its_tokens() -> None:
    work = Work()
    with busy(work) as pipeline:
        pipeline.put(
            [Job(num_tokens=60), Job(num_tokens=40), Job(num_tokens=41), Job(num_tokens=60), Job(num_tokens=1)]
        )
    assert [[job.num_tokens for job in batch] for batch in work.batches[1:]] == [[60, 40], [41], [60, 1]]


def test_what_finds_no_room_is_given_back_and_what_may_not_be_rejected_finds_some() -> None:
    work = Work()
    with busy(work, Bounds(4, 100, 4, waiting_jobs=2)) as pipeline:
        waiting, late, urgent = [Job(), Job()], [Job(), Job()], Job(may_be_rejected=False)
        assert pipeline.put(waiting) == []
        assert pipeline.put([late[0], urgent, late[1]]) == late
        assert pipeline.num_waiting == 3
    assert work.batches[1:] == [[*waiting, urgent]]


def test_jobs_are_prepared_beside_the_scoring_but_not_too_many() -> None:
    work = Work()
    with busy(work, num_preparing=2) as pipeline:
        jobs = [Job(2) for _ in range(4)]
        for job in jobs:
            job.may_be_prepared.set()
        pipeline.put(jobs)
        wait_for(lambda: len(work.prepared) == 3)
        assert work.prepared[1:] == jobs[:2]  # four samples ahead of their turn, while the first job is scored
        assert len(work.batches) == 1
    assert work.batches[1:] == [jobs[:2], jobs[2:]]


def test_no_more_is_prepared_ahead_than_the_tokens_of_a_batch() -> None:
    work = Work()
    with busy(work, num_preparing=2) as pipeline:
        jobs = [Job(num_tokens=60), Job(num_tokens=40), Job(num_tokens=1)]
        for job in jobs:
            job.may_be_prepared.set()
        pipeline.put(jobs)
        wait_for(lambda: len(work.prepared) == 3)
        assert set(work.prepared[1:]) == set(jobs[:2])
        assert pipeline.num_waiting == 3
    assert work.batches[1:] == [jobs[:2], jobs[2:]]


def test_a_batch_does_not_wait_for_a_job_that_is_still_prepared_behind_it() -> None:
    work = Work()
    with busy(work, num_preparing=2) as pipeline:
        ready, slow = Job(), Job()
        ready.may_be_prepared.set()
        pipeline.put([ready, slow])
        wait_for(lambda: ready in work.prepared)
        work.may_score.set()
        wait_for(lambda: ready in work.replied)
        assert pipeline.num_waiting == 1
        slow.may_be_prepared.set()
    assert work.batches[1:] == [[ready], [slow]]


def test_an_idle_pipeline_scores_at_once_in_the_thread_that_scores_all() -> None:
    work = Work()
    with running(work) as pipeline:
        work.may_score.set()
        jobs, later = [Job(num_tokens=2), Job(num_tokens=3)], Job()
        assert pipeline.is_idle
        assert pipeline.run(jobs) == [2, 3]
        assert work.replied == []
        assert pipeline.is_idle
        pipeline.put([later])
        wait_for(lambda: work.replied == [later])
        assert pipeline.run([Job(9)]) == [1]
    assert work.threads == {"rfm-score"}
    assert sizes(work) == [[1, 1], [1], [9]]


def test_who_runs_jobs_gets_the_error_and_nothing_is_scored_any_more() -> None:
    work = Work()

    def broken(batch: list[Job]) -> list[int]:
        raise MemoryError

    pipeline = Pipeline(Stages(broken, work.reply, work.fail), BOUNDS)
    for _ in range(2):
        with pytest.raises(MemoryError):
            pipeline.run([Job()])
        wait_for(lambda: work.failures == ["MemoryError()"])


@pytest.mark.parametrize("is_early", [True, False])
def test_who_runs_jobs_does_not_wait_for_a_thread_that_could_not_begin(is_early: bool) -> None:
    work, may_begin = Work(), threading.Event()

    def begin() -> None:
        assert may_begin.wait(PATIENCE_S)
        raise MemoryError

    pipeline = Pipeline(Stages(work.score, work.reply, work.fail, begin=begin), BOUNDS)
    if is_early:
        may_begin.set()
        wait_for(lambda: work.failures == ["MemoryError()"])
    with ThreadPoolExecutor(1) as pool:
        ran = pool.submit(pipeline.run, [Job()])
        assert is_early or not pipeline.wait_for(ran.done, 0.05)
        may_begin.set()
        with pytest.raises(MemoryError):
            ran.result(PATIENCE_S)


def test_nothing_is_scored_beside_what_another_thread_scores() -> None:
    work = Work()
    with running(work) as pipeline, ThreadPoolExecutor(1) as pool:
        alone, other = Job(), Job()
        ran = pool.submit(pipeline.run, [alone])
        wait_for(lambda: work.batches == [[alone]])
        assert not pipeline.is_idle
        pipeline.put([other])
        assert not pipeline.wait_for(lambda: len(work.batches) > 1, 0.05)
        work.may_score.set()
        assert ran.result(PATIENCE_S) == [1]
    assert work.batches == [[alone], [other]]


def test_closing_waits_for_all_replies() -> None:
    work = Work()
    with busy(work) as pipeline, ThreadPoolExecutor(1) as pool:
        jobs = [Job(3), Job(3)]
        pipeline.put(jobs)
        closed = pool.submit(pipeline.close)
        assert not pipeline.wait_for(closed.done, 0.05)
        work.may_score.set()
        closed.result(PATIENCE_S)
        assert work.replied[1:] == jobs


@pytest.mark.parametrize("stage", ["score", "reply", "prepare"])
def test_a_stage_that_raises_is_told(stage: str) -> None:
    work = Work()

    def broken(*_arguments: object) -> list[int]:
        raise MemoryError(stage)

    setattr(work, stage, broken)
    work.may_score.set()
    pipeline = Pipeline(Stages(work.score, work.reply, work.fail, prepare=work.prepare, num_preparing=1), BOUNDS)
    job = Job()
    job.may_be_prepared.set()
    pipeline.put([job])
    wait_for(lambda: work.failures == [f"MemoryError('{stage}')"])
