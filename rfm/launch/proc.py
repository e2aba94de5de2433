# SPDX-License-Identifier: MIT
"""What the kernel says of the processes of this machine."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

ZOMBIE, STOPPED = "Z", "T"  # states

_PROC = Path("/proc")
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_STATE, _PARENT, _GROUP, _USER, _SYSTEM = 0, 1, 2, 11, 12  # places in /proc/PID/stat behind the process' name


@dataclass(frozen=True)
class ProcessStat:
    """Name, state, parent, group and CPU time of a process. The name, at most 15 characters, is a zombie's, too"""

    name: str
    state: str
    parent: int
    group: int
    cpu_s: float


def all_pids() -> list[int]:
    """The ids of all processes."""
    return [int(folder.name) for folder in _PROC.glob("[0-9]*")]


def children_of(pid: int) -> list[int]:
    """The processes that the process has started, zombies included.

    A machine may have thousands of processes, so the kernel's lists of each thread's children are read, where it has
    such lists.
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
    """The process' program and its arguments; none of a zombie, or where there is no process of this id."""
    try:
        content = (_PROC / str(pid) / "cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return []
    return os.fsdecode(content).split("\0")


def stat_of(pid: int) -> ProcessStat | None:
    """What there is to know of the process; None: there is none of this id."""
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
    """CPU time of all processes of a group, in seconds."""
    return sum(stat.cpu_s for pid in all_pids() if (stat := stat_of(pid)) is not None and stat.group == group)
