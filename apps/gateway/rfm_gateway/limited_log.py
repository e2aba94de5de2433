# SPDX-License-Identifier: MIT
"""Warnings that callers cause with every request, without filling the log."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

PERIOD_S = 10.0


class LimitedLog:
    """Writes at most ``most_lines`` warnings in PERIOD_S. The first line after that tells the number of the others.

    others: follows that number, such as ``more requests were refused``
    """

    def __init__(
        self, logger: logging.Logger, most_lines: int, others: str, clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._logger, self._most_lines, self._others, self._clock_s = logger, most_lines, others, clock_s
        self._began_s = float("-inf")  # the period
        self._num_lines = self._num_left_out = 0

    def write(self, line: Callable[[], str]) -> None:
        """Write a line, or count it."""
        now_s = self._clock_s()
        if now_s - self._began_s >= PERIOD_S:
            if self._num_left_out:
                self._logger.warning("%d %s", self._num_left_out, self._others)
            self._began_s, self._num_lines, self._num_left_out = now_s, 0, 0
        if self._num_lines == self._most_lines:
            self._num_left_out += 1
            return
        self._num_lines += 1
        self._logger.warning("%s", line())
