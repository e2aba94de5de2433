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

from client_commands import RFM_CLIENT

WIDTH = 80
_LINES = 50
_CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def on_terminal(*words: object, width: int = WIDTH) -> tuple[int, list[str]]:
    """Return the exit code of ``rfm-client`` and the lines on a terminal, with standard error."""
    ours, its = pty.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", _LINES, width, 0, 0))
    environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "TERMINAL_WIDTH")}
    command = [str(RFM_CLIENT), *map(str, words)]
    with subprocess.Popen(command, stdin=its, stdout=its, stderr=its, env={**environment, "TERM": "xterm"}) as process:
        os.close(its)
        shown = b"".join(iter(lambda: _read(ours), b""))
        code = process.wait(timeout=60)
    os.close(ours)
    # A progress bar overwrites the line from the start.
    lines = (line.rpartition("\r\x1b[2K")[2].rstrip("\r") for line in shown.decode().split("\n"))
    return code, [_CONTROL.sub("", line).rstrip() for line in lines]


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 4096)
    except OSError:  # it is closed
        return b""
