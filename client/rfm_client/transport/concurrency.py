# SPDX-License-Identifier: MIT
"""How much may be under way at a time, so that neither side's memory fills up."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from rfm_client.contract.numbers import checked_count
from rfm_client.transport.deadline import Deadline, timeout

MAX_BYTES = 256 * 2**20  # of inputs; they are held several times over while they are written to a socket


class ConcurrencyLimiter:
    """Room for ``max_requests`` requests of MAX_BYTES together, for one event loop. First come, first served."""

    def __init__(self, max_requests: int) -> None:
        self._free_requests = checked_count("max_in_flight", max_requests)
        self._free_bytes = MAX_BYTES
        self._turn = asyncio.Lock()  # the next one to enter holds it
        self._left = asyncio.Event()  # a request has ended since

    @asynccontextmanager
    async def room(self, num_bytes: int, deadline: Deadline) -> AsyncIterator[None]:
        """A context in which a request of ``num_bytes`` is under way. One of more than MAX_BYTES is under way alone.

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
        except asyncio.TimeoutError:  # in Python 3.10 not the built-in one
            raise deadline.exceeded() from None
