# SPDX-License-Identifier: MIT
"""Jobs are prepared, scored and replied to, each beside the others. No Triton in it.

For models whose samples take long to prepare: a device that scores has the next batch ready. Other models score in
``execute``, which takes half as much CPU time for a request.
"""

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


SomeJob = TypeVar("SomeJob", bound=Job)
Scored = TypeVar("Scored")


@dataclass(frozen=True)
class Stages(Generic[SomeJob, Scored]):
    """What is done with jobs. An exception of ``prepare`` is ignored; any other ends the process, by ``fail``.

    prepare: of one job, in one of ``num_preparing`` threads; of a model its ``work_ahead``
    score: of a batch, always in the same thread: libgomp has a team of threads for each thread that computes
    reply: with what ``score`` gave
    begin_preparing, begin_scoring: called once in each thread of that kind
    """

    prepare: Callable[[SomeJob], None]
    score: Callable[[list[SomeJob]], Scored]
    reply: Callable[[Scored], None]
    fail: Callable[[], None]
    begin_preparing: Callable[[], None] = lambda: None
    begin_scoring: Callable[[], None] = lambda: None
    num_preparing: int = 1


class Pipeline(Generic[SomeJob, Scored]):
    """Scores what is prepared the moment it can, in the order in which it came. To be closed.

    batch_samples, batch_tokens: of one batch, at most; a larger job is a batch of its own
    """

    def __init__(self, stages: Stages[SomeJob, Scored], batch_samples: int, batch_tokens: int) -> None:
        self._stages, self._batch_samples, self._batch_tokens = stages, batch_samples, batch_tokens
        self._changed = threading.Condition()
        self._waiting: deque[tuple[SomeJob, Future[None]]] = deque()
        self._call: Callable[[], None] | None = None  # that ``run`` waits for
        self._is_scoring = self._is_closed = False
        self._scored: SimpleQueue[Scored | None] = SimpleQueue()  # None: there will be no more
        self._preparing = ThreadPoolExecutor(stages.num_preparing, "rfm-prepare", stages.begin_preparing)
        self._threads = [
            threading.Thread(target=self._to_the_end, args=(stage,), name=f"rfm-{name}", daemon=True)
            for name, stage in {"score": self._score_all, "reply": self._reply_to_all}.items()
        ]
        for thread in self._threads:
            thread.start()

    @property
    def is_idle(self) -> bool:
        """Whether no job waits and none is scored."""
        with self._changed:
            return not (self._is_scoring or self._waiting)

    def put(self, jobs: Iterable[SomeJob]) -> None:
        """Take jobs in. Returns when no more than one batch waits behind the one that is scored."""
        with self._changed:
            self._waiting += [(job, self._preparing.submit(self._stages.prepare, job)) for job in jobs]
            self._changed.notify_all()
            self._changed.wait_for(self._has_room)

    def run(self, jobs: list[SomeJob]) -> Scored:
        """Score jobs that are not prepared in the scoring thread, which is idle, and give what ``score`` gave."""
        future: Future[Scored] = Future()
        with self._changed:
            self._call = lambda: future.set_result(self._stages.score(jobs))
            self._is_scoring = True
            self._changed.notify_all()
        return future.result()

    def close(self) -> None:
        """Return when all jobs have been replied to."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()
        self._preparing.shutdown()

    def _has_room(self) -> bool:
        """Whether what waits is less than a batch."""
        num_samples = sum(job.num_samples for job, _ in self._waiting)
        num_tokens = sum(job.num_tokens for job, _ in self._waiting)
        return not self._waiting or (num_samples < self._batch_samples and num_tokens < self._batch_tokens)

    def _score_all(self) -> None:
        self._stages.begin_scoring()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._call or self._waiting or self._is_closed)
                if not (self._call or self._waiting):
                    break
                self._is_scoring = True
                call, self._call = self._call, None
            if call is not None:
                call()
            else:
                self._scored.put(self._stages.score(self._next_batch()))
            with self._changed:
                self._is_scoring = False
        self._scored.put(None)

    def _next_batch(self) -> list[SomeJob]:
        """The first job, once it is prepared, and those behind it that are prepared and fit into its batch."""
        self._waiting[0][1].exception()  # waits; what is wrong with a job shows in its turn
        with self._changed:
            batch = [self._waiting.popleft()[0]]
            num_samples, num_tokens = batch[0].num_samples, batch[0].num_tokens
            while self._waiting and self._waiting[0][1].done():
                job, _ = self._waiting[0]
                num_samples, num_tokens = num_samples + job.num_samples, num_tokens + job.num_tokens
                if num_samples > self._batch_samples or num_tokens > self._batch_tokens:
                    break
                batch.append(self._waiting.popleft()[0])
            self._changed.notify_all()
        return batch

    def _reply_to_all(self) -> None:
        while (scored := self._scored.get()) is not None:
            self._stages.reply(scored)

    def _to_the_end(self, stage: Callable[[], None]) -> None:
        try:
            stage()
        except BaseException:  # noqa: BLE001  whatever it is: nothing would be answered any more
            self._stages.fail()
