# SPDX-License-Identifier: MIT
"""Deadlines and time limits of calls."""

from __future__ import annotations

import sys
import time

if sys.version_info >= (3, 11):
    from asyncio import timeout as timeout
else:
    from async_timeout import timeout as timeout

from rfm_client.contract.errors import DeadlineExceededError
from rfm_client.contract.numbers import checked_positive

MAX_TIMEOUT_S = 1e9  # more than 30 years; Triton counts nanoseconds, and not many more


def check_timeout(timeout_s: float) -> None:
    """Raise ValueError for an invalid time limit. Infinity is invalid, because servers can hang."""
    expected = f"a number of seconds above 0 and at most {MAX_TIMEOUT_S:g}"
    checked_positive("timeout_s", timeout_s, expected, most=MAX_TIMEOUT_S)


class Deadline:
    """A moment ``timeout_s`` seconds from now, for all steps of a call. at_s: the moment (monotonic clock)"""

    def __init__(self, timeout_s: float) -> None:
        check_timeout(timeout_s)
        self.timeout_s = timeout_s
        self.at_s = time.monotonic() + timeout_s

    def ends_within(self, seconds: float) -> bool:
        """True if at most ``seconds`` are left."""
        return time.monotonic() + seconds >= self.at_s

    def remaining_s(self) -> float:
        """Return the seconds left, above 0. Raises DeadlineExceededError if none are left."""
        remaining_s = self.at_s - time.monotonic()
        if remaining_s <= 0:
            raise self.exceeded()
        return remaining_s

    def exceeded(self, where: str = "") -> DeadlineExceededError:
        """Return the error of a call that ran out of time at the server ``where``."""
        return DeadlineExceededError(f"{where}{': ' if where else ''}no answer within {self.timeout_s:g} s")
