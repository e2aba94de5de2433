# SPDX-License-Identifier: MIT
"""Stop signals of this process, and the end of the processes that it starts."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from types import FrameType
from typing import Any

EXIT_TIMEOUT_S = 10  # for requests in flight; Triton also waits this long for a dead model process
KILL_AFTER_S = 2 * EXIT_TIMEOUT_S
REAP_S, POLL_S = 5.0, 0.02  # a driver or a disk may keep a killed process for longer

_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_SIGNALS = {each.value: each.name for each in signal.Signals}
_SENTINEL = ("/bin/sh", "-c", "trap '' HUP INT TERM; read _; kill -KILL 0")  # 0: its process group


@contextmanager
def stop_signals_to(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Context manager in which ``handler`` takes SIGINT, SIGTERM and SIGHUP. For the main thread."""
    previous = {number: signal.signal(number, handler) for number in _STOP_SIGNALS}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


class ProcessGroup:
    """A process and all that it starts. They end with this process, even if SIGKILL ends it.

    A shell leads the group. It reads a pipe that only this process can write, and kills the group at the end of the
    pipe. Until ``end``, no other group can have its id.
    """

    def __init__(self, command: Sequence[str | os.PathLike[str]], **options: Any) -> None:
        """Start the process. Raises OSError."""
        self._sentinel = subprocess.Popen(_SENTINEL, stdin=subprocess.PIPE, preexec_fn=os.setpgrp)
        self.id = self._sentinel.pid
        try:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                preexec_fn=partial(os.setpgid, 0, self.id),  # so that only this process passes on a Ctrl-C
                restore_signals=False,  # SIGPIPE stays ignored: a log that nobody reads ends no process
                **options,
            )
        except BaseException:
            self._sentinel.communicate()
            raise

    def kill(self) -> None:
        """Kill all processes of the group."""
        if self._sentinel.returncode is None:  # else the id may be another group's
            os.killpg(self.id, signal.SIGKILL)

    def end(self) -> None:
        """End the process gracefully, by force after KILL_AFTER_S, then all others."""
        if self._sentinel.returncode is not None:  # they have ended
            return
        self.process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(KILL_AFTER_S)
        self.kill()
        self.process.wait()
        ends_s = time.monotonic() + REAP_S
        with suppress(ChildProcessError):
            while time.monotonic() < ends_s:  # orphans, too: the first process of a container inherits them
                if os.waitpid(-self.id, os.WNOHANG) == (0, 0):
                    time.sleep(POLL_S)
        self._sentinel.communicate()  # closes the pipe, and notes the end


def how_it_ended(status: int) -> str:
    """Return an exit status in words. status: as of Popen, negative after a signal"""
    return f"killed by {_SIGNALS.get(-status, -status)}" if status < 0 else f"exit status {status}"
