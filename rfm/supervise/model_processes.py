# SPDX-License-Identifier: MIT
"""The model processes of a tritonserver ("stubs", one for each instance of a model), as /proc shows them.

Triton does not notice that a stub is dead until it has a request for it, and keeps it as a zombie until the model is
unloaded. So a stub that is a zombie is one that was killed, or has crashed.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rfm.journal import SUFFIX, Journal

CONFIRM_S = 0.3  # one that was unloaded is a zombie for a moment, too
STOPPED_S = 3.0  # by SIGSTOP, say, before it counts as hung

SHARED_MEMORY = Path("/dev/shm")
_PROC = Path("/proc")
_PROGRAM = b"triton_python_backend_stub"
_ZOMBIE, _STOPPED = "Z", "T"
_PARENT, _STARTED = 1, 19  # places in what _stat gives
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Stub:
    """One model process. started_ticks: by the kernel's clock; no other process of this id has it"""

    pid: int
    started_ticks: int
    model: str
    version: int
    region: str  # name of its shared memory

    @property
    def serves(self) -> tuple[str, int]:
        """Name and version of the model that this process runs."""
        return self.model, self.version

    @property
    def is_alive(self) -> bool:
        """Whether it has not ended."""
        return self.state not in (None, _ZOMBIE)

    @property
    def state(self) -> str | None:
        """State of the process, as the kernel has it; None: there is no such process."""
        fields = _stat(self.pid)
        return fields[0] if fields and int(fields[_STARTED]) == self.started_ticks else None

    @property
    def started_s(self) -> float:
        """When it was started, by time.monotonic."""
        age_s = time.clock_gettime(time.CLOCK_BOOTTIME) - self.started_ticks / _TICKS_PER_S
        return time.monotonic() - age_s

    @property
    def journal(self) -> Journal | None:
        """What it is working on; None: it has written nothing."""
        return Journal.open(SHARED_MEMORY / f"{self.region}_{self.model}{SUFFIX}")

    def kill(self) -> None:
        """Ends the process at once, whatever it does."""
        if self.is_alive:
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)


class StubWatch:
    """Finds the stubs of the tritonserver ``triton_pid`` that have died, or hang. It leaves those that still load to
    Triton.

    hang_s: what one forward pass may take before its stub counts as hung
    """

    def __init__(self, triton_pid: int, hang_s: float) -> None:
        self._triton_pid = triton_pid
        self._hang_s = hang_s
        self._stubs: set[Stub] = set()
        self._loaded: set[Stub] = set()
        self._watched: set[Stub] = set()
        self._forgotten: set[Stub] = set()
        self._since: dict[tuple[Stub, str], float] = {}  # stub and state: when it was first seen so

    def update(
        self, ready: Collection[tuple[str, int]], going: Collection[tuple[str, int]], requested_s: float
    ) -> None:
        """Takes in which versions of models were ready at ``requested_s``, and which were on their way to or from that.

        The stubs of a version that is ready have loaded. A version that is loaded once more stays ready meanwhile, so
        its new stubs have loaded when the old ones are gone.
        """
        self._scan()
        self._loaded &= self._stubs
        old = {stub.serves for stub in self._loaded}
        new = {stub for stub in self._stubs if stub.serves in ready and stub.serves not in old}
        self._loaded |= {stub for stub in new if stub.started_s < requested_s}
        self._watched = {stub for stub in self._loaded if stub.serves not in going}

    def dead(self) -> list[Stub]:
        """The stubs that have died and were not forgotten."""
        self._look()
        return [stub for stub in self._watched if self._has_been(stub, _ZOMBIE, CONFIRM_S)]

    def hung(self) -> list[tuple[Stub, str]]:
        """The stubs that live and make no progress, and why."""
        found = []
        for stub in self._watched:
            journal = stub.journal
            if self._has_been(stub, _STOPPED, STOPPED_S):
                found.append((stub, f"stopped for {STOPPED_S:g} s"))
            elif journal is not None and journal.busy_s > self._hang_s and stub.is_alive:
                found.append((stub, f"no forward pass further for {self._hang_s:g} s"))
        return found

    def is_getting_on(self, model: str) -> bool:
        """Whether one of the model's stubs is at work, and none of its forward passes takes too long."""
        journals = [stub.journal for stub in self._watched if stub.model == model and stub.is_alive]
        return any(journal is not None and 0 < journal.busy_s <= self._hang_s for journal in journals)

    def of_model(self, model: str) -> list[Stub]:
        """The model's stubs, dead or alive."""
        self._scan()
        return [stub for stub in self.all if stub.model == model]

    @property
    def all(self) -> list[Stub]:
        """All processes of models that are known now."""
        return list(self._stubs)

    def forget(self, stubs: Iterable[Stub]) -> None:
        """Forgets stubs that were replaced: they are found no more."""
        self._forgotten.update(stubs)
        self._stubs -= self._forgotten
        self._loaded -= self._forgotten
        self._watched -= self._forgotten

    def _look(self) -> None:
        now_s = time.monotonic()
        states = {stub: stub.state for stub in self._watched}
        seen = {(stub, state) for stub, state in states.items() if state in (_ZOMBIE, _STOPPED)}
        self._since = {key: self._since.get(key, now_s) for key in seen}

    def _has_been(self, stub: Stub, state: str, duration_s: float) -> bool:
        since_s = self._since.get((stub, state))
        return since_s is not None and time.monotonic() - since_s >= duration_s

    def _scan(self) -> None:
        known = {stub for stub in self._stubs if stub.state is not None}  # of a zombie nothing can be read
        found = (_stub(folder, self._triton_pid) for folder in _PROC.glob("[0-9]*"))
        self._forgotten = {stub for stub in self._forgotten if stub.state is not None}
        self._stubs = known | {stub for stub in found if stub is not None} - self._forgotten


def _stat(pid: int) -> list[str]:
    """The fields of /proc/<pid>/stat behind the process' name, which may hold anything: state, parent and so on."""
    try:
        return (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return []


def _stub(folder: Path, parent: int) -> Stub | None:
    """The stub with this folder in /proc, if it is one of ``parent``'s.

    A stub's arguments are .../<model>/<version>/model.py, the name of its shared memory, and others.
    """
    pid = int(folder.name)
    fields = _stat(pid)
    if not fields or int(fields[_PARENT]) != parent:
        return None
    try:
        words = (folder / "cmdline").read_bytes().split(b"\0")
    except (FileNotFoundError, ProcessLookupError):
        return None
    if len(words) < 3 or not words[0].endswith(_PROGRAM):
        return None
    version = Path(os.fsdecode(words[1])).parent
    if not version.name.isdecimal():
        return None
    return Stub(pid, int(fields[_STARTED]), version.parent.name, int(version.name), os.fsdecode(words[2]))
