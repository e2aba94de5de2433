# SPDX-License-Identifier: MIT
"""The watchdog of a model process: ends it if a batch hangs, or the device is broken.

``rfm serve`` notices the end and restarts Triton.
"""

from __future__ import annotations

import faulthandler
import logging
import os
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

from rfm.triton_model.request import FAILED, SCORED, Request

FAILED_BATCHES = 3  # failures in a row before the blank sample is scored
_LOOK_S = 1.0
_STDERR = 2

logger = logging.getLogger(__name__)


class Watchdog:
    """Watches the process in its own thread, and ends it after a fault.

    hang_s: longest time that a batch may go without progress; a forward pass is progress
    is_working: returns True while there is a batch
    """

    def __init__(self, hang_s: float, is_working: Callable[[], bool]) -> None:
        self._hang_s = hang_s
        self._is_working = is_working
        self.num_steps = 0  # forward passes and batches so far
        self._num_failed = 0
        self._has_scored_blank = False  # only then does a failing blank sample mean a broken device
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="rfm-watchdog", daemon=True)
        self._thread.start()

    def step(self) -> None:
        """Record progress: the start of a batch, or a forward pass."""
        self.num_steps += 1

    def look_at(self, batch: Iterable[Request[Any]], score_blank: Callable[[], None]) -> None:
        """End the process if FAILED_BATCHES batches in a row failed and the blank sample fails, too.

        The blank sample decides, because inputs may cause failures. Callers in the last batch must repeat their
        requests.

        score_blank: scores the blank sample and raises any error
        """
        outcomes = {request.outcome for request in batch}
        if SCORED in outcomes:
            self._num_failed = 0
            self._has_scored_blank |= any(not each.is_counted and each.outcome == SCORED for each in batch)
        elif FAILED in outcomes:
            self._num_failed += 1
        if self._num_failed < FAILED_BATCHES or not self._has_scored_blank:
            return
        self._num_failed = 0
        try:
            score_blank()
        except Exception:  # noqa: BLE001  any error: the instance scored this sample before
            end(f"instance is broken: the blank sample fails after {FAILED_BATCHES} failed batches")

    def close(self) -> None:
        """Stop the watchdog and end its thread."""
        self._closed.set()
        self._thread.join()
        faulthandler.cancel_dump_traceback_later()

    def _watch(self) -> None:
        """Re-arm faulthandler's timer while there is progress. The timer needs no GIL, so it ends any hang."""
        seen, armed_s = -1, 0.0
        while not self._closed.is_set():
            is_getting_on = not self._is_working() or self.num_steps != seen
            if is_getting_on and time.monotonic() - armed_s > self._hang_s / 10:
                seen, armed_s = self.num_steps, time.monotonic()
                faulthandler.dump_traceback_later(self._hang_s, file=_STDERR, exit=True)
            self._closed.wait(min(_LOOK_S, self._hang_s / 10))


def end(why: str) -> None:
    """Log the current exception and the reason, and end the process at once."""
    logger.exception("the model process ends: %s", why)
    os._exit(1)
