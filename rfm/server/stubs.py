# SPDX-License-Identifier: MIT
"""The model processes of a tritonserver ("stubs", one for each instance of a model), as /proc shows them.

Triton does not notice that a stub is dead until it has a request for it, and keeps it as a zombie until the model is
unloaded. So a stub that is a zombie is one that was killed, or has crashed.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rfm.server.poison import SUFFIX, Journal

SCAN_INTERVAL_S = 1.0  # for stubs that are new
CONFIRM_S = 0.3  # one that was unloaded is a zombie for a moment, too
STOPPED_S = 3.0  # by SIGSTOP, say, before it counts as hung

SHARED_MEMORY = Path("/dev/shm")
_PROC = Path("/proc")
_PROGRAM = b"triton_python_backend_stub"
_ZOMBIE, _STOPPED = "Z", "T"


@dataclass(frozen=True)
class Stub:
    """One model process."""

    pid: int
    model: str
    region: str  # name of its shared memory

    @property
    def journal(self) -> Journal | None:
        """What it is working on; None: it does not tell."""
        return Journal.open(SHARED_MEMORY / f"{self.region}_{self.model}{SUFFIX}")

    def kill(self) -> None:
        """Ends it at once, whatever it does."""
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)


class StubWatch:
    """Sees which stubs of the tritonserver ``triton_pid`` have died, or were stopped.

    hang_s: what one batch may take before its stub counts as hung
    """

    def __init__(self, triton_pid: int, hang_s: float) -> None:
        self._triton_pid = triton_pid
        self._hang_s = hang_s
        self._stubs: dict[int, Stub] = {}
        self._scanned_s = 0.0
        self._since: dict[tuple[int, str], float] = {}  # pid and state: when it was first seen so
        self._buried: set[int] = set()

    def dead(self) -> list[Stub]:
        """Those that have died and were not buried."""
        self._look()
        return [stub for stub in self.all if self._has_been(stub, _ZOMBIE, CONFIRM_S)]

    def hung(self) -> list[tuple[Stub, str]]:
        """Those that are alive and get nowhere, and why."""
        found = []
        for stub in self.all:
            journal = stub.journal
            if self._has_been(stub, _STOPPED, STOPPED_S):
                found.append((stub, f"stopped for {STOPPED_S:g} s"))
            elif journal is not None and journal.busy_s > self._hang_s:
                found.append((stub, f"at work on one batch for {self._hang_s:g} s"))
        return found

    def of_model(self, model: str) -> list[Stub]:
        """The model's stubs, dead or alive."""
        self._scan()
        return [stub for stub in self.all if stub.model == model]

    @property
    def all(self) -> list[Stub]:
        """Those that are known."""
        return list(self._stubs.values())

    def bury(self, stubs: Iterable[Stub]) -> None:
        """Stubs that are of no more interest."""
        for stub in stubs:
            self._buried.add(stub.pid)
            self._stubs.pop(stub.pid, None)

    def _look(self) -> None:
        now_s = time.monotonic()
        if now_s - self._scanned_s >= SCAN_INTERVAL_S:
            self._scan()
        for pid in list(self._stubs):
            state = _state(pid)
            if state is None:  # unloaded
                del self._stubs[pid]
            for known in (_ZOMBIE, _STOPPED):
                if state == known:
                    self._since.setdefault((pid, known), now_s)
                else:
                    self._since.pop((pid, known), None)

    def _has_been(self, stub: Stub, state: str, duration_s: float) -> bool:
        since_s = self._since.get((stub.pid, state))
        return since_s is not None and time.monotonic() - since_s >= duration_s

    def _scan(self) -> None:
        self._scanned_s = time.monotonic()
        for folder in _PROC.glob("[0-9]*"):
            pid = int(folder.name)
            if pid not in self._stubs and pid not in self._buried and _parent(pid) == self._triton_pid:
                stub = _stub(folder)
                if stub is not None:
                    self._stubs[pid] = stub


def is_alive(pid: int) -> bool:
    """Whether there is a process that has not ended."""
    return _state(pid) not in (None, _ZOMBIE)


def _state(pid: int) -> str | None:
    """None: there is no such process."""
    fields = _stat(pid)
    return fields[0] if fields else None


def _parent(pid: int) -> int | None:
    fields = _stat(pid)
    return int(fields[1]) if fields else None


def _stat(pid: int) -> list[str]:
    """State, parent and so on: what stands behind the name, which may hold anything."""
    try:
        return (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return []


def _stub(folder: Path) -> Stub | None:
    """Its arguments are .../<model>/<version>/model.py, the name of its shared memory, and others."""
    try:
        words = (folder / "cmdline").read_bytes().split(b"\0")
    except (FileNotFoundError, ProcessLookupError):
        return None
    if len(words) < 3 or not words[0].endswith(_PROGRAM):
        return None
    return Stub(int(folder.name), Path(os.fsdecode(words[1])).parent.parent.name, os.fsdecode(words[2]))
