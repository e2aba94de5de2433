# SPDX-License-Identifier: MIT
"""Jobs are prepared, scored and replied to, each beside the others; what waits is bounded. No Triton in it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Generic, Protocol, TypeVar


class Job(Protocol):
    """A piece of work that is scored in its turn."""

    num_samples: int
    num_tokens: int

    @property
    def may_be_rejected(self) -> bool:
        """Whether there may be no room for it."""


SomeJob = TypeVar("SomeJob", bound=Job)
Scored = TypeVar("Scored")


@dataclass(frozen=True)
class Bounds:
    """How much a pipeline takes at a time.

    batch_samples, batch_tokens: of one batch, at most; a larger job is a batch of its own
    ahead_samples: of the jobs that are prepared before their turn, at most, and no more tokens than of one batch; the
        first in turn always is
    waiting_jobs: jobs that may wait for their turn; None: any number
    """

    batch_samples: int
    batch_tokens: int
    ahead_samples: int
    waiting_jobs: int | None = None


@dataclass(frozen=True)
class Stages(Generic[SomeJob, Scored]):
    """What is done with jobs. None of it may raise: what it raises goes to ``fail``, and nothing is scored any more.

    begin: called once in the thread that scores
    begin_preparing: called once in each thread that prepares
    prepare: of one job, called in one of ``num_preparing`` threads before its turn; 0: there is nothing to prepare
    score: of a batch; never runs twice at a time
    reply: of a batch, with what ``score`` gave; may run twice at a time
    """

    score: Callable[[list[SomeJob]], Scored]
    reply: Callable[[list[SomeJob], Scored], None]
    fail: Callable[[BaseException], None]
    begin: Callable[[], None] = lambda: None
    begin_preparing: Callable[[], None] = lambda: None
    prepare: Callable[[SomeJob], None] = lambda job: None
    num_preparing: int = 0


class Pipeline(Generic[SomeJob, Scored]):
    """Scores the jobs that wait the moment it can, in the order in which they came. To be closed."""

    def __init__(self, stages: Stages[SomeJob, Scored], bounds: Bounds) -> None:
        self._stages, self._bounds = stages, bounds
        self._changed = threading.Condition()
        self._is_scoring = self._is_closed = False
        self._ahead: deque[tuple[SomeJob, Future[None] | None]] = deque()  # prepared, or being prepared
        self._behind: deque[SomeJob] = deque()  # those after them
        self._awaited: tuple[list[SomeJob], Future[Scored]] | None = None  # jobs that ``run`` waits for
        self._broken: BaseException | None = None  # why nothing is scored any more
        self._scored: SimpleQueue[tuple[list[SomeJob], Scored] | None] = SimpleQueue()  # None: there will be no more
        self._preparing = (
            ThreadPoolExecutor(stages.num_preparing, "rfm-prepare", stages.begin_preparing)
            if stages.num_preparing
            else None
        )
        self._threads = [
            threading.Thread(target=self._to_the_end, args=(stage,), name=f"rfm-{name}", daemon=True)
            for name, stage in {"score": self._score_all, "reply": self._reply_to_all}.items()
        ]
        for thread in self._threads:
            thread.start()

    @property
    def num_waiting(self) -> int:
        """Jobs that wait for their turn."""
        return len(self._ahead) + len(self._behind)

    @property
    def num_samples_waiting(self) -> int:
        """Samples of the jobs that wait for their turn."""
        with self._changed:
            return sum(job.num_samples for job, _ in self._ahead) + sum(job.num_samples for job in self._behind)

    @property
    def is_idle(self) -> bool:
        """Whether no job waits and none is scored."""
        return not (self._is_scoring or self.num_waiting)

    def put(self, jobs: Iterable[SomeJob]) -> list[SomeJob]:
        """Takes the jobs in, and gives back those for which there is no room."""
        rejected = []
        with self._changed:
            for job in jobs:
                limit = self._bounds.waiting_jobs
                if limit is not None and self.num_waiting >= limit and job.may_be_rejected:
                    rejected.append(job)
                else:
                    self._behind.append(job)
            self._look_ahead()
            self._changed.notify_all()
        return rejected

    def run(self, jobs: list[SomeJob]) -> Scored:
        """Scores jobs, prepared or not, and gives what ``score`` gave. Nobody is replied to. To be called by who puts,
        while it is idle. Raises the error with which scoring has ended.

        They are scored in the thread that scores all others. libgomp has a team of threads for each thread that
        computes; with two teams it counts more threads than cores, and no longer spins where they wait for each other.
        """
        scored: Future[Scored] = Future()
        with self._changed:
            if self._broken is not None:
                raise self._broken
            assert self.is_idle
            self._is_scoring = True
            self._awaited = jobs, scored
            self._changed.notify_all()
        return scored.result()

    def wait_for(self, is_so: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Waits until jobs have moved on so far that ``is_so``, or for ``timeout_s``; whether it is."""
        with self._changed:
            return self._changed.wait_for(is_so, timeout_s)

    def close(self) -> None:
        """Returns when all jobs have been replied to."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()
        if self._preparing is not None:
            self._preparing.shutdown()

    def _look_ahead(self) -> None:
        """Begins to prepare the jobs whose turn comes soon."""
        num_samples = sum(job.num_samples for job, _ in self._ahead) if self._preparing else 0
        num_tokens = sum(job.num_tokens for job, _ in self._ahead) if self._preparing else 0
        while self._behind:
            num_samples, num_tokens = num_samples + self._behind[0].num_samples, num_tokens + self._behind[0].num_tokens
            is_too_far = num_samples > self._bounds.ahead_samples or num_tokens > self._bounds.batch_tokens
            if self._preparing and self._ahead and is_too_far:
                break
            job = self._behind.popleft()
            preparation = self._preparing.submit(self._stages.prepare, job) if self._preparing else None
            self._ahead.append((job, preparation))

    def _next_batch(self) -> list[SomeJob]:
        """The jobs whose turn it is, as many as are prepared and fit; none if ``run`` waits, or nothing will come."""
        with self._changed:
            self._changed.wait_for(lambda: self._awaited or self._ahead or self._is_closed)
            if self._awaited is not None or not self._ahead:
                return []
            self._is_scoring = True
            _, preparation = self._ahead[0]
        if preparation is not None:
            preparation.result()
        with self._changed:
            batch = self._taken()
            self._look_ahead()
            self._changed.notify_all()
        return batch

    def _taken(self) -> list[SomeJob]:
        """Takes the first job and those behind it that are prepared and fit into its batch."""
        batch = [self._ahead.popleft()[0]]
        num_samples, num_tokens = batch[0].num_samples, batch[0].num_tokens
        while self._ahead:
            job, preparation = self._ahead[0]
            if preparation is not None and not preparation.done():
                break
            num_samples, num_tokens = num_samples + job.num_samples, num_tokens + job.num_tokens
            if num_samples > self._bounds.batch_samples or num_tokens > self._bounds.batch_tokens:
                break
            batch.append(job)
            self._ahead.popleft()
        return batch

    def _score(self, batch: list[SomeJob]) -> Scored:
        try:
            return self._stages.score(batch)
        finally:
            with self._changed:
                self._is_scoring = False
                self._changed.notify_all()

    def _score_all(self) -> None:
        try:
            self._stages.begin()
            while (batch := self._next_batch()) or self._awaited is not None:
                if self._awaited is None:
                    self._scored.put((batch, self._score(batch)))
                else:
                    self._score_awaited(*self._awaited)
        except BaseException as error:
            self._break(error)
            raise
        self._scored.put(None)

    def _score_awaited(self, jobs: list[SomeJob], scored: Future[Scored]) -> None:
        result = self._score(jobs)
        self._awaited = None
        scored.set_result(result)

    def _break(self, error: BaseException) -> None:
        """From now on nothing is scored. Who waits in ``run`` is told."""
        with self._changed:
            self._broken = error
            awaited, self._awaited = self._awaited, None
        if awaited is not None:
            awaited[1].set_exception(error)

    def _reply_to_all(self) -> None:
        while (scored := self._scored.get()) is not None:
            self._stages.reply(*scored)

    def _to_the_end(self, stage: Callable[[], None]) -> None:
        try:
            stage()
        except BaseException as error:  # noqa: BLE001  whoever waits for an answer shall not wait for ever
            self._stages.fail(error)
