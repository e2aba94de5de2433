# SPDX-License-Identifier: MIT
"""Regions of shared memory when a call fails or is cancelled: none is lost.

A stand-in for tritonclient: a real server cannot be told when to answer. ``test_client_faults`` has real ones.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import aiohttp
import numpy as np
import pytest
from tritonclient.utils import InferenceServerException

from commands import in_shared_memory
from rfm_client.contract import triton
from rfm_client.transport.shared_memory import FOLDER, MIN_REGION_BYTES, MIN_SHARED_BYTES, SharedMemory

SMALL = np.ones(MIN_SHARED_BYTES, np.uint8)
LARGE = np.ones(MIN_REGION_BYTES + 1, np.uint8)  # too large for a small array's region
WITHIN_S = 30.0


class Triton:
    """Maps regions. failure: raised on registering; answers: when cleared, it registers without an answer"""

    def __init__(self) -> None:
        self.mapped: list[str] = []
        self.in_use: set[str] = set()
        self.failure: Exception | None = None
        self.answers = asyncio.Event()
        self.answers.set()
        self.asked = asyncio.Event()

    async def register_system_shared_memory(self, name: str, key: str, byte_size: int) -> None:
        if self.failure is not None:
            raise self.failure
        assert key == f"/{name}"
        assert (FOLDER / name).stat().st_size == byte_size
        self.mapped.append(name)
        self.asked.set()
        await self.answers.wait()

    async def unregister_system_shared_memory(self, name: str) -> None:
        if name in self.in_use:
            raise InferenceServerException(triton.REGION_IN_USE, status="400")
        if name in self.mapped:
            self.mapped.remove(name)


Test = Callable[[Triton, SharedMemory], Coroutine[Any, Any, None]]


def run(test: Test) -> None:
    """With a server and shared memory, of which nothing is left."""

    async def within() -> None:
        server, memory = Triton(), SharedMemory("grpc://stand:1")
        try:
            await test(server, memory)
        finally:
            await memory.close(server)
        assert server.mapped == []

    before = in_shared_memory()
    asyncio.run(asyncio.wait_for(within(), WITHIN_S))
    assert {name for name in in_shared_memory() - before if name.startswith("rfm-client-")} == set()


async def lend(server: Triton, memory: SharedMemory, array: np.ndarray[Any, Any] = SMALL) -> str:
    """Return the name of the array's region."""
    async with memory.lend(server, array) as region:
        assert region is not None
        return region.name


def test_what_could_not_be_registered_is_tried_again() -> None:
    failure = aiohttp.ServerDisconnectedError()

    async def test(server: Triton, memory: SharedMemory) -> None:
        server.failure = failure
        with pytest.raises(type(failure)):
            await lend(server, memory)
        server.failure = None
        assert await lend(server, memory) == await lend(server, memory)
        assert len(server.mapped) == 1

    run(test)


def test_a_server_that_refuses_is_asked_once_and_warned_of_once(caplog: pytest.LogCaptureFixture) -> None:
    async def test(server: Triton, memory: SharedMemory) -> None:
        server.failure = InferenceServerException("no such memory", status="400")
        for _ in range(2):
            async with memory.lend(server, SMALL) as region:
                assert region is None
        server.failure = None
        async with memory.lend(server, SMALL) as region:
            assert region is None

    run(test)
    (record,) = caplog.records
    assert "no shared memory, inputs go through the socket: no such memory" in record.getMessage()


def test_what_a_cancelled_call_registered_is_given_back() -> None:
    async def test(server: Triton, memory: SharedMemory) -> None:
        server.answers.clear()
        call = asyncio.create_task(lend(server, memory))
        await server.asked.wait()
        call.cancel()
        with pytest.raises(asyncio.CancelledError):
            await call
        assert len(server.mapped) == 1

    run(test)


def test_regions_that_are_too_small_make_room_unless_the_server_uses_them() -> None:
    async def test(server: Triton, memory: SharedMemory) -> None:
        await lend(server, memory)
        large = await lend(server, memory, LARGE)
        assert server.mapped == [large]
        async with memory.lend(server, LARGE):
            small = await lend(server, memory)
        assert await lend(server, memory, SMALL) == small  # the smallest that fits
        server.in_use = {small}
        await lend(server, memory, np.ones(3 * MIN_REGION_BYTES, np.uint8))
        assert small in server.mapped
        server.in_use = set()

    run(test)
