# SPDX-License-Identifier: MIT
"""A model process that finds out by itself that it is broken, by a lost CUDA context say, and ends.

Probes do not find one broken instance among several: they go to whichever instance is free. A process that has ended is
dead, and healed as such. Inputs may fail too, so a blank sample decides: who can score that is not broken.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rfm.triton_model.request import FAILED, SCORED, Request

FAILED_BATCHES = 3  # in a row, before the blank sample is scored
ANSWERED_S = 1.0  # for Triton to pass on the errors and the log of the last batch


class SelfCheck:
    """Counts batches that failed, and ends an instance that is broken.

    score_blank: scores the blank sample; raises whatever goes wrong
    report: takes the error of an instance that ends
    """

    def __init__(self, score_blank: Callable[[], None], report: Callable[[BaseException], None]) -> None:
        self._score_blank = score_blank
        self._report = report
        self._num_failed = 0
        self._has_scored_blank = False  # else a failure says nothing
        self._ending: threading.Timer | None = None  # of a broken instance

    @contextmanager
    def around(self, batch: Sequence[Request[Any]]) -> Iterator[None]:
        """A context in which the batch is served. Afterwards it checks the instance, if the batch failed."""
        yield
        self._count(batch)

    @property
    def is_ending(self) -> bool:
        """Whether the process is about to end. Nothing is scored then, so that no request is a suspect."""
        return self._ending is not None

    def wait_if_ending(self) -> None:
        """Does not return if the process is about to end. Triton then tells those who ask that it has."""
        if self._ending is not None:
            self._ending.join()

    def _count(self, batch: Sequence[Request[Any]]) -> None:
        outcomes = {request.outcome for request in batch}
        if any(request.outcome == SCORED and not request.is_counted for request in batch):  # a probe, or a warm-up
            self._has_scored_blank = True
        if SCORED in outcomes:
            self._num_failed = 0
        elif FAILED in outcomes:
            self._num_failed += 1
        if self._num_failed >= FAILED_BATCHES and self._has_scored_blank:
            self._num_failed = 0
            self._check()

    def _check(self) -> None:
        try:
            self._score_blank()
        except Exception as error:  # noqa: BLE001  whatever it is: the instance scored this before
            self.end(error)

    def end(self, error: BaseException) -> None:
        """Reports the error of a process that is broken, and ends it when Triton has passed on what it said."""
        try:
            self._report(error)
        finally:
            ending = threading.Timer(ANSWERED_S, _end)
            ending.daemon = True
            ending.start()
            self._ending = ending


def _end() -> None:
    os._exit(1)
