# SPDX-License-Identifier: MIT
"""Notes of the requests inside this process, which outlive it. If it dies, ``rfm serve`` logs them."""

from __future__ import annotations

import mmap
import os
import threading
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from rfm.triton_model.request import Request

SIZE = 4096  # bytes; ids that do not fit are left out
_END = b"\0\0"


class RequestsInside:
    """The ids of the requests inside this process, in a file in memory: a zero byte between ids, two at the end.

    prefix: path of the file without the process id at its end; empty: no file
    """

    def __init__(self, prefix: str) -> None:
        self._lock = threading.Lock()
        self._ids: dict[int, str] = {}
        self._notes: mmap.mmap | None = None
        self._path = Path(f"{prefix}{os.getpid()}")
        if prefix:
            with suppress(OSError):  # no room
                file = os.open(self._path, os.O_CREAT | os.O_RDWR, 0o600)
                os.posix_fallocate(file, 0, SIZE)
                self._notes = mmap.mmap(file, SIZE)
                os.close(file)

    def close(self) -> None:
        """Remove the file of this process."""
        if self._notes is not None:
            self._path.unlink(missing_ok=True)

    def add(self, requests: Iterable[Request[Any]]) -> None:
        """Note requests before any work on them."""
        with self._lock:
            self._ids |= {id(request): request.request_id or "unnamed" for request in requests}
            self._write()

    def remove(self, requests: Iterable[Request[Any]]) -> None:
        """Strike requests that got their answers."""
        with self._lock:
            for request in requests:
                del self._ids[id(request)]
            self._write()

    def _write(self) -> None:
        if self._notes is not None:
            notes = "\0".join(self._ids.values()).encode()[: SIZE - len(_END)] + _END
            self._notes[: len(notes)] = notes
