# SPDX-License-Identifier: MIT
"""Notes of the requests inside this process, which outlive it. If it dies, ``rfm serve`` logs them."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

from rfm.triton_model.request import Request
from rfm_client.contract.process_log import ids_in_log

MOST_BYTES = 4096


class RequestsInside:
    """The ids of the requests inside this process, in a file.

    prefix: path of the file without the process id at its end; empty: no file
    """

    def __init__(self, prefix: str) -> None:
        self._lock = threading.Lock()
        self._ids: dict[int, str] = {}
        self._file = os.open(f"{prefix}{os.getpid()}", os.O_CREAT | os.O_WRONLY, 0o600) if prefix else -1

    def add(self, requests: Iterable[Request[Any]]) -> None:
        """Note requests before any work on them."""
        with self._lock:
            self._ids |= {id(request): ids_in_log([request.request_id]) or "unnamed" for request in requests}
            self._write()

    def remove(self, requests: Iterable[Request[Any]]) -> None:
        """Strike requests that got their answers."""
        with self._lock:
            for request in requests:
                del self._ids[id(request)]
            self._write()

    def close(self) -> None:
        """Close the file of the notes."""
        if self._file >= 0:
            os.close(self._file)

    def _write(self) -> None:
        if self._file >= 0:
            with suppress(OSError):  # no room
                os.pwrite(self._file, " ".join(self._ids.values())[:MOST_BYTES].encode() + b"\n", 0)
