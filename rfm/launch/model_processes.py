# SPDX-License-Identifier: MIT
"""The model processes of a Triton, and which of them are dead or stopped."""

from __future__ import annotations

import time
from collections.abc import Collection
from pathlib import Path

from rfm.launch.process_table import STOPPED, ZOMBIE, arguments_of, children_of, stat_of

UNKNOWN = ""  # the model of a process that died before the first look
LOADING_DEAD_S = 5.0  # Triton ends a failed load within about 1 s, unless the process died before its handshake

_PROGRAM = "triton_python_backend_stub"
_PROGRAM_IN_KERNEL = _PROGRAM[:15]
_STATES = {ZOMBIE: "a process of it is dead", STOPPED: "a process of it is stopped"}


class ModelProcesses:
    """The model processes of a Triton, one for each instance, from /proc.

    Triton notices the death of a served model's process only at the next request, and keeps a zombie until then. If a
    loading model's process dies before its handshake, Triton never notices.
    """

    def __init__(self, triton_pid: int) -> None:
        self._triton_pid = triton_pid
        self._models: dict[int, str] = {}  # by process; a zombie's command line is empty
        self._since_s: dict[int, float] = {}  # of dead and stopped processes

    def fault(self, settled: Collection[str] = ()) -> tuple[str, str] | None:
        """Return a model and the fault of its process: dead or stopped.

        settled: models that neither load nor unload; their fault counts at the second look, others after LOADING_DEAD_S
        """
        states, now_s = self._states(), time.monotonic()
        ill = [pid for pid, state in states.items() if state in _STATES]
        before, self._since_s = self._since_s, {pid: self._since_s.get(pid, now_s) for pid in ill}
        for pid in sorted(before.keys() & self._since_s.keys()):
            if self._models[pid] in settled or now_s - before[pid] >= LOADING_DEAD_S:
                return self._models[pid], _STATES[states[pid]]
        return None

    def _states(self) -> dict[int, str]:
        """Return the state of each model process, and note its model."""
        states = {}
        for pid in children_of(self._triton_pid):
            stat = stat_of(pid)
            if stat is None:
                continue
            words = arguments_of(pid)  # .../triton_python_backend_stub .../MODEL/VERSION/model.py ...
            if len(words) > 1 and words[0].endswith(_PROGRAM):
                self._models[pid] = Path(words[1]).parent.parent.name
            elif stat.name == _PROGRAM_IN_KERNEL:
                self._models.setdefault(pid, UNKNOWN)
            if pid in self._models:
                states[pid] = stat.state
        self._models = {pid: model for pid, model in self._models.items() if pid in states}
        return states
