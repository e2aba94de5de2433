# SPDX-License-Identifier: MIT
"""The record that a model process keeps of the batch that it works on, for those who watch it."""

from __future__ import annotations

import mmap
import os
import re
import struct
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from rfm.proc import is_alive

DIGEST_BYTES = 8
NO_DIGEST = bytes(DIGEST_BYTES)  # of what is no suspect whatever happens
SHARED_MEMORY = Path("/dev/shm")

_SUFFIX = "_batch"
_BEFORE = "before-"  # of journals of a server in whose place this one was started

_NUMBER = struct.Struct("<Q")
_SINCE = struct.Struct("<d")  # when the work last got on; 0: there is none
_PID, _REFUSED, _OWED, _CAPACITY, _NUM_PLACES, _BATCH = range(0, 6 * _NUMBER.size, _NUMBER.size)  # where they stand
_COUNT = _BATCH + _SINCE.size  # of the batch's requests, whose digests follow
_DIGESTS = _COUNT + _NUMBER.size
_PLACE_BYTES = _SINCE.size + DIGEST_BYTES  # of a request in preparation: since when, and its digest


def journal_file(region: str, model: str) -> Path:
    """The journal of the process that runs ``model`` and whose shared memory has the name ``region``."""
    return SHARED_MEMORY / f"{region}_{model}{_SUFFIX}"


def journal_files(region: str, model: str) -> list[Path]:
    """The journals of the model's processes, of the server whose process has the shared memory ``region``.

    Regions of one server differ behind the last underscore, and names of models may hold any number of them.
    """
    name = re.compile(rf"{re.escape(region.rpartition('_')[0])}_[^_]+_{re.escape(model)}{_SUFFIX}")
    return [file for file in SHARED_MEMORY.iterdir() if name.fullmatch(file.name)]


def journals_of_the_dead(prefix: str) -> dict[str, bytes]:
    """The journals of processes that have died, of the server whose regions begin with ``prefix``, by what follows."""
    files = (file for file in SHARED_MEMORY.glob(f"{prefix}*{_SUFFIX}"))
    journals = [journal for file in files if (journal := Journal.open(file)) is not None and not journal.is_alive]
    return {journal.file.name.removeprefix(prefix): journal.file.read_bytes() for journal in journals}


def all_wait(prefix: str) -> bool:
    """Whether all processes of the server whose regions begin with ``prefix`` have loaded, and have nothing to do."""
    own = [file for file in SHARED_MEMORY.glob(f"{prefix}*") if not file.name.startswith(f"{prefix}{_BEFORE}")]
    files = [file for file in own if not file.name.endswith("_lock")]
    journals = [Journal.open(file) for file in files if file.name.endswith(_SUFFIX)]
    regions = [file for file in files if not file.name.endswith(_SUFFIX)]
    return len(journals) == len(regions) > 0 and all(journal is not None and not journal.busy_s for journal in journals)


def restore_journals(prefix: str, journals: Mapping[str, bytes]) -> None:
    """Writes ``journals_of_the_dead`` for a server that was started in place of theirs.

    Its processes number their regions from the beginning; the part before the first underscore becomes another.
    """
    for number, (name, content) in enumerate(sorted(journals.items())):
        (SHARED_MEMORY / f"{prefix}{_BEFORE}{number}_{name.partition('_')[2]}").write_bytes(content)


