# SPDX-License-Identifier: MIT
"""Calls that may take long, each in a thread of its own. What comes of one is looked at in the thread that began it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

Result = TypeVar("Result")


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
