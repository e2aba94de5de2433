# SPDX-License-Identifier: MIT
"""A real Triton after faults: restarts, repeated starts, and what a killed server leaves."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commands import is_alive, running
from patients import answering, calling, make_repository
from rfm.launch import cleanup
from rfm.launch.cleanup import SHARED_MEMORY
from rfm.launch.repository_api import RepositoryApiError
from rfm.supervise.status import NO_REASON
from servers import (
    MODEL,
    PATIENCE_S,
    RFM,
    START_S,
    TRUTH_S,
    Endpoints,
    Serving,
    administered,
    children,
    model_processes,
    serving,
    start_triton,
    wait_for,
)

pytestmark = [pytest.mark.slow, pytest.mark.triton]

OTHER = f"{MODEL}_b"
HANG_S = 2
AT_ONCE_S = 10.0  # a model process used to stay for two minutes


def test_what_dies_or_hangs_is_healed_and_no_call_is_lost_until_it_is_a_crash_loop(
    tmp_path: Path, references: list[np.ndarray[Any, Any]]
) -> None:
    """tests/supervise/test_supervisor.py has the other faults."""
    trigger = tmp_path / "trigger"

    def a_process_dies(served: Serving) -> None:
        os.kill(served.model_processes()[0], signal.SIGKILL)

    def a_batch_hangs(_: Serving) -> None:
        trigger.touch()

    faults: tuple[Callable[[Serving], None], ...] = (a_process_dies, a_batch_hangs)
    once = f"os.path.exists({str(trigger)!r}) and os.unlink({str(trigger)!r}) is None"  # in a single process
    repository = make_repository(tmp_path, more_code=answering(f"if {once}: time.sleep(3600)"), instances=2)
    with administered(repository, hang_s=HANG_S) as served:
        half_copied = shutil.copytree(repository / MODEL, repository / OTHER)
        config = half_copied / "config.pbtxt"
        config.write_text(config.read_text().replace(f'name: "{MODEL}"', f'name: "{OTHER}"'))
        (half_copied / "1" / "model.py").unlink()
        with served.api() as api, pytest.raises(RepositoryApiError):
            api.load(OTHER)  # its process dies, and Triton would wait for ever
        wait_for(lambda: served.restarts(OTHER) == 1)
        served.wait_ready()
        assert served.reasons() == {MODEL: NO_REASON}

        with served.client() as client, calling(client, references) as callers:
            for number, fault in enumerate(faults, 1):
                callers.wait_for_all()
                fault(served)
                served.wait_ready(False, TRUTH_S + HANG_S)
                served.wait_ready()
                callers.wait_for_all()
                assert served.restarts(MODEL) == number
        assert (callers.lost, callers.wrong) == ([], 0)
        assert f"Timeout (0:00:0{HANG_S})!" in served.log.read_text()

        def kill() -> bool:
            for pid in children(served.process.pid, "tritonserver"):
                with suppress(ProcessLookupError):  # it has ended meanwhile
                    os.kill(pid, signal.SIGKILL)
            return served.process.poll() is not None

        wait_for(kill)
    assert served.process.returncode == 1
    wanted = r"rfm: triton: expected to run, got 6 faults in a row; the last: .*killed by SIGKILL"
    assert re.fullmatch(wanted, served.said[-1]), served.said


def test_a_start_is_repeated_when_a_model_process_is_killed(tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    waits = f"if not os.path.exists({str(begun)!r}):\n    open({str(begun)!r}, 'w')\n    time.sleep(3600)"
    repository = make_repository(tmp_path, more_code=f"\n\nimport os, time\n\n{waits}\n")

    def kill_first() -> set[int]:
        wait_for(begun.exists)
        processes = running(f"{repository}/{MODEL}/", 2)  # this process may have started other servers
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
    """In a separate container, whose process ids mean nothing here, if this user may make one."""
    apart = ["unshare", "--map-root-user", "--pid", "--fork", "--kill-child", "--mount-proc"]
    if subprocess.run([*apart, "true"], check=False, stderr=subprocess.DEVNULL).returncode != 0:
        apart = []
    repository, others = make_repository(tmp_path), {*SHARED_MEMORY.iterdir()}
    ends, more = Endpoints.free(), Endpoints.free()
    ports = {"http": ends.http_port, "grpc": ends.grpc_port, "metrics": ends.metrics_port}
    ports |= {"status": more.http_port, "gateway": more.grpc_port}
    command = [*apart, RFM, "serve", repository, *(f"--{name}-port={port}" for name, port in ports.items())]
    reading, writing = os.pipe()
    os.close(reading)
    with Path("/dev/full").open("wb") as full, os.fdopen(writing, "wb") as closed:
        killed = subprocess.Popen(command, stdout=full, stderr=closed)
    served = Serving(killed, ends, f"http://127.0.0.1:{more.http_port}", tmp_path / "log")

    def left() -> set[Path]:
        return {*SHARED_MEMORY.glob(f"{cleanup.REGION_PREFIX}_*")} - others

    def all_started() -> set[int]:
        return {*running(f"{repository}/{MODEL}/", 2), *running(f"--http-port={ends.http_port}"), *gateways()}

    def gateways() -> set[int]:
        return running("rfm_gateway", 3) & running(f"{more.grpc_port}")

    try:
        served.wait_ready(within_s=START_S)
        for pid in running(f"{repository}/{MODEL}/", 2):
            os.kill(pid, signal.SIGKILL)
        wait_for(lambda: served.restarts(MODEL, "triton") == 1)
        served.wait_ready()
        wait_for(gateways)
        for pid in gateways():
            os.kill(pid, signal.SIGKILL)
        wait_for(lambda: served.restarts("gateway") == 1)
        wait_for(gateways)
        started, own = all_started(), left()
        assert len(started) >= 4  # rfm serve, Triton, a model process and the gateway
        assert not own & set(cleanup.clear())  # it lives
        assert own <= left()
    finally:
        killed.kill()
        killed.wait(PATIENCE_S)
    wait_for(lambda: not [pid for pid in started if is_alive(pid)], AT_ONCE_S)
    with serving(repository) as again:
        wait_for(lambda: again.said and not own & left())
    assert any(f"removed {SHARED_MEMORY}" in line for line in again.said)
