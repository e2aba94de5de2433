# SPDX-License-Identifier: MIT
"""Limit concurrent evaluations; a request takes a place only when its body has arrived."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import AsyncGenerator

import anyio
from anyio.lowlevel import checkpoint
from fastapi import HTTPException, Request
from prometheus_client import Gauge

from rfm_gateway.config import MIB, GatewayConfig

PACE_BYTES, PACE_S = 64 * 2**10, 30.0  # a body arrives at this pace or faster; a robot's Wi-Fi may drop out meanwhile
AHEAD_BYTES = 256 * MIB  # of all bodies whose requests have no place yet
RETRY_AFTER = {"Retry-After": "1"}


async def arriving(
    request: Request, max_bytes: int, timeout_s: float, pace_s: float = PACE_S, *, remedy: str = ""
) -> AsyncGenerator[bytes, None]:
    """Yield the chunks of a body as they come. The time that the caller spends on a chunk does not count.

    remedy: against too large a body

    Raises HTTPException 413 as soon as the announced or received size is too large; TimeoutError if the body takes
    longer than ``timeout_s``, or PACE_BYTES of it longer than ``pace_s``.
    """
    too_large = f"body: expected at most {max_bytes} bytes, got more" + (f"; {remedy}" if remedy else "")
    announced = request.headers.get("content-length", "")
    if announced.isdecimal() and int(announced) > max_bytes:
        raise HTTPException(413, too_large)
    chunks, come_bytes, left_s = request.stream(), 0, timeout_s
    paced_bytes, pace_left_s = 0, pace_s
    while True:
        began_s = time.monotonic()
        with anyio.fail_after(min(left_s, pace_left_s)):
            chunk = await anext(chunks, None)
        if chunk is None:
            return
        took_s = time.monotonic() - began_s
        left_s, pace_left_s = left_s - took_s, pace_left_s - took_s
        come_bytes, paced_bytes = come_bytes + len(chunk), paced_bytes + len(chunk)
        if come_bytes > max_bytes:
            raise HTTPException(413, too_large)
        if paced_bytes >= PACE_BYTES:
            paced_bytes, pace_left_s = 0, pace_s
        yield chunk


class Room:
    """Places for evaluations: ``max_in_flight`` at a time; ``max_waiting`` more wait, first come, first served.

    ahead_bytes: the room's bytes for bodies whose requests have no place yet
    """

    def __init__(
        self, config: GatewayConfig, in_flight: Gauge, waiting: Gauge, *, ahead_bytes: int = AHEAD_BYTES
    ) -> None:
        self._config = config
        self._in_flight, self._waiting = in_flight, waiting
        self._places = asyncio.Semaphore(config.max_in_flight)
        self._num_waiting = 0
        self.ahead_bytes = ahead_bytes

    def check(self) -> None:
        """Raise HTTPException 503 if no further request may wait."""
        if self._places.locked() and self._num_waiting >= self._config.max_waiting:
            raise self._refusal()

    async def enter(self) -> None:
        """Wait for a place and take it. Raises HTTPException 503."""
        self.check()
        self._num_waiting += 1
        has_entered = False
        try:
            with self._waiting.track_inprogress(), anyio.move_on_after(self._config.timeout_s):
                has_entered = await self._places.acquire()
        finally:
            self._num_waiting -= 1
        if not has_entered:
            raise self._refusal()
        self._in_flight.inc()

    def leave(self) -> None:
        """Give the place back."""
        self._in_flight.dec()
        self._places.release()

    def _refusal(self) -> HTTPException:
        detail = f"expected at most {self._config.max_in_flight} evaluations at a time, got more"
        return HTTPException(503, detail, RETRY_AFTER)


class Turn:
    """What one request has taken of a room: bytes for its body, then a place. ``end`` gives it back."""

    def __init__(self, room: Room) -> None:
        self._room = room
        self._has_place = False
        self._ahead_bytes = 0

    async def admitted(self, chunks: AsyncGenerator[bytes, None]) -> AsyncGenerator[bytes, None]:
        """Yield the chunks of a body as soon as the request has its place, which it takes when its body has arrived.

        If the room's bytes for such bodies are used up, it takes the place before it reads on. Raises HTTPException
        503.
        """
        self._room.check()
        ahead: deque[bytes] = deque()
        async for chunk in chunks:
            if ahead and len(ahead[-1]) < PACE_BYTES:  # many small chunks would take much memory
                ahead[-1] += chunk
            else:
                ahead.append(chunk)
            if len(chunk) > self._room.ahead_bytes:
                break
            self._hold(len(chunk))
        await self._room.enter()
        self._has_place = True
        self._hold(-self._ahead_bytes)
        while ahead:
            yield ahead.popleft()
            await checkpoint()  # other requests go on meanwhile
        async for chunk in chunks:
            yield chunk

    def end(self) -> None:
        """Give back what the request has taken."""
        self._hold(-self._ahead_bytes)
        if self._has_place:
            self._has_place = False
            self._room.leave()

    def _hold(self, num_bytes: int) -> None:
        self._ahead_bytes += num_bytes
        self._room.ahead_bytes -= num_bytes
