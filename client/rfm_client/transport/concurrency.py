# SPDX-License-Identifier: MIT
"""A limit on concurrent requests and their bytes, so that client and server stay within memory."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from rfm_client.contract.numbers import checked_count
from rfm_client.transport.deadline import Deadline, timeout

MAX_BYTES = 256 * 2**20  # of inputs; writing to a socket holds several copies of them


class ConcurrencyLimiter:
    """A limit of ``max_requests`` requests and MAX_BYTES at a time, for one event loop. First come, first served."""

    def __init__(self, max_requests: int) -> None:
        self._free_requests = checked_count("max_in_flight", max_requests)
        self._free_bytes = MAX_BYTES
        self._turn = asyncio.Lock()  # held by the request that enters next
        self._left = asyncio.Event()  # set when a request ends

    @asynccontextmanager
    async def room(self, num_bytes: int, deadline: Deadline) -> AsyncIterator[None]:
        """Context manager for a request of ``num_bytes``. A request over MAX_BYTES runs alone.

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
        except asyncio.TimeoutError:  # not the built-in class in Python 3.10
            raise deadline.exceeded() from None
