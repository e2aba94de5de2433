# SPDX-License-Identifier: MIT
"""What the requests under way may hold in memory, all together."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from fastapi import HTTPException

from rfm_client.contract.errors import DeadlineExceededError
from rfm_client.transport.deadline import Deadline, timeout

RETRY_AFTER = {"Retry-After": "1"}


class Memory:
    """The memory of all requests: at most ``most_bytes``, which are counted before they are taken."""

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._held_bytes = 0
        self._counting = threading.Lock()  # large arrays are made in threads
        self._turn = asyncio.Lock()
        self._freed = asyncio.Event()

    @contextmanager
    def share(self) -> Iterator[Share]:
        """A context with the share of one request, which is free again when the context ends."""
        share = Share(self)
        try:
            yield share
        finally:
            with self._counting:
                self._held_bytes -= share.held_bytes
                share.is_over = True
            self._freed.set()

    async def reserve(self, share: Share, num_bytes: int, deadline: Deadline) -> None:
        """Waits until ``num_bytes`` are free for ``share``, as Share.reserve describes it."""
        num_bytes = min(num_bytes, self._most_bytes)  # take() refuses what is too much for one request
        try:
            async with timeout(deadline.remaining_s()), self._turn:  # first come, first served
                while not self._reserved(share, num_bytes):
                    self._freed.clear()
                    await self._freed.wait()
        except (asyncio.TimeoutError, DeadlineExceededError):  # in Python 3.10 not the built-in TimeoutError
            raise HTTPException(
                503, "body: expected room for it in time, got none: others hold it", RETRY_AFTER
            ) from None

    def take(self, share: Share, num_bytes: int) -> None:
        """Counts ``num_bytes`` as held by ``share``, as Share.take describes it."""
        with self._counting:
            more_bytes = max(num_bytes - share.reserved_bytes, 0)
            if share.held_bytes + more_bytes > self._most_bytes:
                raise HTTPException(
                    413, f"body: expected one that takes at most {self._most_bytes} bytes of memory, got more"
                )
            if share.is_over or self._held_bytes + more_bytes > self._most_bytes:
                raise HTTPException(503, "body: expected room for it, got none: others hold it", RETRY_AFTER)
            share.reserved_bytes -= num_bytes - more_bytes
            share.held_bytes += more_bytes
            self._held_bytes += more_bytes

    def _reserved(self, share: Share, num_bytes: int) -> bool:
        with self._counting:
            if self._held_bytes + num_bytes > self._most_bytes:
                return False
            share.reserved_bytes += num_bytes
            share.held_bytes += num_bytes
            self._held_bytes += num_bytes
            return True


class Share:
    """The memory of one request.

    reserved_bytes: of ``held_bytes``, those still to be taken; is_over: the request has ended, though a thread may
    still work for it
    """

    def __init__(self, memory: Memory) -> None:
        self._memory = memory
        self.held_bytes = 0
        self.reserved_bytes = 0
        self.is_over = False

    async def reserve(self, num_bytes: int, deadline: Deadline) -> None:
        """Waits until so many are free, and holds them to be taken later. Raises HTTPException 503 if that is late."""
        await self._memory.reserve(self, num_bytes, deadline)

    def take(self, num_bytes: int) -> None:
        """Takes ``num_bytes`` more. Raises HTTPException: 413 if that is too much for one request, 503 if others hold
        too much.
        """
        self._memory.take(self, num_bytes)