class Journal:
    """A model process' record, in ``file``, of the batch it is working on and of the requests that it prepares beside.

    Each field is written alone, and what is prepared has one of its own: no thread's work hides another's.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        with file.open("r+b") as content:
            self._memory = mmap.mmap(content.fileno(), 0)
        self._owing = threading.Lock()
        self._going_on = threading.Lock()  # work is not renewed that has just ended

    @classmethod
    def create(cls, file: Path, capacity: int, num_places: int = 0) -> Journal:
        """The journal of this process, for batches of up to ``capacity`` requests, and ``num_places`` that are prepared
        at a time.
        """
        header = struct.pack("<5Q", os.getpid(), 0, 0, capacity, num_places)
        file.write_bytes(header + bytes(_DIGESTS - _BATCH + DIGEST_BYTES * capacity + _PLACE_BYTES * num_places))
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
        return self._number(_PID)

    @property
    def is_alive(self) -> bool:
        """Whether the process that wrote the journal still lives."""
        return is_alive(self.pid)

    @property
    def num_refused(self) -> int:
        """Requests that the quarantine has refused."""
        return self._number(_REFUSED)

    @property
    def num_owed(self) -> int:
        """Requests whose answers are still to be sent, though Triton was told that it has handed them over."""
        return self._number(_OWED)

    @property
    def busy_s(self) -> float:
        """Seconds since the batch, or what is prepared beside it, began or last got on, whichever is longer ago; 0:
        there is no work. It tells so whether the process lives or not.
        """
        began_s = [since_s for at in (_BATCH, *self._places) if (since_s := self._since_s(at))]
        return max(time.monotonic() - min(began_s), 0.0) if began_s else 0.0  # the clock is the same in all processes

    @property
    def digests(self) -> list[bytes]:
        """The digests of the batch's requests, and of those that are prepared."""
        return [self._memory[at : at + DIGEST_BYTES] for at in self._places_of_digests]

    @contextmanager
    def at_work_on(self, digests: Sequence[bytes]) -> Iterator[None]:
        """A context in which the journal names these requests as the batch in work."""
        content = b"".join(digests)
        self._memory[_DIGESTS : _DIGESTS + len(content)] = content
        _NUMBER.pack_into(self._memory, _COUNT, len(digests))
        self._set_since(_BATCH, time.monotonic())
        try:
            yield
        finally:
            self._set_since(_BATCH, 0.0)

    @contextmanager
    def preparing(self, place: int, digest: bytes) -> Iterator[None]:
        """A context in which the journal names a request that is prepared; ``place``: a number that no other has."""
        at = self._places[place]
        self._memory[at + _SINCE.size : at + _PLACE_BYTES] = digest
        self._set_since(at, time.monotonic())
        try:
            yield
        finally:
            self._set_since(at, 0.0)

    def renew(self) -> None:
        """Records that the batch has made progress, if there still is one."""
        self._renew(_BATCH)

    def renew_preparing(self, place: int) -> None:
        """Records that what is prepared in this place has made progress."""
        self._renew(self._places[place])

    def count_refused(self) -> None:
        """Counts one more request that was refused."""
        _NUMBER.pack_into(self._memory, _REFUSED, self.num_refused + 1)

    def owe(self, count: int) -> None:
        """Adds to the requests whose answers are still to be sent; ``count`` is negative when some were."""
        with self._owing:
            _NUMBER.pack_into(self._memory, _OWED, self.num_owed + count)

    def forget(self, unsuspected: bytes) -> None:
        """Takes a request out of the work, by its digest."""
        for at in self._places_of_digests:
            if self._memory[at : at + DIGEST_BYTES] == unsuspected:
                self._memory[at : at + DIGEST_BYTES] = NO_DIGEST

    def acquit(self) -> None:
        """Takes all requests out of the work: if the process ends now, it is for another reason."""
        for at in self._places_of_digests:
            self._memory[at : at + DIGEST_BYTES] = NO_DIGEST

    def close(self) -> None:
        """Unmaps the journal and removes its file."""
        self._memory.close()
        self.file.unlink(missing_ok=True)

    @property
    def _places(self) -> range:
        """Where the requests in preparation stand."""
        first = _DIGESTS + DIGEST_BYTES * self._number(_CAPACITY)
        return range(first, first + _PLACE_BYTES * self._number(_NUM_PLACES), _PLACE_BYTES)

    @property
    def _places_of_digests(self) -> list[int]:
        """Where the digests of all requests in work stand."""
        count = self._number(_COUNT) if self._since_s(_BATCH) else 0
        of_batch = range(_DIGESTS, _DIGESTS + DIGEST_BYTES * count, DIGEST_BYTES)
        return [*of_batch, *(at + _SINCE.size for at in self._places if self._since_s(at))]

    def _number(self, at: int) -> int:
        return int(_NUMBER.unpack_from(self._memory, at)[0])

    def _since_s(self, at: int) -> float:
        return float(_SINCE.unpack_from(self._memory, at)[0])

    def _set_since(self, at: int, since_s: float) -> None:
        with self._going_on:
            _SINCE.pack_into(self._memory, at, since_s)

    def _renew(self, at: int) -> None:
        with self._going_on:
            if self._since_s(at):
                _SINCE.pack_into(self._memory, at, time.monotonic())
