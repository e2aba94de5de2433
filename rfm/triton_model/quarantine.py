# SPDX-License-Identifier: MIT
"""Requests that kill the model process: told by what it was working on when it died, and refused for a while.

Each model process keeps a journal, a small file in shared memory, of the batch that it is working on, and of when that
batch last got on, by which a process that hangs is known. The journal outlives the process. The next process of the
model reads the journals of the dead: what stands in one is a suspect, which is worked on alone from then on, so that no
neighbour is blamed for it. A suspect that is survived is none any more; one that was there twice when a process died is
refused for POISON_S.
"""

from __future__ import annotations

import hashlib
import os
import re
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm.journal import DIGEST_BYTES, NO_DIGEST, SUFFIX, Journal
from rfm_client.contract.errors import DEADLY, InvalidSampleError

POISON_S = 600.0
DEATHS = 2  # after which a request is refused

_FOLDER = Path("/dev/shm")
_SAMPLED_BYTES = 2**14  # of each tensor: a digest shall cost microseconds, whatever the size
_BLOCK_BYTES = 2**9
_STUB_REGION = 2  # which argument of a model process names its shared memory
_ZOMBIE = "Z"


def digest(tensors: Mapping[str, npt.NDArray[Any]]) -> bytes:
    """8 bytes that tell a request's inputs from others; of large tensors shape and an even sample of the content."""
    told = hashlib.sha1(usedforsecurity=False)
    for name in sorted(tensors):
        array = tensors[name]
        told.update(f"{name}{array.shape}".encode())
        told.update(_sampled(array))
    return told.digest()[:DIGEST_BYTES]


class Poison:
    """What one model process knows of requests that kill it.

    file: its own journal
    others: journals of the model's processes, from which those of the dead are read
    """

    def __init__(self, file: Path, others: Iterable[Path], capacity: int) -> None:
        self._dead = [journal for other in others if (journal := _of_the_dead(other))]
        self._deaths = Counter(told for journal in self._dead for told in journal.digests if told != NO_DIGEST)
        self._until_s = time.monotonic() + POISON_S
        self._journal = Journal.create(file, capacity)

    @classmethod
    def of_this_process(cls, model: str, capacity: int) -> Poison:
        """That of the process that runs, which Triton has started for ``model``."""
        region = os.fsdecode(Path("/proc/self/cmdline").read_bytes().split(b"\0")[_STUB_REGION])
        return cls(_FOLDER / f"{region}_{model}{SUFFIX}", journals(_FOLDER, region, model), capacity)

    def is_suspect(self, told: bytes) -> bool:
        """Whether a process has died while it worked on this request."""
        return self._deaths[told] > 0 if self._deaths else False

    def check(self, told: bytes) -> None:
        """Raises InvalidSampleError for a request that is refused."""
        if self.is_suspect(told) and self._deaths[told] >= DEATHS and time.monotonic() < self._until_s:
            self._journal.count_refused()
            got = f"one that has ended its process {self._deaths[told]} times"
            until = f"it is refused for {POISON_S / 60:g} minutes"
            raise InvalidSampleError(f"{DEADLY}, got {got}: {until}")

    @contextmanager
    def at_work_on(self, digests: Sequence[bytes]) -> Iterator[None]:
        """Within it, these requests are worked on. If it ends, none of them is a suspect any more."""
        try:
            with self._journal.at_work_on(digests):
                yield
        finally:
            for told in digests if self._deaths else ():
                if self._deaths.pop(told, 0):
                    for journal in self._dead:
                        journal.forget(told)

    def renew(self) -> None:
        """What is worked on has got on."""
        self._journal.renew()

    def close(self) -> None:
        """The process ends as it should."""
        self._journal.close()


def journals(folder: Path, region: str, model: str) -> list[Path]:
    """Those of the model's processes, of the server whose process has the shared memory ``region``.

    Regions of one server differ behind the last underscore, and names of models may hold any number of them.
    """
    name = re.compile(rf"{re.escape(region.rpartition('_')[0])}_[^_]+_{re.escape(model)}{SUFFIX}")
    return [file for file in folder.iterdir() if name.fullmatch(file.name)]


def _of_the_dead(file: Path) -> Journal | None:
    """A journal that tells of suspects. One that tells of nothing, or no more, is removed."""
    journal = Journal.open(file)
    if journal is None or _is_alive(journal.pid):
        return None
    if not 0 < journal.busy_s < POISON_S:
        with suppress(OSError):
            journal.close()
        return None
    return journal


def _is_alive(pid: int) -> bool:
    try:
        stat = Path("/proc", str(pid), "stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
    return stat.rpartition(")")[2].split()[0] != _ZOMBIE


def _sampled(array: npt.NDArray[Any]) -> bytes | memoryview:
    """The content, or blocks of it at even distances."""
    if array.dtype == np.object_:
        return b"\0".join(bytes(item) for item in array.ravel())
    content = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
    if content.nbytes <= _SAMPLED_BYTES:
        return content.data
    blocks = content[-(content.nbytes // _BLOCK_BYTES) * _BLOCK_BYTES :].reshape(-1, _BLOCK_BYTES)
    step = -(-len(blocks) * _BLOCK_BYTES // _SAMPLED_BYTES)
    return np.ascontiguousarray(blocks[::step]).data
