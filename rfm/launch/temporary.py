# SPDX-License-Identifier: MIT
"""A server for the time of a context."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn

from rfm.launch.ending import stop_signals_to
from rfm.launch.endpoints import Endpoints
from rfm.launch.installation import find_installation
from rfm.launch.triton_server import TritonServer


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Context manager in which a stop signal raises SystemExit, so that inner contexts clean up."""

    def leave(number: int, _frame: FrameType | None) -> NoReturn:
        raise SystemExit(128 + number)

    with stop_signals_to(leave):
        yield


@contextmanager
def temporary_server(repository: Path, log: Path, tritonserver: Path | None = None) -> Iterator[Endpoints]:
    """Context manager with a server on free ports and its log in a file. Raises ServerStartError."""
    log.parent.mkdir(parents=True, exist_ok=True)
    installation = find_installation(tritonserver)
    with (
        log.open("wb") as lines,
        TritonServer(repository, Endpoints.free(), installation, log=lines) as server,
    ):
        yield server.endpoints
