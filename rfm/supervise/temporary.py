# SPDX-License-Identifier: MIT
"""A server for just as long as this process needs one."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn

from rfm.supervise.installation import find_installation
from rfm.supervise.process import STOP_SIGNALS, Endpoints, TritonServer


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """A context in which a signal to stop raises SystemExit, so that what was started is stopped."""

    def leave(number: int, _frame: FrameType | None) -> NoReturn:
        raise SystemExit(128 + number)

    previous = {number: signal.signal(number, leave) for number in STOP_SIGNALS}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def served(repository: Path, log: Path, tritonserver: Path | None = None) -> Iterator[Endpoints]:
    """A server on free ports of this machine, with Triton's log in a file. Raises ServerStartError.

    It is killed when the thread that starts it ends, however that ends.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    installation = find_installation(tritonserver)
    with (
        log.open("wb") as lines,
        TritonServer(repository, Endpoints.free(), installation, log=lines, ends_with_parent=True) as server,
    ):
        yield server.endpoints
