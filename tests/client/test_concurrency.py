# SPDX-License-Identifier: MIT
"""The bound of bytes in flight."""

from __future__ import annotations

import asyncio

import pytest

from rfm_client import DeadlineExceededError
from rfm_client.transport.concurrency import MAX_BYTES, ConcurrencyLimiter
from rfm_client.transport.deadline import Deadline


def test_bytes_in_flight_are_bounded_and_more_than_the_bound_goes_alone() -> None:
    async def ask() -> None:
        room = ConcurrencyLimiter(10).room
        async with room(MAX_BYTES // 2, Deadline(1)), room(MAX_BYTES // 2 - 1, Deadline(1)):
            with pytest.raises(DeadlineExceededError):
                async with room(2, Deadline(0.05)):
                    pytest.fail("there was no room")
            async with room(1, Deadline(1)):
                pass
        async with room(3 * MAX_BYTES, Deadline(1)):
            with pytest.raises(DeadlineExceededError):
                async with room(0, Deadline(0.05)):
                    pytest.fail("there was no room")
        async with room(MAX_BYTES, Deadline(1)):  # a call that gives up returns its bytes
            pass

    asyncio.run(ask())
