# SPDX-License-Identifier: MIT
"""A server for just as long as this process needs one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn

from rfm.launch.ending import stop_signals_to
from rfm.launch.endpoints import Endpoints
from rfm.launch.installation import find_installation
from rfm.launch.process import TritonServer


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """A context in which a signal to stop raises SystemExit, so that what was started is stopped."""

    def leave(number: int, _frame: FrameType | None) -> NoReturn:
        raise SystemExit(128 + number)

    with stop_signals_to(leave):
        yield


@contextmanager
def temporary_server(repository: Path, log: Path, tritonserver: Path | None = None) -> Iterator[Endpoints]:
    """A server on free ports of this machine, with Triton's log in a file. Raises ServerStartError."""
    log.parent.mkdir(parents=True, exist_ok=True)
    installation = find_installation(tritonserver)
    with (
        log.open("wb") as lines,
        TritonServer(repository, Endpoints.free(), installation, log=lines) as server,
    ):
        yield server.endpoints
