# SPDX-License-Identifier: MIT
"""The time that a call has left."""

from __future__ import annotations

import sys
import time

if sys.version_info >= (3, 11):
    from asyncio import timeout as timeout
else:
    from async_timeout import timeout as timeout

from rfm_client.contract.errors import DeadlineExceededError
from rfm_client.contract.numbers import checked_positive

MAX_TIMEOUT_S = 1e9  # more than thirty years; Triton counts nanoseconds, and could not count many more


def check_timeout(timeout_s: float) -> None:
    """Raises ValueError for a time limit that a call may not have. It may not wait for ever: servers can hang."""
    expected = f"a number of seconds above 0 and at most {MAX_TIMEOUT_S:g}"
    checked_positive("timeout_s", timeout_s, expected, most=MAX_TIMEOUT_S)


class Deadline:
    """A moment ``timeout_s`` seconds from now, shared by everything that one call does. at_s: by the monotonic clock"""

    def __init__(self, timeout_s: float) -> None:
        check_timeout(timeout_s)
        self.timeout_s = timeout_s
        self.at_s = time.monotonic() + timeout_s

    def ends_within(self, seconds: float) -> bool:
        """Whether less than that is left."""
        return time.monotonic() + seconds >= self.at_s

    def remaining_s(self) -> float:
        """Seconds left, more than 0. Raises DeadlineExceededError when there are none."""
        remaining_s = self.at_s - time.monotonic()
        if remaining_s <= 0:
            raise self.exceeded()
        return remaining_s

    def exceeded(self, where: str = "") -> DeadlineExceededError:
        """The error of a call that came to its end, while it waited for the server ``where``."""
        return DeadlineExceededError(f"{where}{': ' if where else ''}no answer within {self.timeout_s:g} s")
