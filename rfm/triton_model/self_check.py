# SPDX-License-Identifier: MIT
"""A model process that finds out by itself that it is broken, by a lost CUDA context say, and ends.

Probes cannot tell one broken instance of several: they go to whichever instance is free. A process that has ended is
dead, and healed as such. Inputs may fail too, so a blank sample decides: who can score that is not broken.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from typing import Any

from rfm.triton_model.asked import FAILED, SCORED, Asked

FAILED_BATCHES = 3  # in a row, before the blank sample is scored
ANSWERED_S = 1.0  # for Triton to pass on the errors and the log of the last batch


class SelfCheck:
    """Is told every batch.

    score_blank: scores the blank sample; raises whatever goes wrong
    tell: is told the error of an instance that ends
    """

    def __init__(self, score_blank: Callable[[], None], tell: Callable[[Exception], None]) -> None:
        self._score_blank = score_blank
        self._tell = tell
        self._num_failed = 0
        self._has_scored_blank = False  # else a failure says nothing
        self._ending: threading.Timer | None = None  # of a broken instance

    def before_batch(self) -> None:
        """Begins nothing of the batch in a broken process, so that no request is a suspect when it ends."""
        if self._ending is not None:
            self._ending.join()

    def after_batch(self, batch: Sequence[Asked[Any]]) -> None:
        """Checks the instance if need be. One that is broken ends when Triton has passed on this batch's errors."""
        outcomes = {asked.outcome for asked in batch}
        if any(asked.outcome == SCORED and not asked.is_counted for asked in batch):  # a probe, or a warm-up
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
            self._tell(error)
            self._ending = threading.Timer(ANSWERED_S, _end)
            self._ending.daemon = True
            self._ending.start()


def _end() -> None:
    os._exit(1)
