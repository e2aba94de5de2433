# SPDX-License-Identifier: MIT
"""All processes end with ``rfm serve``, however it ends, also with a log that cannot be written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from commands import RFM, is_alive
from patients import make_repository
from rfm.launch import cleanup
from rfm.launch.ending import ProcessGroup, how_it_ended
from servers import PATIENCE_S, START_S, Endpoints, Serving, children, wait_for

AT_ONCE_S = 10.0  # a model process used to stay for two minutes
GROUP = """
import ctypes, os, sys, time
from rfm.launch.ending import ProcessGroup
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
from rfm.launch.model_processes import children_of
while len(list(children_of(group.process.pid))) < 2:
    time.sleep(0.01)
os.kill(group.process.pid, 9)  # so that its children are orphans
group.end()
group.kill()  # whoever has the id now
group.end()
sys.exit(len(list(children_of(os.getpid()))))
"""
    assert subprocess.run([sys.executable, "-c", GROUP + code], check=False, timeout=PATIENCE_S).returncode == 0


def test_a_process_that_cannot_start_leaves_no_sentinel() -> None:
    before = set(children(os.getpid()))
    with pytest.raises(FileNotFoundError):
        ProcessGroup(["/nowhere/program"])
    assert set(children(os.getpid())) <= before


def test_a_signal_is_called_by_its_name() -> None:
    assert [how_it_ended(status) for status in (-9, 1)] == ["killed by SIGKILL", "exit status 1"]


@pytest.mark.triton
@pytest.mark.slow
@pytest.mark.parametrize("log", ["full disk", pytest.param("closed pipe", marks=pytest.mark.nightly)])
def test_rfm_serve_heals_without_a_log_and_if_it_is_killed_no_process_stays(tmp_path: Path, log: str) -> None:
    ends, more = Endpoints.free(), Endpoints.free()
    ports = {"http": ends.http_port, "grpc": ends.grpc_port, "metrics": ends.metrics_port}
    ports |= {"status": more.http_port, "gateway": more.grpc_port}
    words = [RFM, "serve", make_repository(tmp_path), *(f"--{name}-port={port}" for name, port in ports.items())]
    reading, writing = os.pipe()
    os.close(reading)
    with Path("/dev/full").open("wb") as full, os.fdopen(writing, "wb") as closed:
        broken = full if log == "full disk" else closed
        process = subprocess.Popen(words, stdout=broken, stderr=broken)
    served = Serving(process, ends, f"http://127.0.0.1:{more.http_port}", tmp_path / "log")
    try:
        served.wait_ready(within_s=START_S)
        os.kill(served.model_processes()[0], signal.SIGKILL)
        wait_for(lambda: served.restarts("rfm", "triton") == 1)
        served.wait_ready()
        wait_for(lambda: len(children(process.pid, "python")) == 1)  # the gateway
        os.kill(children(process.pid, "python")[0], signal.SIGKILL)
        wait_for(lambda: served.restarts("gateway") == 1)
        assert process.poll() is None
        started = [*children(process.pid), *served.model_processes()]
    finally:
        process.kill()
        process.wait(PATIENCE_S)
    try:
        assert len(started) == 5  # Triton and the gateway, a sentinel of each, a model process
        wait_for(lambda: not [pid for pid in started if is_alive(pid)], AT_ONCE_S)
    finally:
        for pid in started:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

        def nothing_left() -> bool:
            cleanup.clear()
            return not list(cleanup.SHARED_MEMORY.glob(f"*_rfm_{process.pid}_*"))

        wait_for(nothing_left)
