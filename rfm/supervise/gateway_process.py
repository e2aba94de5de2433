# SPDX-License-Identifier: MIT
"""The gateway that ``rfm serve`` runs beside Triton."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Sequence

from rfm.launch.ending import end, ending_with_parent
from rfm.supervise.back_off import BackOff


class GatewayProcess:
    """Runs the command line from ``start`` to ``stop``; ``look``, called often, starts it again when it has ended."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command
        self._back_off = BackOff("gateway")
        self._process: subprocess.Popen[bytes] | None = None
        self._due_s: float | None = None

    def start(self) -> None:
        """Starts the gateway as a child process."""
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, preexec_fn=ending_with_parent(), start_new_session=True
        )
        self._back_off.started()

    def look(self) -> str | None:
        """Starts the gateway again if it has ended, and gives why; None: it was not started. Raises CrashLoopError."""
        if self._process is None or self._process.poll() is None:
            return None
        why = f"exit status {self._process.returncode}"
        if self._due_s is None:
            self._due_s = time.monotonic() + self._back_off.pause_s(why)
        if time.monotonic() < self._due_s:
            return None
        self._due_s = None
        self.start()
        return why

    def stop(self) -> None:
        """Lets the gateway answer the requests in flight, and ends it; by force after KILL_AFTER_S."""
        if self._process is not None:
            end(self._process)
