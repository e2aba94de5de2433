# SPDX-License-Identifier: MIT
"""How soon something that has ended is started again, and when that is given up."""

from __future__ import annotations

import time

from rfm.launch.installation import ServerStartError

STEADY_S = 60.0  # whatever has run for so long is no part of a crash loop
MOST = 5  # restarts in a row
LONGEST_PAUSE_S = 10.0
_FIRST_PAUSE_S = 0.5


class CrashLoopError(ServerStartError):
    """A process ended so often that it is not started again."""


class BackOff:
    """The pauses before one thing is started again: none at first, longer ones where the starts follow closely."""

    def __init__(self, what: str, steady_s: float = STEADY_S) -> None:
        self._what, self._steady_s = what, steady_s
        self._row = 0
        self._running_since_s: float | None = None  # None: it has ended

    def started(self) -> None:
        """Records a start, from which the next pause is computed."""
        self._running_since_s = time.monotonic()

    def pause_s(self, reason: str) -> float:
        """Seconds to wait before the next start, after an exit or a failed start.

        Raises CrashLoopError when it is one.
        """
        if self._running_since_s is not None and time.monotonic() - self._running_since_s >= self._steady_s:
            self._row = 0
        self._running_since_s = None  # a start that failed does not count as running, however long it took
        self._row += 1
        if self._row > MOST:
            got = f"{self._row} ends, each within {self._steady_s:g} s of a start; the last: {reason}"
            raise CrashLoopError(f"{self._what}: expected to run, got {got}")
        return 0.0 if self._row == 1 else min(_FIRST_PAUSE_S * 2.0 ** (self._row - 2), LONGEST_PAUSE_S)
