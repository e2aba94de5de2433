# SPDX-License-Identifier: MIT
"""How much may be under way at a time, so that neither side's memory fills up."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from rfm_client.transport.deadline import Deadline, timeout

MAX_BYTES = 256 * 2**20  # of inputs; they are held several times over while they are written to a socket
_UNIT_BYTES = 2**20


class InFlight:
    """Room for ``max_requests`` requests of MAX_BYTES together, for one event loop. First come, first served."""

    def __init__(self, max_requests: int) -> None:
        if max_requests < 1:
            raise ValueError(f"max_in_flight: expected at least 1, got {max_requests}")
        self._requests = asyncio.Semaphore(max_requests)
        self._units = asyncio.Semaphore(MAX_BYTES // _UNIT_BYTES)
        self._collecting = asyncio.Lock()

    @asynccontextmanager
    async def room(self, num_bytes: int, deadline: Deadline) -> AsyncIterator[None]:
        """A context in which a request of ``num_bytes`` is under way. One of more than MAX_BYTES is under way alone.

        Raises DeadlineExceededError if there is no room in time.
        """
        units = min(1 + num_bytes // _UNIT_BYTES, MAX_BYTES // _UNIT_BYTES)
        try:
            async with timeout(deadline.remaining_s()):
                await self._enter(units)
        except asyncio.TimeoutError:  # in Python 3.10 not the built-in one
            raise deadline.exceeded() from None
        try:
            yield
        finally:
            self._leave(units)

    async def _enter(self, units: int) -> None:
        await self._requests.acquire()
        held = 0
        try:
            async with self._collecting:  # one after the other, so that no two wait for each other's half
                while held < units:
                    await self._units.acquire()
                    held += 1
        except BaseException:
            self._leave(held)
            raise

    def _leave(self, units: int) -> None:
        for _ in range(units):
            self._units.release()
        self._requests.release()
