# SPDX-License-Identifier: MIT
"""Processes of this machine, from /proc."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

ZOMBIE, STOPPED = "Z", "T"  # states

_PROC = Path("/proc")
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_STATE, _PARENT, _GROUP, _USER, _SYSTEM = 0, 1, 2, 11, 12  # fields of /proc/PID/stat behind the name


@dataclass(frozen=True)
class ProcessStat:
    """Name (at most 15 characters), state, parent, group and CPU time of a process, zombies included."""

    name: str
    state: str
    parent: int
    group: int
    cpu_s: float


def all_pids() -> list[int]:
    """Return the ids of all processes."""
    return [int(folder.name) for folder in _PROC.glob("[0-9]*")]


def children_of(pid: int) -> list[int]:
    """Return the child processes of a process, zombies included.

    Reads the kernel's lists of children if they exist, since a machine may have thousands of processes.
    """
    threads = _PROC / str(pid) / "task"
    if not (threads / str(pid) / "children").exists():
        return [child for child in all_pids() if (stat := stat_of(child)) is not None and stat.parent == pid]
    found: list[int] = []
    for file in threads.glob("*/children"):
        with suppress(FileNotFoundError, ProcessLookupError):  # the thread has ended
            found += map(int, file.read_text().split())
    return found


def arguments_of(pid: int) -> list[str]:
    """Return program and arguments of a process; empty for a zombie or an unknown id."""
    try:
        content = (_PROC / str(pid) / "cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return []
    return os.fsdecode(content).split("\0")


def stat_of(pid: int) -> ProcessStat | None:
    """Return the state of a process; None for an unknown id."""
    try:
        head, _, tail = (_PROC / str(pid) / "stat").read_text().rpartition(")")
    except (FileNotFoundError, ProcessLookupError):
        return None
    fields = tail.split()
    ticks = int(fields[_USER]) + int(fields[_SYSTEM])
    return ProcessStat(
        head.partition("(")[2], fields[_STATE], int(fields[_PARENT]), int(fields[_GROUP]), ticks / _TICKS_PER_S
    )


def cpu_s_of_group(group: int) -> float:
    """Return the CPU time of a process group, in seconds."""
    return sum(stat.cpu_s for pid in all_pids() if (stat := stat_of(pid)) is not None and stat.group == group)
