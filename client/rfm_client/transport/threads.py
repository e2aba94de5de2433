# SPDX-License-Identifier: MIT
"""A client's threads and event loops; base classes for objects with connections."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NoReturn, ParamSpec, TypeVar

from rfm_client.contract.errors import ClientClosedError, clear_variables

if TYPE_CHECKING:
    from typing_extensions import Self

Arguments = ParamSpec("Arguments")
Returned = TypeVar("Returned")

MIN_BYTES = 2 * 2**20  # copying less takes no longer than switching threads


class OneProcess:
    """An object with a connection, which cannot be pickled or copied."""

    def __reduce__(self) -> NoReturn:
        raise TypeError(
            f"{type(self).__name__}: expected an object without a connection to pickle or copy: pass "
            "functools.partial(RewardClient, url) instead, and call that in each process"
        )


class Closing:
    """A context manager that closes itself."""

    def close(self) -> None:
        """Release this object's resources."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_raised: object) -> None:
        self.close()


class AsyncClosing:
    """An async context manager that closes itself."""

    async def close(self) -> None:
        """Release this object's resources."""
        raise NotImplementedError

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_raised: object) -> None:
        await self.close()


async def off_loop(
    num_bytes: int | None, work: Callable[Arguments, Returned], *arguments: Arguments.args, **options: Arguments.kwargs
) -> Returned:
    """Return the result of ``work``, which handles ``num_bytes``. From MIN_BYTES, or for None, it runs in a thread."""
    if num_bytes is not None and num_bytes < MIN_BYTES:
        return work(*arguments, **options)
    return await asyncio.to_thread(work, *arguments, **options)


class LoopThread:
    """An event loop that runs coroutines for any number of threads, until ``stop``."""

    def __init__(self, name: str) -> None:
        self._loop = asyncio.new_event_loop()
        self._workers = ThreadPoolExecutor()  # the loop's own would need a new thread to end, which 3.12 denies at exit
        self._loop.set_default_executor(self._workers)
        self._process_id = os.getpid()
        self._starting = threading.Lock()  # _is_stopped must not change between check and use
        self._is_stopped = False
        self._cancelled: set[asyncio.Task[Any]] = set()  # by ``stop``
        self._thread = threading.Thread(target=self._loop.run_forever, name=name, daemon=True)
        self._thread.start()

    def start(self, coroutine: Coroutine[Any, Any, Returned]) -> Future[Returned]:
        """Return the coroutine's future, which can cancel it.

        Raises ClientClosedError after ``stop``, and RuntimeError in a fork. If ``stop`` cancels the coroutine, the
        future also raises ClientClosedError.
        """
        error: RuntimeError = ClientClosedError("this RewardClient is closed")
        if os.getpid() != self._process_id:
            made = f"was made in process {self._process_id}, which forked this one: make one in each process"
            error = RuntimeError(f"this RewardClient {made}")
        else:
            with self._starting:
                if not self._is_stopped:
                    return asyncio.run_coroutine_threadsafe(self._until_stopped(coroutine), self._loop)
        coroutine.close()
        raise error

    def check_caller(self) -> None:
        """Raise RuntimeError in a future's callback, which would wait for itself."""
        if threading.current_thread() is self._thread:
            raise RuntimeError("expected a call from another thread, got one from a callback of a future: use submit")

    def wait(self, coroutine: Coroutine[Any, Any, Returned]) -> Returned:
        """Return the coroutine's result. Raises RuntimeError as ``check_caller`` does."""
        try:
            self.check_caller()
        except RuntimeError:
            coroutine.close()
            raise
        future = self.start(coroutine)
        try:
            return future.result()
        except Exception as error:
            clear_variables(error)
            raise
        finally:
            future.cancel()  # after an interrupt; does nothing on a finished future
            del future  # it holds the error

    def stop(self, last: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Cancel all coroutines, run ``last``, and end the thread. Does nothing in a fork, which lacks the thread."""
        if os.getpid() != self._process_id:
            return
        with self._starting:
            if self._is_stopped:
                return
            self._is_stopped = True
            ended = asyncio.run_coroutine_threadsafe(self._end(last), self._loop)
        if threading.current_thread() is self._thread:  # a future's callback dropped the last reference
            return
        try:
            ended.result()
        finally:
            self._thread.join()
            self._workers.shutdown()
            self._loop.close()

    async def _until_stopped(self, coroutine: Coroutine[Any, Any, Returned]) -> Returned:
        try:
            return await coroutine
        except asyncio.CancelledError:
            if asyncio.current_task() not in self._cancelled:
                raise
            raise ClientClosedError("this RewardClient was closed during the call") from None

    async def _end(self, last: Callable[[], Coroutine[Any, Any, None]]) -> None:
        self._cancelled = asyncio.all_tasks() - {asyncio.current_task()}
        for task in self._cancelled:
            task.cancel()
        try:
            await asyncio.gather(*self._cancelled, return_exceptions=True)
            await last()
        finally:
            self._workers.shutdown(wait=False)
            # After a cancelled call, a TLS connection waits for its peer's goodbye, which comes too late or never.
            for transport in [*getattr(self._loop, "_transports", {}).values()]:
                transport.abort()
            self._loop.call_soon(self._loop.stop)
