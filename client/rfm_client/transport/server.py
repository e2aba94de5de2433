# SPDX-License-Identifier: MIT
"""What a client knows of one server: how busy it is, and whether it is left out."""

from __future__ import annotations

import asyncio
import itertools
import random
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rfm_client.transport.calls import Transport

FIRST_PAUSE_S = 0.1
LONGEST_RETRY_PAUSE_S = 2.0
LONGEST_REST_S = 30.0  # of a server that says that it is ready and fails again and again
PROBE_TIMEOUT_S = 2.0
HEALED_WITHIN_S = 60.0  # the longest that a call waits for the server that it was with when that one ended
_HEAL_POLL_S = 0.2  # while it loads its model anew, which takes seconds, it is not ready


class Server:
    """One server of several: its transport, its load and its failures.

    failures: how often it was left out since the last success
    has_answered: it has ever had a success
    is_gone: it gets no more requests, and is closed as soon as nobody uses it
    """

    _moments = itertools.count(1)

    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self.outstanding = 0
        self.last_request = 0
        self.failures = 0
        self.has_answered = False
        self.comeback: asyncio.Task[bool] | None = None  # whether it was seen to be healed
        self._has_ended_process = False
        self._is_to_heal = False  # it is left out since a process or a connection has ended
        self.is_gone = False
        self._closing: asyncio.Task[None] | None = None

    @property
    def is_left_out(self) -> bool:
        """Whether the server gets no requests until it says that it is ready."""
        return self.comeback is not None and not self.comeback.done()

    @property
    def is_dead(self) -> bool:
        """Whether it is left out since a process of the model has ended."""
        return self._has_ended_process and self.is_left_out

    @contextmanager
    def request_under_way(self) -> Iterator[None]:
        """A context in which a request to this server is under way."""
        self.outstanding += 1
        self.last_request = next(self._moments)
        try:
            yield
        finally:
            self.outstanding -= 1
            self._close_if_unused()

    def leave_out(self, model: str) -> None:
        """Leaves the server out until it says that it is ready. The more often it failed, the later it is probed."""
        if not self.is_left_out and not self.is_gone:
            self._has_ended_process = self._is_to_heal = False
            self.comeback = asyncio.create_task(self._rest(model))

    def leave_out_dead(self, model: str) -> None:
        """Leaves the server, of which a process has ended, out until it is healed.

        Triton 2.51 says that a dead model is ready, so it must have said the opposite before.
        """
        if not self.is_dead and not self.is_gone:
            self._has_ended_process = True
            self._wait_for_healing(model, was_unready=False)

    def leave_out_lost(self, model: str) -> None:
        """Leaves the server, to which a connection has ended, out until it says that it is ready."""
        if not (self._is_to_heal and self.is_left_out) and not self.is_gone:
            self._has_ended_process = False
            self._wait_for_healing(model, was_unready=True)

    def _wait_for_healing(self, model: str, *, was_unready: bool) -> None:
        if self.comeback is not None:
            self.comeback.cancel()
        self._is_to_heal = True
        self.comeback = asyncio.create_task(self._heal(model, was_unready=was_unready))

    async def is_healed(self, within_s: float) -> bool:
        """True as soon as it serves again after a process or a connection ended; False if it does not ``within_s``."""
        until_s = time.monotonic() + within_s
        while (comeback := self.comeback) is not None and not self.is_gone:
            await asyncio.wait({comeback}, timeout=max(until_s - time.monotonic(), 0.0))
            if not comeback.done():
                return False
            if not comeback.cancelled():
                return comeback.result() and not self.is_gone
        return False

    def remove(self) -> None:
        """No request that begins now will be sent to it."""
        self.is_gone = True
        if self.comeback is not None:
            self.comeback.cancel()
        self._close_if_unused()

    @property
    def is_closed(self) -> bool:
        """Whether nothing of it is left."""
        return self._closing is not None and self._closing.done()

    async def close(self) -> None:
        """Closes the connection, even if calls still use it."""
        self.is_gone = True
        if self.comeback is not None:
            self.comeback.cancel()
        if self._closing is None:
            self._closing = asyncio.create_task(self.transport.close())
        await self._closing

    def _close_if_unused(self) -> None:
        if self.is_gone and not self.outstanding and self._closing is None:
            self._closing = asyncio.create_task(self.transport.close())

    async def _rest(self, model: str) -> bool:
        await asyncio.sleep(pause_s(self.failures - 1, LONGEST_REST_S))
        for attempt in itertools.count():
            if await self.transport.is_ready(model, PROBE_TIMEOUT_S):
                break
            await asyncio.sleep(pause_s(attempt, LONGEST_RETRY_PAUSE_S))
        return False

    async def _heal(self, model: str, *, was_unready: bool) -> bool:
        """Whether the server was seen to be healed.

        It may never heal, or load too quickly to be seen; then it is tried again after LONGEST_REST_S.
        """
        tried_at_s = time.monotonic() + LONGEST_REST_S
        while True:
            is_ready = await self.transport.is_ready(model, PROBE_TIMEOUT_S)
            if is_ready and (was_unready or time.monotonic() >= tried_at_s):
                return was_unready
            was_unready = was_unready or not is_ready
            await asyncio.sleep(_HEAL_POLL_S)


def pause_s(attempt: int, longest_s: float) -> float:
    """Doubles from try to try; half of it is chance, so that callers do not come back all at once."""
    pause_s = min(longest_s, FIRST_PAUSE_S * 2.0 ** min(attempt, 16))
    return random.uniform(pause_s / 2, pause_s)
