# SPDX-License-Identifier: MIT
"""Regions of shared memory when a call fails, is cancelled, or the server starts anew: none is lost or mixed up.

A stand-in for the server: a real one cannot be told when to answer. ``test_client_faults`` has real ones.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine, Iterator
from contextlib import AsyncExitStack
from typing import Any

import aiohttp
import numpy as np
import pytest
from tritonclient.utils import InferenceServerException

from commands import in_shared_memory
from rfm_client.transport.off_loop import MIN_BYTES
from rfm_client.transport.shared_memory import FOLDER, MIN_REGION_BYTES, MIN_SHARED_BYTES, Region, SharedMemory

SMALL = np.ones(MIN_SHARED_BYTES, np.uint8)
LARGE = np.ones(MIN_REGION_BYTES + 1, np.uint8)  # more than the region of a small one holds
WITHIN_S = 5.0


class Server:
    """Maps what it is told to. failure: of registering; answers: cleared, it registers and does not answer"""

    url = "http://stand:1"
    connection_errors = (aiohttp.ClientError, OSError)

    def __init__(self) -> None:
        self.mapped: list[str] = []
        self.in_use: set[str] = set()
        self.failure: Exception | None = None
        self.answers = asyncio.Event()
        self.answers.set()
        self.asked = asyncio.Event()

    async def register_region(self, name: str, byte_size: int) -> None:
        if self.failure is not None:
            raise self.failure
        assert (FOLDER / name).stat().st_size == byte_size
        self.mapped.append(name)
        self.asked.set()
        await self.answers.wait()

    async def unregister_region(self, name: str) -> None:
        if name in self.in_use:
            raise InferenceServerException("it is in use", status="400")
        if name in self.mapped:
            self.mapped.remove(name)

    async def registered_regions(self) -> list[str]:
        return list(self.mapped)


def run(test: Callable[[Server, SharedMemory], Coroutine[Any, Any, None]]) -> None:
    """With a server and memory that is shared with it, of which nothing is left."""

    async def within() -> None:
        server = Server()
        memory = SharedMemory(server)
        try:
            await test(server, memory)
        finally:
            await memory.close()
        assert server.mapped == []

    before = in_shared_memory()
    asyncio.run(asyncio.wait_for(within(), WITHIN_S))
    assert {name for name in in_shared_memory() - before if name.startswith("rfm-client-")} == set()


async def lend(memory: SharedMemory, array: np.ndarray[Any, Any] = SMALL) -> str:
    """Name of the region that the array was in."""
    async with memory.lend(array) as region:
        assert region is not None
        return region.name


async def idle(memory: SharedMemory) -> None:
    """Nothing goes on any more."""
    while memory._tasks:
        await asyncio.wait(memory._tasks)


@pytest.mark.parametrize("failure", [aiohttp.ServerDisconnectedError(), ConnectionResetError()], ids=repr)
def test_what_could_not_be_registered_is_not_kept(failure: Exception) -> None:
    async def test(server: Server, memory: SharedMemory) -> None:
        server.failure = failure
        for _ in range(3):
            with pytest.raises(type(failure)):
                await lend(memory)
        await idle(memory)
        assert memory._known == set()
        server.failure = None
        assert await lend(memory) == await lend(memory)
        assert len(server.mapped) == 1

    run(test)


def test_what_a_cancelled_call_registered_is_given_back() -> None:
    async def test(server: Server, memory: SharedMemory) -> None:
        server.answers.clear()
        call = asyncio.create_task(lend(memory))
        await server.asked.wait()
        call.cancel()
        with pytest.raises(asyncio.CancelledError):
            await call
        await idle(memory)
        assert (memory._known, server.mapped) == (set(), [])

    run(test)


@pytest.fixture
def slow_write(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[threading.Event, threading.Event]]:
    """Events: a thread writes to a region; it may end."""
    begun, may_end = threading.Event(), threading.Event()
    write = Region.write

    def slow(self: Region, array: np.ndarray[Any, Any]) -> None:
        begun.set()
        assert may_end.wait(WITHIN_S)
        write(self, array)

    monkeypatch.setattr(Region, "write", slow)
    yield begun, may_end
    may_end.set()


def test_what_a_cancelled_call_still_writes_to_is_free_when_it_has_ended(
    slow_write: tuple[threading.Event, threading.Event],
) -> None:
    begun, may_end = slow_write
    array = np.ones(MIN_BYTES, np.uint8)  # written in a thread

    async def test(server: Server, memory: SharedMemory) -> None:
        call = asyncio.create_task(lend(memory, array))
        assert await asyncio.to_thread(begun.wait, WITHIN_S)
        call.cancel()
        with pytest.raises(asyncio.CancelledError):
            await call
        assert memory._free == []
        may_end.set()
        await idle(memory)
        assert [await lend(memory, array)] == server.mapped

    run(test)


def test_a_region_that_the_server_keeps_is_used_again() -> None:
    async def test(server: Server, memory: SharedMemory) -> None:
        small = await lend(memory)
        server.in_use = {small}
        large = await lend(memory, LARGE)
        assert server.mapped == [small, large]
        async with memory.lend(LARGE) as region:
            assert region is not None
            assert (region.name, await lend(memory)) == (large, small)
        server.in_use = set()

    run(test)


def test_a_server_that_starts_anew_has_lost_only_what_it_had_before() -> None:
    async def test(server: Server, memory: SharedMemory) -> None:
        async with AsyncExitStack() as calls:
            old = [await calls.enter_async_context(memory.lend(SMALL)) for _ in range(3)]
            server.mapped.clear()
            new = await calls.enter_async_context(memory.lend(SMALL))
            assert old[1] is not None
            memory.forget(old[1])
            memory.forget(old[1])  # another call that used it is told late
        assert new is not None
        assert {region.name for region in memory._free} == {old[2].name, new.name}  # type: ignore[union-attr]
        for lost in (old[2], old[0]):
            memory.forget(lost)  # type: ignore[arg-type]
        assert [region.name for region in memory._free] == server.mapped == [new.name]

    run(test)
