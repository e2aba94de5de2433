# SPDX-License-Identifier: MIT
"""All processes end with ``rfm serve``, however it ends, also with a log that cannot be written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from commands import is_alive
from repositories import make_repository
from rfm_client import ProgressSample, RewardClient, RewardError
from servers import PATIENCE_S, start_triton, wait_for
from trajectories import random_trajectory

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


@pytest.mark.triton
@pytest.mark.slow
def test_triton_does_not_crash_when_it_is_stopped_under_http_requests(tmp_path: Path) -> None:
    """Triton 2.51 waits for open connections; when its own limit expires, it exits while requests run."""
    sample = ProgressSample(random_trajectory(0, 3, 64, 32))
    with (
        start_triton(make_repository(tmp_path)) as server,
        RewardClient(server.endpoints.http_url) as client,
        ThreadPoolExecutor(1) as thread,
    ):
        client.evaluate([sample])
        stopped = thread.submit(server.stop)
        while not stopped.done():
            with suppress(RewardError):
                client.evaluate([sample], timeout_s=1)
    assert server.exit_status in (0, -signal.SIGKILL)
