# SPDX-License-Identifier: MIT
"""The model processes of a tritonserver, one for each instance of a model, as /proc shows them.

Triton does not notice that one is dead until it has a request for it, and keeps it as a zombie until then.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from rfm.launch.proc import STOPPED, ZOMBIE, arguments_of, children_of, stat_of

_PROGRAM = "triton_python_backend_stub"
_NAME = _PROGRAM[:15]  # as the kernel keeps it
UNKNOWN = ""
_FAULTS = {ZOMBIE: "a process of it is dead", STOPPED: "a process of it is stopped"}


class ModelProcesses:
    """The processes that Triton, ``triton_pid``, has started."""

    def __init__(self, triton_pid: int) -> None:
        self._triton_pid = triton_pid
        self._models: dict[int, str] = {}  # by process; of a zombie nothing can be read
        self._suspects: set[int] = set()

    def fault(self, settled: Collection[str]) -> tuple[str, str] | None:
        """A model of ``settled`` with a process that is dead or stopped now and was so at the last look, and which.

        The model of a process that died before the first look is UNKNOWN.
        """
        states = self._states()
        suspects = {pid for pid, state in states.items() if state in _FAULTS and self._models[pid] in settled}
        confirmed = suspects & self._suspects
        self._suspects = suspects
        return next(((self._models[pid], _FAULTS[states[pid]]) for pid in sorted(confirmed)), None)

    def _states(self) -> dict[int, str]:
        states = {}
        for pid in children_of(self._triton_pid):
            stat = stat_of(pid)
            if stat is not None:
                model = _model_of(pid)
                if model is not None:
                    self._models[pid] = model
                elif stat.name == _NAME:
                    self._models.setdefault(pid, UNKNOWN)
                if pid in self._models:
                    states[pid] = stat.state
        self._models = {pid: model for pid, model in self._models.items() if pid in states}
        return states


def _model_of(pid: int) -> str | None:
    """The model that a process runs, whose arguments are .../MODEL/VERSION/model.py and others; None: it runs none."""
    words = arguments_of(pid)
    if len(words) < 2 or not words[0].endswith(_PROGRAM):
        return None
    return Path(words[1]).parent.parent.name
