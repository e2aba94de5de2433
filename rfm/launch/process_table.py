# SPDX-License-Identifier: MIT
"""Processes of this machine, from /proc."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

ZOMBIE, STOPPED = "Z", "T"  # states

_PROC = Path("/proc")
_STATE, _PARENT = 0, 1  # fields of /proc/PID/stat behind the name


@dataclass(frozen=True)
class ProcessStat:
    """Name (at most 15 characters), state and parent of a process, zombies included."""

    name: str
    state: str
    parent: int


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
    return ProcessStat(head.partition("(")[2], fields[_STATE], int(fields[_PARENT]))
