# SPDX-License-Identifier: MIT
"""The rfm-client command, in this process or on a terminal as wide as a test wants."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from typer.testing import Result

import clip
from in_process import rfm_client as invoke
from rfm_client import FrameScores
from tolerances import TOLERANCE

if TYPE_CHECKING:
    from engine_server import EngineServer

RFM_CLIENT = Path(sys.executable).parent / "rfm-client"
MODEL = "enc_c1_t1_disc10"
WIDTHS = (48, 32)  # of video and text embeddings
TASK = clip.TASK
_LINES, _COLUMNS = 50, 80
_CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


def ask(server: EngineServer, *words: object, model: str = MODEL) -> Result:
    """A command about the served model, in this process."""
    return invoke(*words, "--url", server.url, "--model", model)


def run(*words: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """The command as a user calls it."""
    return subprocess.run(
        [str(RFM_CLIENT), *map(str, words)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def rows(output: str, row: str) -> list[list[str]]:
    """Return the cells of table rows with this beginning."""
    return [re.split(r"\s{2,}", line.strip()) for line in output.splitlines() if line.strip().startswith(row)]


def columns(output: str, row: str) -> list[str]:
    """Return the cells of the table row with this beginning."""
    (cells,) = rows(output, row)
    return cells


def assert_scores(document: dict[str, Any], scores: FrameScores) -> None:
    np.testing.assert_allclose(document["progress"], scores.progress, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(document["success"], scores.success, rtol=0, atol=TOLERANCE)


class Terminal:
    """A command on a terminal, with standard error. ``shown`` grows while the command runs."""

    def __init__(self, command: Sequence[str]) -> None:
        self._ours, its = pty.openpty()
        fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", _LINES, _COLUMNS, 0, 0))
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
