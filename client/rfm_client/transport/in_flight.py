# SPDX-License-Identifier: MIT
"""How much may be under way at a time, so that neither side's memory fills up."""

from __future__ import annotations

import asyncio
from collections import deque
from types import TracebackType

from rfm_client.contract.numbers import checked_count
from rfm_client.transport.deadline import Deadline, timeout

MAX_BYTES = 256 * 2**20  # of inputs; they are held several times over while they are written to a socket
_UNIT_BYTES = 2**20
_UNITS = MAX_BYTES // _UNIT_BYTES


class InFlight:
    """Room for ``max_requests`` requests of MAX_BYTES together, for one event loop. First come, first served."""

    def __init__(self, max_requests: int) -> None:
        self._free_requests = checked_count("max_in_flight", max_requests)
        self._free_units = _UNITS
        self._turns: deque[tuple[int, asyncio.Future[None]]] = deque()  # of those that wait, with their units

    def room(self, num_bytes: int, deadline: Deadline) -> Room:
        """A context in which a request of ``num_bytes`` is under way. One of more than MAX_BYTES is under way alone.

        Raises DeadlineExceededError if there is no room in time.
        """
        return Room(self, min(1 + num_bytes // _UNIT_BYTES, _UNITS), deadline)

    async def enter(self, units: int, deadline: Deadline) -> None:
        """Takes the room of a request, as soon as there is some. Raises DeadlineExceededError."""
        if not self._turns and self._fits(units):
            self._take(units)
            return
        turn = asyncio.get_running_loop().create_future()
        self._turns.append((units, turn))
        try:
            async with timeout(deadline.remaining_s()):
                await turn
        except BaseException as error:
            if turn.cancelled() or not turn.done():
                turn.cancel()
                self._admit()  # others may have waited for this one alone
            else:  # its turn had just come
                self.leave(units)
            if isinstance(error, asyncio.TimeoutError):  # in Python 3.10 not the built-in one
                raise deadline.exceeded() from None
            raise

    def leave(self, units: int) -> None:
        """Gives the room of a request back."""
        self._free_requests += 1
        self._free_units += units
        self._admit()

    def _fits(self, units: int) -> bool:
        return self._free_requests > 0 and self._free_units >= units

    def _take(self, units: int) -> None:
        self._free_requests -= 1
        self._free_units -= units

    def _admit(self) -> None:
        """Lets those in that have room, in the order in which they came."""
        while self._turns:
            units, turn = self._turns[0]
            if not turn.done():
                if not self._fits(units):
                    return
                self._take(units)
                turn.set_result(None)
            self._turns.popleft()


class Room:
    """The context that ``InFlight.room`` describes."""

    __slots__ = ("_deadline", "_in_flight", "_units")

    def __init__(self, in_flight: InFlight, units: int, deadline: Deadline) -> None:
        self._in_flight = in_flight
        self._units = units
        self._deadline = deadline

    async def __aenter__(self) -> None:
        await self._in_flight.enter(self._units, self._deadline)

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._in_flight.leave(self._units)
