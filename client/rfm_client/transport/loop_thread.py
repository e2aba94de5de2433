# SPDX-License-Identifier: MIT
"""An event loop in a thread of its own, for callers that have none."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from typing import Any, TypeVar

Returned = TypeVar("Returned")


class LoopThread:
    """Runs coroutines for any number of threads until it is stopped."""

    def __init__(self, name: str) -> None:
        self._loop = asyncio.new_event_loop()
        self._process_id = os.getpid()
        self._starting = threading.Lock()  # between looking whether it is stopped and relying on the answer
        self._is_stopped = False
        self._thread = threading.Thread(target=self._loop.run_forever, name=name, daemon=True)
        self._thread.start()

    def start(self, coroutine: Coroutine[Any, Any, Returned]) -> Future[Returned]:
        """The coroutine's result to come; cancelling it cancels the coroutine. Raises RuntimeError if it cannot run."""
        problem = None
        if os.getpid() != self._process_id:
            problem = f"was made in process {self._process_id}, which forked this one: make one in each process"
        with self._starting:
            if self._is_stopped:
                problem = "is closed"
            if problem is None:
                return asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        coroutine.close()
        raise RuntimeError(f"this RewardClient {problem}")

    def wait(self, coroutine: Coroutine[Any, Any, Returned]) -> Returned:
        """The coroutine's result. Raises RuntimeError in the callback of a future, where it would wait for itself."""
        if threading.current_thread() is self._thread:
            coroutine.close()
            raise RuntimeError("expected a call from another thread, got one from a callback of a future: use submit")
        future = self.start(coroutine)
        try:
            return future.result()
        finally:
            future.cancel()  # of a call that was interrupted; what is done stays done

    def stop(self, last: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Cancels what runs, runs ``last``, and ends the thread. Not in a fork, which has not got the thread."""
        if os.getpid() != self._process_id:
            return
        with self._starting:
            if self._is_stopped:
                return
            self._is_stopped = True
            ended = asyncio.run_coroutine_threadsafe(self._end(last), self._loop)
        if threading.current_thread() is self._thread:  # the last reference was in a callback of a future
            return
        try:
            ended.result()
        finally:
            self._thread.join()
            self._loop.close()

    async def _end(self, last: Callable[[], Coroutine[Any, Any, None]]) -> None:
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        try:
            await asyncio.gather(*others, return_exceptions=True)
            await last()
            await self._loop.shutdown_default_executor()
        finally:
            self._loop.call_soon(self._loop.stop)
