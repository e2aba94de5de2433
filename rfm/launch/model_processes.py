# SPDX-License-Identifier: MIT
"""The model processes of a Triton, and which of them are dead or stopped."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

import psutil

UNKNOWN = ""  # the model of a process that died before the first look
LOADING_DEAD_S = 5.0  # Triton ends a failed load within about 1 s, unless the process died before its handshake

_PROGRAM = "triton_python_backend_stub"
_STATES = {psutil.STATUS_ZOMBIE: "a process of it is dead", psutil.STATUS_STOPPED: "a process of it is stopped"}


class ModelProcesses:
    """The model processes of a Triton, one for each instance, from /proc.

    Triton notices the death of a served model's process only at the next request, and keeps a zombie until then. If a
    loading model's process dies before its handshake, Triton never notices. A process that is replaced may be a zombie
    for seconds.
    """

    def __init__(self, triton_pid: int) -> None:
        self._triton_pid = triton_pid
        self._models: dict[int, str] = {}  # by process; a zombie's command line is empty
        self._since_s: dict[int, float] = {}  # of dead and stopped processes

    def fault(self, wanted: Mapping[str, int] | None = None, *, is_settled: bool = False) -> tuple[str, str] | None:
        """Return a model and the fault of its process: dead or stopped.

        wanted: number of processes by model; while so many live, a dead one was replaced
        is_settled: no model loads or unloads: a fault counts at the second look, otherwise after LOADING_DEAD_S
        """
        states, now_s = self._states(), time.monotonic()
        living = Counter(self._models[pid] for pid, state in states.items() if state not in _STATES)
        enough = {model for model, number in (wanted or {}).items() if living[model] >= number}
        replaced = [
            pid for pid, state in states.items() if state == psutil.STATUS_ZOMBIE and self._models[pid] in enough
        ]
        ill = [pid for pid in states.keys() - replaced if states[pid] in _STATES]
        before, self._since_s = self._since_s, {pid: self._since_s.get(pid, now_s) for pid in ill}
        for pid in sorted(before.keys() & self._since_s.keys()):
            if is_settled or now_s - before[pid] >= LOADING_DEAD_S:
                return self._models[pid], _STATES[states[pid]]
        return None

    def _states(self) -> dict[int, str]:
        """Return the state of each model process, and note its model."""
        states: dict[int, str] = {}
        for pid in children_of(self._triton_pid):
            with suppress(psutil.NoSuchProcess):  # it has ended
                process = psutil.Process(pid)
                state = process.status()
                words = [] if state == psutil.STATUS_ZOMBIE else process.cmdline()
                if len(words) > 1 and words[0].endswith(_PROGRAM):  # then .../MODEL/VERSION/model.py
                    self._models[pid] = Path(words[1]).parent.parent.name
                elif state == psutil.STATUS_ZOMBIE:  # also if it died before it was the program
                    self._models.setdefault(pid, UNKNOWN)
                if pid in self._models:
                    states[pid] = state
        self._models = {pid: model for pid, model in self._models.items() if pid in states}
        return states


def children_of(pid: int) -> Iterator[int]:
    """Yield the child processes of a process, zombies included.

    Reads the kernel's lists of children if they exist, since a machine may have thousands of processes.
    """
    lists = list(Path(f"/proc/{pid}/task").glob("*/children"))
    for file in lists:
        with suppress(FileNotFoundError, ProcessLookupError):  # the thread has ended
            yield from map(int, file.read_text().split())
    if not lists:
        with suppress(psutil.NoSuchProcess):
            yield from (child.pid for child in psutil.Process(pid).children())


def has_ended(pid: int) -> bool:
    """True for a zombie and an unknown id."""
    try:
        return bool(psutil.Process(pid).status() == psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return True
