# SPDX-License-Identifier: MIT
"""The rfm-client command in this process."""

from __future__ import annotations

import os
import re
import subprocess
import sys
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
