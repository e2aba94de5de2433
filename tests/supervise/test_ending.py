# SPDX-License-Identifier: MIT
"""All processes end with ``rfm serve``, however it ends, also with a log that cannot be written."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress

import psutil

from commands import is_alive
from servers import PATIENCE_S, wait_for

GROUP = """
import ctypes, os, sys, time
from rfm.serve.processes import ProcessGroup
ctypes.CDLL(None).prctl(36, 1)  # PR_SET_CHILD_SUBREAPER: as the first process of a container
group = ProcessGroup(["/bin/sh", "-c", "trap '' HUP; sleep 600 & sleep 601 & wait"])
"""


def of_group(group: int) -> list[int]:
    """Return the live processes of a group."""
    found = []
    for pid in psutil.pids():
        with suppress(ProcessLookupError):  # it has ended
            found += [pid] if os.getpgid(pid) == group and is_alive(pid) else []
    return found


def test_a_process_that_is_killed_takes_its_groups_along() -> None:
    words = [sys.executable, "-c", GROUP + "print(group.id, flush=True); time.sleep(600)"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        group = int(process.stdout.readline())
        wait_for(lambda: len(of_group(group)) == 4)  # with the sentinel
        process.kill()
        process.wait(PATIENCE_S)
        wait_for(lambda: not of_group(group))


def test_an_ended_group_leaves_no_orphan_and_no_zombie() -> None:
    code = """
from rfm.serve.processes import children_of
while len(list(children_of(group.process.pid))) < 2:
    time.sleep(0.01)
os.kill(group.process.pid, 9)  # so that its children are orphans
group.end()
group.kill()  # whoever has the id now
group.end()
sys.exit(len(list(children_of(os.getpid()))))
"""
    assert subprocess.run([sys.executable, "-c", GROUP + code], check=False, timeout=PATIENCE_S).returncode == 0
