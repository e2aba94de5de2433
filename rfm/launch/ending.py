# SPDX-License-Identifier: MIT
"""Stop signals of this process, and the ending of its child processes."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

EXIT_TIMEOUT_S = 10  # for requests in flight; Triton also waits this long for a dead model process
KILL_AFTER_S = 2 * EXIT_TIMEOUT_S

_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_PR_SET_PDEATHSIG = 1

_prctl = ctypes.CDLL(None).prctl


@contextmanager
def stop_signals_to(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Context manager in which ``handler`` takes SIGINT, SIGTERM and SIGHUP. For the main thread."""
    previous = {number: signal.signal(number, handler) for number in _STOP_SIGNALS}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process that leads a session: gracefully, by force after KILL_AFTER_S."""
    if process.poll() is None:
        process.terminate()
    try:
        process.wait(KILL_AFTER_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def ending_with_parent() -> Callable[[], None]:
    """``preexec_fn`` for Popen: the kernel kills the new process when the thread that started it ends."""
    parent = os.getpid()

    def bind() -> None:
        _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # the parent has ended already
            os._exit(1)

    return bind
