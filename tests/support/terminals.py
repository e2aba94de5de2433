# SPDX-License-Identifier: MIT
"""Commands on a terminal, as wide as a test wants."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import termios
import threading
from collections.abc import Sequence
from contextlib import suppress

WIDTH = 80
_LINES = 50
_CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class Terminal:
    """A command on a terminal, with standard error. ``shown`` grows while the command runs."""

    def __init__(self, command: Sequence[str], width: int = WIDTH) -> None:
        self._ours, its = pty.openpty()
        fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", _LINES, width, 0, 0))
        environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "TERMINAL_WIDTH")}
        options = {"stdin": its, "stdout": its, "stderr": its, "env": {**environment, "TERM": "xterm"}}
        self.process = subprocess.Popen(command, **options)
        os.close(its)
        self._shown: list[bytes] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def shown(self) -> str:
        """What the terminal has shown. A progress bar overwrites the line from the start."""
        lines = (
            line.rpartition("\r\x1b[2K")[2] for line in b"".join(self._shown).decode(errors="replace").split("\r\n")
        )
        return "\n".join(_CONTROL.sub("", line).rstrip() for line in lines)

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join()
        os.close(self._ours)

    def _read(self) -> None:
        with suppress(OSError):  # it is closed
            while part := os.read(self._ours, 4096):
                self._shown.append(part)
