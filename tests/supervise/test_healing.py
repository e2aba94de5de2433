# SPDX-License-Identifier: MIT
"""A real Triton after faults, and what a killed server leaves. ``make chaos`` has more faults, and a crash loop."""

from __future__ import annotations

import os
import re
import signal
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psutil
import pytest

import stand_in_triton
from callers import Callers, Exam, direct
from commands import is_alive, running, running_models
from repositories import answering, make_repository
from rfm.serve.processes import SHARED_MEMORY, clear_shared_memory
from rfm.serve.status import NO_REASON
from servers import (
    MODEL,
    PATIENCE_S,
    RFM,
    START_S,
    TRUTH_S,
    Endpoints,
    Serving,
    administered,
    model_processes,
    serving,
    start_triton,
    wait_for,
)

pytestmark = [pytest.mark.slow, pytest.mark.triton]

HANG_S = 2
AT_ONCE_S = 10.0  # a model process used to stay for two minutes


def test_a_model_process_that_dies_or_hangs_is_restarted_and_no_call_is_lost(tmp_path: Path) -> None:
    """tests/supervise/test_supervisor.py has the other faults."""
    trigger = tmp_path / "trigger"
    once = f"os.path.exists({str(trigger)!r}) and os.unlink({str(trigger)!r}) is None"
    repository = make_repository(tmp_path / "a folder; with spaces", answering(f"if {once}: time.sleep(3600)"))
    exam = Exam.of(repository / MODEL / "1" / "checkpoint", mixed=True)
    with (
        administered(repository, hang_s=HANG_S) as served,
        served.client() as client,
        # without a pause, they would slow the restart
        Callers(direct(client), exam, count=16, pause_s=0.05) as callers,
    ):
        for number, is_hung in enumerate((False, True), 1):
            if is_hung:
                trigger.touch()
            else:
                killed = served.model_processes()[0]
                os.kill(killed, signal.SIGKILL)
            served.wait_ready(False, TRUTH_S + HANG_S)
            served.wait_ready()
            callers.wait_for_all()
            assert served.restarts(MODEL) == number
        assert served.reasons() == {MODEL: NO_REASON}
        assert served.metric("rfm_serve_start_seconds") > 0
    assert f"{MODEL}: its process {killed} is dead (killed by SIGKILL); all models load, " in served.log.read_text()
    assert (callers.lost, callers.wrong) == ([], 0)
    assert f"Timeout (0:00:0{HANG_S})!" in served.log.read_text()


def test_a_start_is_repeated_when_a_model_process_is_killed(tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    waits = f"if not os.path.exists({str(begun)!r}):\n    open({str(begun)!r}, 'w')\n    time.sleep(3600)"
    repository = make_repository(tmp_path, more_code=f"\n\nimport os, time\n\n{waits}\n")

    def kill_first() -> set[int]:
        wait_for(begun.exists)
        processes = running_models(repository, MODEL)
        for pid in processes:
            os.kill(pid, signal.SIGKILL)
        return processes

    with ThreadPoolExecutor(1) as thread:
        killed = thread.submit(kill_first)
        with start_triton(repository) as server:
            assert killed.result()
            assert model_processes(server.pid)
            assert killed.result().isdisjoint(model_processes(server.pid))


@pytest.mark.alone
def test_a_killed_server_without_a_log_leaves_nothing_running_and_the_next_removes_the_rest(tmp_path: Path) -> None:
    """With a stand-in for Triton, in a container whose process ids mean nothing here, if this user may make one."""
    apart = ["unshare", "--map-root-user", "--pid", "--fork", "--kill-child", "--mount-proc"]
    if subprocess.run([*apart, "true"], check=False, stderr=subprocess.DEVNULL).returncode != 0:
        apart = []
    repository = stand_in_triton.repository(tmp_path, MODEL)
    program = f"--tritonserver={stand_in_triton.installation(tmp_path).executable}"
    ends, more = Endpoints.free(), Endpoints.free()
    ports = {"http": ends.http_port, "grpc": ends.grpc_port, "metrics": ends.metrics_port}
    ports |= {"status": more.http_port, "gateway": more.grpc_port}
    command = [*apart, RFM, "serve", repository, program, *(f"--{name}-port={port}" for name, port in ports.items())]
    reading, writing = os.pipe()
    os.close(reading)
    with Path("/dev/full").open("wb") as full, os.fdopen(writing, "wb") as closed:
        killed = subprocess.Popen(command, stdout=full, stderr=closed)
    served = Serving(killed, ends, f"http://127.0.0.1:{more.http_port}", tmp_path / "log")

    def model() -> set[int]:
        return running_models(repository, MODEL)

    def gateway() -> set[int]:
        return running("rfm_gateway", 3) & running(f"{more.grpc_port}")

    try:
        served.wait_ready(within_s=START_S)
        for pid in model():
            os.kill(pid, signal.SIGKILL)
        wait_for(lambda: served.restarts(MODEL, "triton") == 1)
        served.wait_ready()
        wait_for(gateway)
        for pid in gateway():
            os.kill(pid, signal.SIGKILL)
        wait_for(lambda: served.restarts("gateway") == 1)
        wait_for(gateway)
        (triton,) = running(f"--http-port={ends.http_port}") - running("--gateway-port")
        (prefix,) = re.findall("shm-region-prefix-name=(.*)", "\n".join(psutil.Process(triton).cmdline()))
        started = {triton, *model(), *gateway(), *running(f"--gateway-port={more.grpc_port}")}
        assert len(started) >= 4
        own = {*SHARED_MEMORY.glob(f"{prefix}*")}
        assert own
        assert not own & set(clear_shared_memory())  # it lives
        assert own == {*SHARED_MEMORY.glob(f"{prefix}*")}
    finally:
        killed.kill()
        killed.wait(PATIENCE_S)
    wait_for(lambda: not [pid for pid in started if is_alive(pid)], AT_ONCE_S)
    with serving(repository, program) as again:
        wait_for(lambda: again.said and not {*SHARED_MEMORY.glob(f"{prefix}*")})
    assert any(f"removed {SHARED_MEMORY}" in line for line in again.said)
