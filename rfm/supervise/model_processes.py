# SPDX-License-Identifier: MIT
"""The model processes of a tritonserver, one for each instance of a model, as /proc shows them.

Triton, which calls them stubs, does not notice that one is dead until it has a request for it, and keeps it as a zombie
until the model is unloaded. So one that is a zombie was killed, or has crashed.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from rfm.journal import Journal, journal_file
from rfm.proc import STOPPED, ZOMBIE, all_pids, arguments_of, stat_of

CONFIRM_S = 0.3  # one that was unloaded is a zombie for a moment, too
STOPPED_S = 3.0  # by SIGSTOP, say, before it counts as hung

_PROGRAM = "triton_python_backend_stub"
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class ModelProcess:
    """One model process. started_ticks: when it was started, as ``rfm.proc`` has it"""

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
        return self.state not in (None, ZOMBIE)

    @property
    def state(self) -> str | None:
        """State of the process, as the kernel has it; None: there is no such process."""
        stat = stat_of(self.pid)
        return stat.state if stat is not None and stat.started_ticks == self.started_ticks else None

    @property
    def started_s(self) -> float:
        """When it was started, by time.monotonic."""
        age_s = time.clock_gettime(time.CLOCK_BOOTTIME) - self.started_ticks / _TICKS_PER_S
        return time.monotonic() - age_s

    @property
    def journal(self) -> Journal | None:
        """What it is working on; None: it has written nothing."""
        return Journal.open(journal_file(self.region, self.model))

    def kill(self) -> None:
        """Ends the process at once, whatever it does."""
        if self.is_alive:
            with suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)


class ProcessWatch:
    """Finds the model processes of the tritonserver ``triton_pid`` that have died, or hang. It leaves those that still
    load to Triton.

    hang_s: what one forward pass may take before its process counts as hung
    """

    def __init__(self, triton_pid: int, hang_s: float) -> None:
        self._triton_pid = triton_pid
        self._hang_s = hang_s
        self._known: set[ModelProcess] = set()
        self._loaded: set[ModelProcess] = set()
        self._watched: set[ModelProcess] = set()
        self._forgotten: set[ModelProcess] = set()
        self._since: dict[tuple[ModelProcess, str], float] = {}  # with its state: when it was first seen so

    def update(
        self, ready: Collection[tuple[str, int]], going: Collection[tuple[str, int]], requested_s: float
    ) -> None:
        """Takes in which versions of models were ready at ``requested_s``, and which were on their way to or from that.

        The processes of a version that is ready have loaded. A version that is loaded once more stays ready meanwhile,
        so its new processes have loaded when the old ones are gone.
        """
        self._scan()
        self._loaded &= self._known
        old = {process.serves for process in self._loaded}
        new = {process for process in self._known if process.serves in ready and process.serves not in old}
        self._loaded |= {process for process in new if process.started_s < requested_s}
        self._watched = {process for process in self._loaded if process.serves not in going}

    def dead(self) -> list[ModelProcess]:
        """The processes that have died and were not forgotten."""
        self._look()
        return [process for process in self._watched if self._has_been(process, ZOMBIE, CONFIRM_S)]

    def hung(self) -> list[tuple[ModelProcess, str]]:
        """The processes that live and make no progress, and why."""
        found = []
        for process in self._watched:
            journal = process.journal
            if self._has_been(process, STOPPED, STOPPED_S):
                found.append((process, f"stopped for {STOPPED_S:g} s"))
            elif journal is not None and journal.busy_s > self._hang_s and process.is_alive:
                found.append((process, f"no forward pass further for {self._hang_s:g} s"))
        return found

    def is_getting_on(self, model: str) -> bool:
        """Whether one of the model's processes is at work, and none of its forward passes takes too long."""
        journals = [process.journal for process in self._watched if process.model == model and process.is_alive]
        return any(journal is not None and 0 < journal.busy_s <= self._hang_s for journal in journals)

    def num_owed(self, model: str) -> int:
        """How many answers the model's processes owe that are dead or stopped."""
        idle = [process for process in self.of_model(model) if process.state in (None, ZOMBIE, STOPPED)]
        return sum(journal.num_owed for process in idle if (journal := process.journal) is not None)

    def of_model(self, model: str) -> list[ModelProcess]:
        """The model's processes, dead or alive."""
        self._scan()
        return [process for process in self.all if process.model == model]

    @property
    def all(self) -> list[ModelProcess]:
        """All processes of models that are known now."""
        return list(self._known)

    def forget(self, replaced: Iterable[ModelProcess]) -> None:
        """Forgets processes that were replaced: they are found no more."""
        self._forgotten.update(replaced)
        self._known -= self._forgotten
        self._loaded -= self._forgotten
        self._watched -= self._forgotten

    def _look(self) -> None:
        now_s = time.monotonic()
        states = {process: process.state for process in self._watched}
        seen = {(process, state) for process, state in states.items() if state in (ZOMBIE, STOPPED)}
        for process, state in seen - self._since.keys():
            journal = process.journal if state == STOPPED else None
            if journal is not None:
                journal.acquit()  # what it is working on is not why it was stopped
        self._since = {key: self._since.get(key, now_s) for key in seen}

    def _has_been(self, process: ModelProcess, state: str, duration_s: float) -> bool:
        since_s = self._since.get((process, state))
        return since_s is not None and time.monotonic() - since_s >= duration_s

    def _scan(self) -> None:
        remaining = {process for process in self._known if process.state is not None}  # of a zombie nothing can be read
        found = (_model_process(pid, self._triton_pid) for pid in all_pids())
        self._forgotten = {process for process in self._forgotten if process.state is not None}
        self._known = remaining | {process for process in found if process is not None} - self._forgotten


def _model_process(pid: int, parent: int) -> ModelProcess | None:
    """The model process of this id, if it is one of ``parent``'s.

    Its arguments are .../<model>/<version>/model.py, the name of its shared memory, and others.
    """
    stat = stat_of(pid)
    if stat is None or stat.parent != parent:
        return None
    words = arguments_of(pid)
    if len(words) < 3 or not words[0].endswith(_PROGRAM):
        return None
    version = Path(words[1]).parent
    if not version.name.isdecimal():
        return None
    return ModelProcess(pid, stat.started_ticks, version.parent.name, int(version.name), words[2])
