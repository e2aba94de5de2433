# SPDX-License-Identifier: MIT
"""System shared memory: large inputs reach a server on the same host without passing through a socket.

A region's name leaves /dev/shm as soon as the server has mapped it, so a crash of this process leaves no data
there. What a crash does leave is the server's registration. Each client therefore holds a lock on a file of its own
(``rfm-client-<id>.lock``), which the kernel releases with the process, and the next client that shares memory with
that server takes back the regions of every client whose lock is free. A process id would not do: containers that
share /dev/shm count their processes apart.

Region names: ``rfm-client-<id>-<number>``. Not ``tritonclient.utils.shared_memory``: its regions are sparse, so that a
full /dev/shm kills the process that writes to them (SIGBUS), and keep their names.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import mmap
import os
import re
import uuid
from collections.abc import AsyncIterator, Coroutine
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from tritonclient.utils import InferenceServerException

from rfm_client.contract import triton
from rfm_client.transport.deadline import timeout
from rfm_client.transport.off_loop import off_loop

FOLDER = Path("/dev/shm")
MIN_SHARED_BYTES = 64 * 2**10  # smaller inputs are quicker in the request itself
MIN_REGION_BYTES = 2**20
ANSWER_TIMEOUT_S = 2.0  # of a server that is to unmap a region, perhaps one in use, or to list those that it maps
IN_USE_PAUSE_S = 0.02  # between two tries to have a region unmapped that a request still uses
_PREFIX = "rfm-client-"
_LOCK_SUFFIX = ".lock"
_REGION_NAME = re.compile(rf"{_PREFIX}(?P<owner>[0-9a-f]{{32}})-\d+")

logger = logging.getLogger("rfm_client")


class RegionServer(Protocol):
    """The server's shared-memory extension. Its methods raise InferenceServerException and its connection_errors."""

    url: str

    @property
    def connection_errors(self) -> tuple[type[Exception], ...]:
        """The exceptions that this client raises when its connection fails."""

    async def register_region(self, name: str, byte_size: int) -> None:
        """The server maps the memory ``name``."""

    async def unregister_region(self, name: str) -> None:
        """The server unmaps the memory ``name``, if no request uses it."""

    async def registered_regions(self) -> list[str]:
        """Names of the regions that the server maps, of all clients."""


class Region:
    """Memory that a server maps too. Taken by one request at a time. number: counts up, by when it was registered"""

    def __init__(self, owner: str, number: int, byte_size: int) -> None:
        self.name = name = f"{_PREFIX}{owner}-{number}"
        self.number = number
        self.byte_size = byte_size
        descriptor = os.open(FOLDER / name, os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_CLOEXEC, 0o600)
        try:
            os.posix_fallocate(descriptor, 0, byte_size)  # raises OSError now where a write would raise SIGBUS later
            self._memory = mmap.mmap(descriptor, byte_size)
        except OSError:
            self.unlink()
            raise
        finally:
            os.close(descriptor)

    def write(self, array: npt.NDArray[Any]) -> None:
        """Copies ``array`` to the start."""
        np.frombuffer(self._memory, array.dtype, array.size).reshape(array.shape)[...] = array

    def unlink(self) -> None:
        """Takes the name away; the memory lives while it is mapped."""
        (FOLDER / self.name).unlink(missing_ok=True)


