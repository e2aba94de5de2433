# SPDX-License-Identifier: MIT
"""Loads that Triton spoils: it loses a process that was not heard of for a second, and waits for ever, or ends."""

from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import nullcontext
from pathlib import Path

import pytest

from one_model import BriefServer
from patients import make_repository
from rfm.launch import process
from rfm.launch.installation import Installation, ServerStartError, find_installation
from rfm.launch.process import Endpoints, SpoiltStartError, StalledStartError, TritonServer
from rfm.supervise.model_processes import ModelProcess, ProcessWatch
from rfm.supervise.supervisor import Supervisor
from rfm_client import RewardClient
from rfm_serve import MODEL, PATIENCE_S, children, kill_while_idle, serving, wait_for

pytestmark = [pytest.mark.triton, pytest.mark.slow]

DAWDLES = """

_initialize = TritonPythonModel.initialize


def dawdling(self, args):
    import os
    import time

    _initialize(self, args)
    if os.path.exists({trigger!r}):
        os.unlink({trigger!r})
        time.sleep(600)


TritonPythonModel.initialize = dawdling
"""


@pytest.fixture
def trigger(tmp_path: Path) -> Path:
    """While it is there, the next process that loads stays as one is that Triton has lost: loaded, and not taken up.

    Triton itself cannot be made to lose one at will.
    """
    return tmp_path / "trigger"


def make_dawdling(folder: Path, trigger: Path) -> Path:
    return make_repository(folder, more_code=DAWDLES.format(trigger=str(trigger)))


def check_answers(server: TritonServer) -> None:
    with RewardClient(server.endpoints.grpc_url) as client:
        assert client.is_ready()


def test_a_start_that_never_ends_is_repeated(tmp_path: Path, trigger: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "STALLED_S", 2.0)
    trigger.touch()
    with BriefServer(make_dawdling(tmp_path, trigger), Endpoints.free(), find_installation()) as server:
        assert not trigger.exists()
        check_answers(server)


def test_a_start_that_was_repeated_is_not_hurried(tmp_path: Path, trigger: Path) -> None:
    """Models of other backends may load for long while ours wait."""
    trigger.touch()
    server = TritonServer(make_dawdling(tmp_path, trigger), Endpoints.free(), find_installation())
    server.start()
    try:
        with pytest.raises(StalledStartError, match="tritonserver: expected to be ready, got processes that wait"):
            server.wait_ready(1.0)
        wait_for(lambda: server.exit_status is not None)
        server.stop()
        server.start()
        server.wait_ready()
        check_answers(server)
    finally:
        server.stop()


def test_a_start_at_which_triton_ends_is_repeated(tmp_path: Path) -> None:
    """A process that stands still for three seconds as it loads costs Triton 2.51 its life."""
    repository, endpoints = make_repository(tmp_path), Endpoints.free()
    server = TritonServer(repository, endpoints, find_installation())
    stopped: list[ModelProcess] = []

    def stop_one() -> None:
        while not stopped:
            time.sleep(0.05)
            tritons = children(os.getpid(), "tritonserver")
            stopped.extend(each for pid in tritons for each in ProcessWatch(pid, PATIENCE_S).of_model(MODEL))
        time.sleep(1)
        os.kill(stopped[0].pid, signal.SIGSTOP)
        time.sleep(3)
        os.kill(stopped[0].pid, signal.SIGCONT)

    stopping = threading.Thread(target=stop_one)
    stopping.start()
    with server:
        stopping.join()
        check_answers(server)
        (now,) = ProcessWatch(server.pid, PATIENCE_S).of_model(MODEL)
        assert now.pid != stopped[0].pid


class Spoilt(TritonServer):
    """One whose first starts Triton spoils. Triton itself cannot be made to spoil several in a row."""

    def __init__(self, repository: Path, endpoints: Endpoints, installation: Installation, num_spoilt: int) -> None:
        super().__init__(repository, endpoints, installation)
        self.num_spoilt = num_spoilt
        self.num_starts = 0

    def wait_ready(self, stalled_s: float = process.PATIENT_S) -> None:
        self.num_starts += 1
        if self.num_starts <= self.num_spoilt:
            raise SpoiltStartError("tritonserver: expected to run, got exit status -6")
        super().wait_ready(stalled_s)


@pytest.mark.parametrize("num_spoilt", [process.MAX_REPEATS, process.MAX_REPEATS + 1])
def test_a_start_is_not_repeated_for_ever(tmp_path: Path, num_spoilt: int) -> None:
    server = Spoilt(make_repository(tmp_path), Endpoints.free(), find_installation(), num_spoilt)
    is_spoilt = num_spoilt > process.MAX_REPEATS
    with pytest.raises(SpoiltStartError) if is_spoilt else nullcontext(), server:
        check_answers(server)
    assert server.num_starts == process.MAX_REPEATS + 1


@pytest.mark.parametrize("num_spoilt", [process.MAX_REPEATS, process.MAX_REPEATS + 1])
def test_rfm_serve_does_not_repeat_a_first_start_for_ever(tmp_path: Path, num_spoilt: int) -> None:
    server = Spoilt(make_repository(tmp_path), Endpoints.free(), find_installation(), num_spoilt)
    said: list[str] = []

    def say(line: str) -> None:
        said.append(line)
        if line.startswith("ready: "):
            signal.raise_signal(signal.SIGTERM)

    supervisor = Supervisor(server, canary_s=10.0, hang_s=60.0, triton_silent_s=60.0, say=say)
    if num_spoilt > process.MAX_REPEATS:
        with pytest.raises(SpoiltStartError):
            supervisor.run()
    else:
        assert supervisor.run() == 0
    assert server.num_starts == process.MAX_REPEATS + 1
    assert len([line for line in said if "is started again" in line]) == process.MAX_REPEATS


def test_a_server_that_cannot_start_is_started_once(tmp_path: Path) -> None:
    repository = make_repository(tmp_path, more_code="raise RuntimeError('no')")
    with pytest.raises(ServerStartError, match="no") as error:
        TritonServer(repository, Endpoints.free(), find_installation()).__enter__()
    assert not isinstance(error.value, SpoiltStartError)


def test_a_model_that_loads_for_ever_is_healed(tmp_path: Path, trigger: Path) -> None:
    with serving(make_dawdling(tmp_path, trigger)) as served:
        served.wait_ready()
        trigger.touch()
        kill_while_idle(served.model_processes[0])
        served.wait_ready(False)
        wait_for(lambda: not trigger.exists())
        served.wait_ready(True, process.STALLED_S + PATIENCE_S)
        with served.client() as client:
            assert client.is_ready()
    assert [line for line in served.said if "is started again" in line] == [
        f"rfm: {MODEL} is started again: its process is dead"
    ]


def test_a_first_start_that_never_ends_is_repeated_by_rfm_serve(tmp_path: Path, trigger: Path) -> None:
    trigger.touch()
    with serving(make_dawdling(tmp_path, trigger)) as served:
        served.wait_ready(True, process.STALLED_S + PATIENCE_S)
        assert served.metric("rfm_serve_restarts_total", what="triton") == 1
