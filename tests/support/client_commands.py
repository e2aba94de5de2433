# SPDX-License-Identifier: MIT
"""The rfm-client command in this process."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
from typer.testing import CliRunner, Result

import clip
from reference_server import Served
from rfm_client import (
    FrameScores,
)
from rfm_client.cli.commands import app

RFM_CLIENT = Path(sys.executable).parent / "rfm-client"


MODEL = "enc_c1_t1_disc10"


WIDTHS = (48, 32)  # of its video and text embeddings


TASK = clip.TASK


TOLERANCE = 1e-5


def invoke(*words: object) -> Result:
    """The command in this process."""
    return CliRunner().invoke(app, [str(word) for word in words], catch_exceptions=False)


def ask(served: Served, *words: object, protocol: str = "grpc", model: str = MODEL) -> Result:
    """A command about the served model, in this process."""
    return invoke(*words, "--url", served.url(protocol), "--model", model)


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
    """The cells of each table row that begins so."""
    return [re.split(r"\s{2,}", line.strip()) for line in output.splitlines() if line.strip().startswith(row)]


def columns(output: str, row: str) -> list[str]:
    """The cells of the table row that begins so."""
    (cells,) = rows(output, row)
    return cells


def assert_scores(document: dict[str, Any], scores: FrameScores) -> None:
    np.testing.assert_allclose(document["progress"], scores.progress, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(document["success"], scores.success, rtol=0, atol=TOLERANCE)


@contextmanager
def web_server(folder: Path) -> Iterator[str]:
    class Silent(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Silent, directory=str(folder))) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()