class SharedMemory:
    """The regions that this process shares with one server. Belongs to one event loop."""

    def __init__(self, server: RegionServer) -> None:
        self._server = server
        self._id = uuid.uuid4().hex
        self._numbers = itertools.count()
        self._lock: int | None = None
        self._is_usable = True
        self._has_reclaimed = False
        self._free: list[Region] = []
        self._known: set[Region] = set()  # that the server may map
        self._tasks: set[asyncio.Task[None]] = set()  # what a call has begun, and goes on if the call is cancelled

    @asynccontextmanager
    async def lend(self, array: npt.NDArray[Any]) -> AsyncIterator[Region | None]:
        """A region that holds ``array``; None if the array is small, or the server cannot share memory."""
        region = await self._take(array.nbytes) if self._is_usable and array.nbytes >= MIN_SHARED_BYTES else None
        if region is None:
            yield None
            return
        writing = self._begin(self._fill(region, array))
        try:
            await asyncio.shield(writing)
            yield region
        finally:
            # After a call that is cancelled, the server may still read it, for an answer that is dropped.
            if writing.done():
                self._release(region)
            else:  # a thread still writes
                writing.add_done_callback(lambda _: self._release(region))

    def forget(self, region: Region) -> None:
        """The server does not know it: it was started anew since, and does not know those from before it either."""
        self._known = {known for known in self._known if known.number > region.number}
        self._free = [free for free in self._free if free in self._known]

    async def close(self) -> None:
        """Gives all regions back. One that a cancelled request uses for longer is left to the next client."""
        try:
            await asyncio.gather(*self._tasks, return_exceptions=True)
            await asyncio.gather(*map(self._unregister_when_unused, set(self._known)))
        finally:
            self._known.clear()
            self._free.clear()
            if self._lock is not None:
                (FOLDER / f"{_PREFIX}{self._id}{_LOCK_SUFFIX}").unlink(missing_ok=True)
                os.close(self._lock)
                self._lock = None

    async def _take(self, byte_size: int) -> Region | None:
        fitting = [region for region in self._free if region.byte_size >= byte_size]
        if fitting:
            region = min(fitting, key=lambda region: region.byte_size)
            self._free.remove(region)
            return region
        try:
            if self._free:  # all too small; so there are no more regions than requests at a time
                await asyncio.shield(self._begin(self._give_up(self._free.pop(0))))
            return await self._new_region(max(MIN_REGION_BYTES, 1 << (byte_size - 1).bit_length()))
        except InferenceServerException as error:
            reason = error.message() or "no reason given"
            if str(error.status()) in (*triton.UNAVAILABLE, *triton.OUT_OF_TIME) and triton.RESTRICTED not in reason:
                raise
        except _LocalError as error:
            reason = str(error)
        if self._is_usable:
            self._is_usable = False
            logger.warning("%s: no shared memory, inputs go through the socket: %s", self._server.url, reason)
        return None

    async def _new_region(self, byte_size: int) -> Region:
        try:
            if self._lock is None:
                self._lock = _hold_lock(self._id)
            region = Region(self._id, next(self._numbers), byte_size)
        except (OSError, ImportError) as error:
            raise _LocalError(error) from error
        self._known.add(region)
        try:
            await self._server.register_region(region.name, byte_size)
        except BaseException:  # the server may have mapped it all the same
            self._begin(self._drop(region))
            raise
        finally:
            region.unlink()
        return region

    def _begin(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _fill(self, region: Region, array: npt.NDArray[Any]) -> None:
        if not self._has_reclaimed:  # not before it is known that the server has the same /dev/shm
            self._has_reclaimed = True
            with suppress(InferenceServerException, asyncio.TimeoutError, *self._server.connection_errors):
                await self._reclaim()
        await off_loop(array.nbytes, region.write, array)

    def _release(self, region: Region) -> None:
        if region in self._known:
            self._free.append(region)

    async def _give_up(self, region: Region) -> None:
        """Unregisters a region. It is free again if the server keeps it."""
        await self._unregister(region)
        self._release(region)

    async def _drop(self, region: Region) -> None:
        """Drops a region that no request has used.

        A server that does not answer cannot map it later: its name is gone.
        """
        await self._unregister(region)
        self._known.discard(region)

    async def _unregister_when_unused(self, region: Region) -> None:
        """Triton uses a region until it has dropped the request, which is a moment after the answer, or after a
        cancelled request has been scored.
        """
        with suppress(asyncio.TimeoutError):
            async with timeout(ANSWER_TIMEOUT_S):
                while await self._unregister(region):
                    await asyncio.sleep(IN_USE_PAUSE_S)

    async def _unregister(self, region: Region) -> bool:
        """Has the server unmap a region. Returns whether it refuses, since a request still uses the region. That stays
        known then, and if the server does not answer.
        """
        try:
            async with timeout(ANSWER_TIMEOUT_S):
                await self._server.unregister_region(region.name)
        except InferenceServerException as error:
            return triton.REGION_IN_USE in (error.message() or "")
        except asyncio.TimeoutError:
            return False
        except self._server.connection_errors:
            return False
        self._known.discard(region)
        return False

    async def _reclaim(self) -> None:
        """Takes back what clients left that were killed."""
        for file in FOLDER.glob(f"{_PREFIX}*{_LOCK_SUFFIX}"):
            if _is_abandoned(file):
                for leftover in FOLDER.glob(f"{file.name.removesuffix(_LOCK_SUFFIX)}-*"):
                    leftover.unlink(missing_ok=True)
                file.unlink(missing_ok=True)
        async with timeout(ANSWER_TIMEOUT_S):
            for name in await self._server.registered_regions():
                match = _REGION_NAME.fullmatch(name)
                if match and not (FOLDER / f"{_PREFIX}{match['owner']}{_LOCK_SUFFIX}").exists():
                    with suppress(InferenceServerException):  # a request of the dead client still uses it
                        await self._server.unregister_region(name)


class _LocalError(Exception):
    """This machine cannot share memory, or has no more."""


def _hold_lock(owner: str) -> int:
    """Descriptor of the lock file of ``owner``. The file appears with its lock held."""
    import fcntl

    unlocked = FOLDER / f".{_PREFIX}{owner}"
    descriptor = os.open(unlocked, os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_CLOEXEC, 0o600)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    unlocked.rename(FOLDER / f"{_PREFIX}{owner}{_LOCK_SUFFIX}")
    return descriptor


def _is_abandoned(file: Path) -> bool:
    """Whether no process holds the lock."""
    import fcntl

    try:
        descriptor = os.open(file, os.O_RDWR | os.O_CLOEXEC)
    except OSError:  # gone, or another user's
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    finally:
        os.close(descriptor)
    return True
