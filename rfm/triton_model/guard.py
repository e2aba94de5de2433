# SPDX-License-Identifier: MIT
"""A model process ends by itself when Triton has ended, when a batch hangs, and when its device is broken.

``rfm serve`` sees that a model process has ended, and starts Triton again.
"""

from __future__ import annotations

import faulthandler
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from typing import Any

from rfm.triton_model.request import FAILED, SCORED, Request

FAILED_BATCHES = 3  # in a row, before the blank sample is scored
_LOOK_S = 1.0
_STDERR = 2


class Guard:
    """Ends the process. Starts a thread.

    hang_s: seconds in which a batch may make no progress; a forward pass is progress
    is_working: tells whether there is a batch
    """

    def __init__(self, hang_s: float, is_working: Callable[[], bool]) -> None:
        self._hang_s = hang_s
        self._is_working = is_working
        self.num_steps = 0  # forward passes and batches so far
        self._num_failed = 0
        self._has_scored_blank = False  # else a failure of it says nothing
        self._closed = threading.Event()
        self._triton = os.getppid()
        self._thread = threading.Thread(target=self._watch, name="rfm-guard", daemon=True)
        self._thread.start()

    def step(self) -> None:
        """Note progress: a batch has begun, or got one forward pass further."""
        self.num_steps += 1

    def look_at(self, batch: Iterable[Request[Any]], score_blank: Callable[[], None]) -> None:
        """End the process if FAILED_BATCHES batches failed in a row and the blank sample fails, too.

        Inputs may be the cause of failures, so the blank sample decides. The callers of the last batch ask again.

        score_blank: raises whatever goes wrong
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
        except Exception:  # noqa: BLE001  whatever it is: the instance scored this before
            end(f"instance is broken: the blank sample fails after {FAILED_BATCHES} failed batches")

    def close(self) -> None:
        """End the thread that looks."""
        self._closed.set()
        self._thread.join()
        faulthandler.cancel_dump_traceback_later()

    def _watch(self) -> None:
        """Arm Python's own timer again and again. It needs no lock of Python's, so any hang lets it run out."""
        seen, armed_s = -1, 0.0
        while not self._closed.is_set():
            is_getting_on = not self._is_working() or self.num_steps != seen
            if is_getting_on and time.monotonic() - armed_s > self._hang_s / 10:
                seen, armed_s = self.num_steps, time.monotonic()
                faulthandler.dump_traceback_later(self._hang_s, file=_STDERR, exit=True)
            if os.getppid() != self._triton:
                os._exit(1)
            self._closed.wait(min(_LOOK_S, self._hang_s / 10))


def end(why: str) -> None:
    """End the process at once, with the error that is being handled in the log."""
    traceback.print_exc()
    print(f"rfm: the model process ends: {why}", file=sys.stderr, flush=True)
    os._exit(1)
