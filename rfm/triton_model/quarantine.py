# SPDX-License-Identifier: MIT
"""Requests that end the model process: their digests are known from its journal, and they are refused for a while.

Each model process keeps a journal, a small file in shared memory. It names the requests that the process works on, and
when their work last made progress, by which a hung process is known. The journal outlives the process.

The next process of the model reads the journals of dead ones. A request in one of them is a suspect. It is worked on
alone from then on, so that no other request is blamed for it; as long as there are suspects, nothing is prepared beside
a batch either. A suspect that the process survives is cleared. One that was there twice when a process died is refused
for QUARANTINE_S. After that time nobody is a suspect any more.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from rfm.journal import NO_DIGEST, Journal, journal_file, journal_files
from rfm.proc import arguments_of
from rfm.steps import telling
from rfm.triton_model.request import Request
from rfm_client.contract.errors import DEADLY, InvalidSampleError

QUARANTINE_S = 600.0
DEATHS = 2  # after which a request is refused

_REGION = 2  # which argument of a model process names its shared memory


class Quarantine:
    """The requests that have killed processes of one model, as the next process knows them.

    file: its own journal
    others: journals of the model's processes, from which those of the dead are read
    capacity, num_preparing: requests of a batch, and those that are prepared at a time, at most
    """

    def __init__(self, file: Path, others: Iterable[Path], capacity: int, num_preparing: int = 0) -> None:
        self._dead = [journal for other in others if (journal := _of_the_dead(other))]
        self._deaths = Counter(digest for journal in self._dead for digest in journal.digests if digest != NO_DIGEST)
        self._until_s = time.monotonic() + QUARANTINE_S
        self._journal = Journal.create(file, capacity, num_preparing)
        self._free_places: SimpleQueue[int] = SimpleQueue()
        for place in range(num_preparing):
            self._free_places.put(place)

    @classmethod
    def of_this_process(cls, model: str, capacity: int, num_preparing: int) -> Quarantine:
        """The quarantine of the running process, which Triton has started for ``model``."""
        return cls(own_journal(model), all_journals(model), capacity, num_preparing)

    @property
    def has_suspects(self) -> bool:
        """Whether there are requests on which a process has died, and on which this one has not worked yet."""
        return bool(self._deaths) and time.monotonic() < self._until_s

    def is_suspect(self, digest: bytes) -> bool:
        """Whether a process has died while it worked on a request of this digest."""
        return self.has_suspects and self._deaths[digest] > 0

    def check(self, digest: bytes) -> None:
        """Raises InvalidSampleError for a request that is refused."""
        deaths = self._deaths[digest] if self.has_suspects else 0
        if deaths >= DEATHS:
            self._journal.count_refused()
            got = f"one that has ended its process {deaths} times"
            until = f"it is refused for {QUARANTINE_S / 60:g} minutes"
            raise InvalidSampleError(f"{DEADLY}, got {got}: {until}")

    def groups(self, batch: Sequence[Request[Any]]) -> list[list[Request[Any]]]:
        """The requests, in groups that are worked on together: each suspect alone, and the others."""
        suspects = [[request] for request in batch if self.is_suspect(request.digest)]
        others = [request for request in batch if not self.is_suspect(request.digest)]
        return [*suspects, others] if others else suspects

    @contextmanager
    def at_work_on(self, digests: Sequence[bytes]) -> Iterator[None]:
        """A context in which these requests are worked on. When it ends, none of them is a suspect any more.

        Each step (``rfm.steps``) renews it, as it does ``preparing``.
        """
        try:
            with self._journal.at_work_on(digests), telling(self._journal.renew):
                yield
        finally:
            for digest in digests if self._deaths else ():
                if self._deaths.pop(digest, 0):
                    for journal in self._dead:
                        journal.forget(digest)

    def owe(self, count: int) -> None:
        """Notes that so many more requests are to be answered later; fewer, if it is negative."""
        self._journal.owe(count)

    @contextmanager
    def preparing(self, digest: bytes) -> Iterator[None]:
        """A context in which this request is prepared, in one of ``num_preparing`` threads."""
        place = self._free_places.get()
        try:
            with self._journal.preparing(place, digest), telling(partial(self._journal.renew_preparing, place)):
                yield
        finally:
            self._free_places.put(place)

    def renew(self) -> None:
        """Notes that the batch has got one forward pass further."""
        self._journal.renew()

    def close(self) -> None:
        """Removes the journal of a process that ends as it should."""
        self._journal.close()


def own_journal(model: str) -> Path:
    """The journal of the running process, which Triton has started for ``model``."""
    return journal_file(_region(), model)


def all_journals(model: str) -> list[Path]:
    """The journals of all processes of ``model``, dead ones included, of the Triton that has started this one."""
    return journal_files(_region(), model)


def _region() -> str:
    """Name of this process' shared memory."""
    return arguments_of(os.getpid())[_REGION]


def _of_the_dead(file: Path) -> Journal | None:
    """The journal of a dead process, if it names suspects. One that names none, or no more, is removed."""
    journal = Journal.open(file)
    if journal is None or journal.is_alive:
        return None
    if not 0 < journal.busy_s < QUARANTINE_S:
        with suppress(OSError):
            journal.close()
        return None
    return journal
