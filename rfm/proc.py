# SPDX-License-Identifier: MIT
"""What the kernel says of the processes of this machine."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

ZOMBIE, STOPPED = "Z", "T"  # states

_PROC = Path("/proc")
_STATE, _PARENT, _STARTED = 0, 1, 19  # places in /proc/<pid>/stat behind the process' name, which may hold anything


@dataclass(frozen=True)
class ProcessStat:
    """State, parent's id and start of a process. started_ticks: by the kernel's clock; no other of this id has it"""

    state: str
    parent: int
    started_ticks: int


def all_pids() -> list[int]:
    """The ids of all processes."""
    return [int(folder.name) for folder in _PROC.glob("[0-9]*")]


def arguments_of(pid: int) -> list[str]:
    """The process' program and its arguments; none of a zombie, or where there is no process of this id."""
    try:
        content = (_PROC / str(pid) / "cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return []
    return os.fsdecode(content).split("\0")


def stat_of(pid: int) -> ProcessStat | None:
    """What there is to know of the process; None: there is none of this id."""
    try:
        fields = (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return None
    return ProcessStat(fields[_STATE], int(fields[_PARENT]), int(fields[_STARTED]))


def is_alive(pid: int) -> bool:
    """Whether there is a process of this id that has not ended."""
    stat = stat_of(pid)
    return stat is not None and stat.state != ZOMBIE
