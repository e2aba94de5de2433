# SPDX-License-Identifier: MIT
"""Calls that may take long, each in a thread of its own. What comes of one is looked at in the thread that began it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

Result = TypeVar("Result")

logger = logging.getLogger(__name__)


def in_background(name: str, call: Callable[[], Result]) -> Future[Result]:
    """The future of a call that begins now. Nobody waits for it when the process ends, as a pool would.

    The future raises what the call raises, and OSError if no thread can be started.
    """
    future: Future[Result] = Future()

    def run() -> None:
        try:
            future.set_result(call())
        except Exception as error:  # noqa: BLE001  it is raised where the result is read
            future.set_exception(error)

    try:
        threading.Thread(target=run, name=name, daemon=True).start()
    except RuntimeError as error:  # this machine has no room for a thread now
        future.set_exception(OSError(str(error)))
    return future


class Calls(Generic[Result]):
    """Calls in the background of one kind, one at a time.

    expected: errors that say no more than that there is no answer. Of any other, the first of a row is logged.
    """

    def __init__(self, name: str, expected: tuple[type[Exception], ...]) -> None:
        self._name = name
        self._expected = expected
        self._current: Future[Result] | None = None
        self._is_logged = False

    @property
    def is_under_way(self) -> bool:
        """Whether a call has begun that ``ended`` has not given."""
        return self._current is not None

    def begin(self, call: Callable[[], Result]) -> None:
        """Begins the next call."""
        self._current = in_background(self._name, call)

    def ended(self) -> Future[Result] | None:
        """The call that has ended, once; None: there is none."""
        if self._current is None or not self._current.done():
            return None
        ended, self._current = self._current, None
        error = ended.exception()
        is_unexpected = error is not None and not isinstance(error, self._expected)
        if is_unexpected and not self._is_logged:
            logger.error("%s: an unexpected error", self._name, exc_info=error)
        self._is_logged = is_unexpected or (self._is_logged and error is not None)
        return ended
