# SPDX-License-Identifier: MIT
"""Limits on calls: time, request size, and how much may be in flight at once."""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import AsyncIterator, Collection
from contextlib import asynccontextmanager

if sys.version_info >= (3, 11):
    from asyncio import timeout as timeout
else:
    from async_timeout import timeout as timeout

from rfm_client.contract.checks import checked_count, checked_positive
from rfm_client.contract.errors import DeadlineExceededError, InvalidSampleError
from rfm_client.contract.wire import Tensors

MAX_REQUEST_BYTES = 2**31 - 2**16  # gRPC and Triton's HTTP server count message bytes in 32 bits; rest: headers
_BYTES_PER_GB = 1e9
_LENGTH_BYTES = 4  # before every text
MAX_BYTES = 256 * 2**20  # input bytes; writing to a socket holds several copies
LATE_S = 2.0  # if a call ends so long after its deadline, this process was stopped or did not get to it
MAX_TIMEOUT_S = 1e9  # more than 30 years; Triton counts nanoseconds, and not many more


def check_timeout(timeout_s: float) -> None:
    """Raise ValueError for an invalid time limit. Infinity is invalid, because servers can hang."""
    expected = f"a number of seconds above 0 and at most {MAX_TIMEOUT_S:g}"
    checked_positive("timeout_s", timeout_s, expected, most=MAX_TIMEOUT_S)


class Deadline:
    """A moment ``timeout_s`` seconds from now, for all steps in a call. at_s: the moment (monotonic clock)."""

    def __init__(self, timeout_s: float) -> None:
        check_timeout(timeout_s)
        self.timeout_s = timeout_s
        self.at_s = time.monotonic() + timeout_s

    @property
    def passed_s(self) -> float:
        """The seconds since the call began."""
        return time.monotonic() - (self.at_s - self.timeout_s)

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
        """Return the error for a call that ran out of time at the server ``where``."""
        passed_s = self.passed_s
        late = f"; {passed_s:.0f} s have passed, as this process was stopped, or busy with other work"
        text = f"no answer within {self.timeout_s:g} s{late * (passed_s > self.timeout_s + LATE_S)}"
        return DeadlineExceededError(f"{where}: {text}" if where else text)


def check_size(inputs: Tensors, shared: Collection[str]) -> None:
    """Raise InvalidSampleError if the inputs outside shared memory do not fit into one request.

    shared: names of inputs in shared memory
    """
    sizes = {
        name: sum(len(text) + _LENGTH_BYTES for text in array.flat) if array.dtype == object else array.nbytes
        for name, array in inputs.items()
        if name not in shared
    }
    if sum(sizes.values()) <= MAX_REQUEST_BYTES:
        return
    raise InvalidSampleError.at(
        max(sizes, key=lambda name: sizes[name]),
        f"at most {MAX_REQUEST_BYTES / _BYTES_PER_GB:.2f} GB in a request",
        f"{sum(sizes.values()) / _BYTES_PER_GB:.2f} GB",
        "shrink the frames (resize, --resize), score fewer (subsample, or --fps for videos), or share memory with a "
        "server on this host (shared_memory)",
    )


class ConcurrencyLimiter:
    """Allows at most ``max_requests`` requests and MAX_BYTES at a time, in one event loop. First come, first served."""

    def __init__(self, max_requests: int) -> None:
        self._free_requests = checked_count("max_in_flight", max_requests)
        self._free_bytes = MAX_BYTES
        self._turn = asyncio.Lock()  # held by the request that enters next
        self._left = asyncio.Event()  # set when a request ends

    @asynccontextmanager
    async def room(self, num_bytes: int, deadline: Deadline) -> AsyncIterator[None]:
        """Context manager for a request with ``num_bytes``. A request over MAX_BYTES runs alone.

        Raises DeadlineExceededError if there is no room in time.
        """
        num_bytes = min(max(num_bytes, 1), MAX_BYTES)
        if self._turn.locked() or not self._fits(num_bytes):
            await self._wait_for_room(num_bytes, deadline)
        self._free_requests -= 1
        self._free_bytes -= num_bytes
        try:
            yield
        finally:
            self._free_requests += 1
            self._free_bytes += num_bytes
            self._left.set()

    def _fits(self, num_bytes: int) -> bool:
        return self._free_requests > 0 and self._free_bytes >= num_bytes

    async def _wait_for_room(self, num_bytes: int, deadline: Deadline) -> None:
        try:
            async with timeout(deadline.remaining_s()), self._turn:
                while not self._fits(num_bytes):
                    self._left.clear()
                    await self._left.wait()
        except asyncio.TimeoutError:  # in Python 3.10 not the built-in class
            raise deadline.exceeded() from None
