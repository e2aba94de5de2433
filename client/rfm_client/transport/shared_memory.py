# SPDX-License-Identifier: MIT
"""System shared memory: large inputs reach a server on the same host without a socket.

Requests take turns using a pool of regions. A region is registered with the server, and its name leaves /dev/shm once
the server has mapped it. So if this process crashes, no data stays there, only the server's mapping until a restart.

Names are random. So a server that has another /dev/shm, though its address is of this host (a container, a tunnel),
cannot map a region and refuses it, and inputs go through the socket.

Not ``tritonclient.utils.shared_memory``: its regions keep their names, and they are sparse, so that a full /dev/shm
kills the writing process (SIGBUS).
"""

from __future__ import annotations

import asyncio
import errno
import itertools
import logging
import mmap
import os
import uuid
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tritonclient.utils import InferenceServerException

from rfm_client.contract import triton
from rfm_client.contract.errors import InferenceFailedError
from rfm_client.transport.limits import timeout
from rfm_client.transport.threads import off_loop

FOLDER = Path("/dev/shm")
MIN_SHARED_BYTES = 64 * 2**10  # smaller inputs travel faster in the request itself
MIN_REGION_BYTES = 2**20
CLOSE_TIMEOUT_S = 2.0  # for the server to unmap all regions, which may still be in use
IN_USE_PAUSE_S = 0.02  # between tries to unmap a region that a request still uses

logger = logging.getLogger("rfm_client")


class Region:
    """Memory that the server also maps, after ``reserve``. Raises OSError for a name that cannot be made."""

    def __init__(self, name: str, byte_size: int) -> None:
        self.name, self.byte_size = name, byte_size
        self.was_used = False  # by a request, even one that failed
        self.is_lost = False  # the server does not know it
        (FOLDER / name).touch(0o600, exist_ok=False)

    def reserve(self) -> None:
        """Take the memory, which blocks. Raises OSError unless half of /dev/shm stays free, which the server needs."""
        room = os.statvfs(FOLDER)
        if room.f_bavail * room.f_frsize - self.byte_size < room.f_blocks * room.f_frsize / 2:
            raise OSError(errno.ENOSPC, f"less than half of {FOLDER} would stay free")
        with (FOLDER / self.name).open("r+b") as file:
            os.posix_fallocate(file.fileno(), 0, self.byte_size)  # fails now, where a write would raise SIGBUS later
            self._memory = mmap.mmap(file.fileno(), self.byte_size)

    def write(self, array: npt.NDArray[Any]) -> None:
        """Copy ``array`` to the region's start."""
        np.frombuffer(self._memory, array.dtype, array.size).reshape(array.shape)[...] = array

    def unlink(self) -> None:
        """Remove the name; the memory lives while it is mapped."""
        (FOLDER / self.name).unlink(missing_ok=True)


class SharedMemory:
    """The regions that this process shares with the server at ``url``, for one event loop.

    ``client`` is a tritonclient asyncio client for that server.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._names = (f"rfm-client-{uuid.uuid4().hex}-{number}" for number in itertools.count())
        self._is_usable = True
        self._has_warned = False
        self._free: list[Region] = []
        self._reserving = asyncio.Lock()  # or each of several would find the same room
        self._registered: set[str] = set()  # names that the server may map

    @asynccontextmanager
    async def lend(self, client: Any, array: npt.NDArray[Any]) -> AsyncIterator[Region | None]:
        """Lend a region with a copy of ``array``; None: the array is small, or there is no region for it."""
        region = await self._take(client, array.nbytes) if array.nbytes >= MIN_SHARED_BYTES else None
        if region is None:
            yield None
            return
        writing = asyncio.ensure_future(off_loop(array.nbytes, region.write, array))
        try:
            await asyncio.shield(writing)
            yield region
        except InferenceServerException as error:
            if triton.LOST_REGION in (error.message() or ""):  # the server was restarted, and knows no region
                region.is_lost = True
                if not region.was_used:
                    self._give_up("several servers share this address: one has mapped a region, another was asked")
                lost, self._free = [region, *self._free], []
                for each in lost:  # another server at this address may still map it
                    await self._unregister(client, each.name)
            raise
        finally:
            region.was_used = True
            # After a cancelled call the server may still read the region, but its answer is dropped.
            if not writing.done():  # a thread still writes
                writing.add_done_callback(lambda _: self._free.append(region))
            elif not region.is_lost:
                self._free.append(region)

    async def close(self, client: Any) -> None:
        """Make the server unmap all regions. A region that a request still uses after CLOSE_TIMEOUT_S stays mapped."""
        with suppress(asyncio.TimeoutError):
            async with timeout(CLOSE_TIMEOUT_S):
                while self._registered:
                    for name in tuple(self._registered):
                        await self._unregister(client, name)
                    if self._registered:
                        await asyncio.sleep(IN_USE_PAUSE_S)

    async def _take(self, client: Any, byte_size: int) -> Region | None:
        fitting = [region for region in self._free if region.byte_size >= byte_size]
        if fitting:
            region = min(fitting, key=lambda region: region.byte_size)
            self._free.remove(region)
            return region
        if not self._is_usable:
            return None
        if self._free:  # all too small: replace a region, so that regions never outnumber concurrent requests
            await self._unregister(client, self._free.pop().name)
        try:
            region = await self._made(max(MIN_REGION_BYTES, 1 << (byte_size - 1).bit_length()))
        except OSError as error:
            self._give_up(str(error), for_good=error.errno != errno.ENOSPC)
            return None
        self._registered.add(region.name)  # now, because a cancelled call may still map it
        try:
            await client.register_system_shared_memory(region.name, f"/{region.name}", region.byte_size)
        except InferenceServerException as error:
            reason, status = error.message() or "no reason given", str(error.status())
            if status in (*triton.UNAVAILABLE, *triton.OUT_OF_TIME) and triton.RESTRICTED not in reason:
                raise
            self._registered.discard(region.name)
            self._give_up(reason)
            return None
        except InferenceFailedError as error:  # from a proxy
            self._give_up(str(error))
            return None
        finally:
            region.unlink()
        return region

    async def _made(self, byte_size: int) -> Region:
        region = Region(next(self._names), byte_size)
        try:
            async with self._reserving:
                await off_loop(None, region.reserve)  # may wait for memory
        except BaseException:  # also if cancelled: without the name the thread's work comes to nothing
            region.unlink()
            raise
        return region

    def _give_up(self, reason: str, *, for_good: bool = True) -> None:
        """Make no more regions, or none for this input; log the first reason."""
        self._is_usable = self._is_usable and not for_good
        if not self._has_warned:
            self._has_warned = True
            logger.warning("%s: no shared memory, inputs go through the socket: %s", self._url, reason)

    async def _unregister(self, client: Any, name: str) -> None:
        """Make the server unmap a region. While a request uses it, it stays in ``_registered``."""
        try:
            await client.unregister_system_shared_memory(name)
        except InferenceServerException as error:
            if triton.REGION_IN_USE in (error.message() or ""):
                return
        except Exception as error:
            if triton.error_from(error, self._url) is None:
                raise
        self._registered.discard(name)
