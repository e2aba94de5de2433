# SPDX-License-Identifier: MIT
"""The record that a model process keeps of the batch that it works on, for those who watch it."""

from __future__ import annotations

import mmap
import os
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

DIGEST_BYTES = 8
NO_DIGEST = bytes(DIGEST_BYTES)  # of what is no suspect whatever happens
SUFFIX = "_batch"

_ZOMBIE = "Z"
_HEADER = struct.Struct("<QQdQ")  # process id, requests refused, when the batch last got on (0: idle), its requests


class Journal:
    """A model process' record of the batch it is working on, in ``file``."""

    def __init__(self, file: Path) -> None:
        self.file = file
        with file.open("r+b") as content:
            self._memory = mmap.mmap(content.fileno(), 0)

    @classmethod
    def create(cls, file: Path, capacity: int) -> Journal:
        """The journal of this process, for batches of up to ``capacity`` requests."""
        file.write_bytes(_HEADER.pack(os.getpid(), 0, 0.0, 0) + bytes(DIGEST_BYTES * capacity))
        return cls(file)

    @classmethod
    def open(cls, file: Path) -> Journal | None:
        """The journal in ``file``; None: there is none."""
        try:
            return cls(file)
        except (OSError, ValueError):  # gone, or not written yet
            return None

    @property
    def pid(self) -> int:
        """The process that wrote it."""
        return int(self._header[0])

    @property
    def is_alive(self) -> bool:
        """Whether the process that wrote the journal still lives."""
        return is_alive(self.pid)

    @property
    def num_refused(self) -> int:
        """Requests that the quarantine has refused."""
        return int(self._header[1])

    @property
    def busy_s(self) -> float:
        """Seconds since the batch began or last made progress, whether the process lives or not; 0: no batch."""
        since_s = self._header[2]
        return max(time.monotonic() - since_s, 0.0) if since_s else 0.0  # the clock is the same in all processes

    @property
    def digests(self) -> list[bytes]:
        """The digests of the batch's requests."""
        count = self._header[3] if self._header[2] else 0
        places = range(_HEADER.size, _HEADER.size + DIGEST_BYTES * count, DIGEST_BYTES)
        return [self._memory[place : place + DIGEST_BYTES] for place in places]

    @contextmanager
    def at_work_on(self, digests: Sequence[bytes]) -> Iterator[None]:
        """A context in which the journal names these requests as the batch in work."""
        content = b"".join(digests)
        self._memory[_HEADER.size : _HEADER.size + len(content)] = content
        self._write(time.monotonic(), len(digests))
        try:
            yield
        finally:
            self._write(0.0, 0)

    def renew(self) -> None:
        """Records that the batch has made progress."""
        self._write(time.monotonic(), self._header[3])

    def count_refused(self) -> None:
        """Counts one more request that was refused."""
        _HEADER.pack_into(self._memory, 0, self.pid, self.num_refused + 1, *self._header[2:])

    def forget(self, unsuspected: bytes) -> None:
        """Takes a request out of the batch, by its digest."""
        for number, known in enumerate(self.digests):
            if known == unsuspected:
                place = _HEADER.size + DIGEST_BYTES * number
                self._memory[place : place + DIGEST_BYTES] = NO_DIGEST

    def close(self) -> None:
        """Unmaps the journal and removes its file."""
        self._memory.close()
        self.file.unlink(missing_ok=True)

    @property
    def _header(self) -> tuple[Any, ...]:
        return _HEADER.unpack_from(self._memory)

    def _write(self, since_s: float, count: int) -> None:
        _HEADER.pack_into(self._memory, 0, self.pid, self.num_refused, since_s, count)


def is_alive(pid: int) -> bool:
    """Whether there is a process of this id that has not ended."""
    try:
        stat = Path("/proc", str(pid), "stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
    return stat.rpartition(")")[2].split()[0] != _ZOMBIE
