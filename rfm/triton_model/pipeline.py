# SPDX-License-Identifier: MIT
"""A pipeline that prepares, scores and answers requests at the same time. Independent of Triton.

For models whose samples take long to prepare: it prepares the next batch while the device scores. Other models score
in ``execute``, which takes half the CPU time per request.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from queue import SimpleQueue
from typing import Any

from rfm.engine.threads import num_preparing, use_threads
from rfm.triton_model.placement import Placement
from rfm.triton_model.request import Request
from rfm.triton_model.watchdog import end


class Pipeline:
    """Scores prepared requests in order, as soon as they are ready. Must be closed.

    prepare: does a request's slow part, in a preparing thread; errors are ignored
    score: scores a batch, always in the same thread, because libgomp keeps a team of threads per computing thread
    reply: sends the results from ``score``
    max_samples, max_tokens: batch limits; a larger request is its own batch

    An exception in ``score`` or ``reply`` ends the process.
    """

    def __init__(
        self,
        prepare: Callable[[Request[Any]], None],
        score: Callable[[list[Request[Any]]], Any],
        reply: Callable[[Any], None],
        placement: Placement,
        max_samples: int,
        max_tokens: int,
    ) -> None:
        self._prepare, self._score, self._reply, self._placement = prepare, score, reply, placement
        self._max_samples, self._max_tokens = max_samples, max_tokens
        self._changed = threading.Condition()
        self._waiting: deque[tuple[Request[Any], Future[None]]] = deque()
        self._call: Callable[[], None] | None = None  # what ``run`` gives the scoring thread to do
        self._is_scoring = self._is_closed = False
        self._scored: SimpleQueue[Any] = SimpleQueue()  # None ends it
        self._preparing = ThreadPoolExecutor(
            num_preparing(placement.device, placement.num_threads), "rfm-prepare", partial(use_threads, 1)
        )
        self._threads = [
            threading.Thread(target=_to_the_end, args=(stage,), name=f"rfm-{name}", daemon=True)
            for name, stage in {"score": self._score_all, "reply": self._reply_to_all}.items()
        ]
        for thread in self._threads:
            thread.start()

    @property
    def is_idle(self) -> bool:
        """True if no request waits or is being scored."""
        with self._changed:
            return not (self._is_scoring or self._waiting)

    def put(self, requests: Iterable[Request[Any]]) -> None:
        """Add requests. Return when less than a full batch waits."""
        with self._changed:
            self._waiting += [(request, self._preparing.submit(self._prepare, request)) for request in requests]
            self._changed.notify_all()
            self._changed.wait_for(self._has_room)

    def run(self, requests: list[Request[Any]]) -> Any:
        """Score requests in the idle scoring thread, without preparing them first. Return the result of ``score``."""
        future: Future[Any] = Future()
        with self._changed:
            self._call = lambda: future.set_result(self._score(requests))
            self._is_scoring = True
            self._changed.notify_all()
        return future.result()

    def close(self) -> None:
        """Answer all requests, then stop the threads."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()
        self._preparing.shutdown()

    def _has_room(self) -> bool:
        """True if less than a full batch waits."""
        num_samples = sum(request.num_samples for request, _ in self._waiting)
        num_tokens = sum(request.num_tokens for request, _ in self._waiting)
        return not self._waiting or (num_samples < self._max_samples and num_tokens < self._max_tokens)

    def _score_all(self) -> None:
        self._placement.apply()
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
                self._scored.put(self._score(self._next_batch()))
            with self._changed:
                self._is_scoring = False
        self._scored.put(None)

    def _next_batch(self) -> list[Request[Any]]:
        """Wait for the first request; return it with the next prepared requests that fit into the same batch."""
        self._waiting[0][1].exception()  # waits; if preparing failed, ``score`` meets the same error
        with self._changed:
            batch = [self._waiting.popleft()[0]]
            num_samples, num_tokens = batch[0].num_samples, batch[0].num_tokens
            while self._waiting and self._waiting[0][1].done():
                request, _ = self._waiting[0]
                num_samples, num_tokens = num_samples + request.num_samples, num_tokens + request.num_tokens
                if num_samples > self._max_samples or num_tokens > self._max_tokens:
                    break
                batch.append(self._waiting.popleft()[0])
            self._changed.notify_all()
        return batch

    def _reply_to_all(self) -> None:
        while (scored := self._scored.get()) is not None:
            self._reply(scored)


def _to_the_end(stage: Callable[[], None]) -> None:
    try:
        stage()
    except BaseException:  # noqa: BLE001  without this stage no request is answered
        end("its pipeline has failed")
