# SPDX-License-Identifier: MIT
"""Faults that ``rfm serve`` survives, each by the same cure: Triton is started again."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import rollout
from administered import KEY
from clock import Clock
from one_model import BriefServer
from patients import CALLERS, MARK, TOLERANCE, Callers, make_repository, references, trajectory
from repositories import bound_queue
from rfm.launch import cleanup
from rfm.launch.cleanup import SHARED_MEMORY
from rfm.launch.endpoints import Endpoints
from rfm.launch.installation import find_installation
from rfm.launch.repository_api import RepositoryApi, RepositoryApiError
from rfm.supervise import supervisor
from rfm.supervise.status import NO_REASON
from rfm.supervise.supervisor import BackOff, CrashLoopError
from rfm.triton_model.guard import FAILED_BATCHES
from rfm_client import InferenceFailedError, RewardClient, ServerUnavailableError
from rfm_commands.rollout import Rollout
from rfm_serve import MODEL, PATIENCE_S, RFM, TRUTH_S, Serving, children, serving, wait_for

pytestmark = [pytest.mark.triton, pytest.mark.slow]

__all__ = ["references"]  # a fixture

OTHER = f"{MODEL}_b"
HANG_S = 3
DEADLY, FAILING, SLOW = MARK, MARK + 1, MARK + 2  # marks of samples


def answering(body: str) -> str:
    """Code for a model.py that does something before it answers. ``marks``: of the questions"""
    return f"""

_plain_answer = TritonPythonModel.answer


def answer(self, questions, execution):
    import os, time

    marks = [q.sample.trajectories[0].text_embedding[0] for q in questions]
    {body}
    return _plain_answer(self, questions, execution)


TritonPythonModel.answer = answer
"""


@contextmanager
def administered(repository: Path, **settings: int) -> Iterator[Serving]:
    """The repository is served, with these settings and an admin key, and ready."""
    key_file, config = repository.parent / "key", repository.parent / "serve.yaml"
    key_file.touch(0o600)
    key_file.write_text(KEY)
    config.write_text("serve:\n" + "".join(f"  {name}: {value}\n" for name, value in settings.items()))
    with serving(repository, f"--admin-key-file={key_file}", f"--config={config}") as served:
        served.wait_ready()
        yield served


def api_of(served: Serving) -> RepositoryApi:
    return RepositoryApi(served.endpoints.grpc_url, KEY)


def restarts(served: Serving, *what: str) -> float:
    return sum(served.metric("rfm_serve_restarts_total", what=name) for name in what)


def once(trigger: Path) -> str:
    """Code that is true once the file is there, in one process."""
    return f"os.path.exists({str(trigger)!r}) and os.unlink({str(trigger)!r}) is None"


def test_what_dies_stops_hangs_or_is_silent_is_healed_and_no_call_is_lost(
    tmp_path: Path, references: list[np.ndarray[Any, Any]]
) -> None:
    trigger = tmp_path / "trigger"

    def a_process_dies(served: Serving) -> None:
        os.kill(served.model_processes()[0], signal.SIGKILL)

    def a_process_stops(served: Serving) -> None:
        os.kill(served.model_processes()[0], signal.SIGSTOP)

    def a_batch_hangs(_: Serving) -> None:
        trigger.touch()

    def triton_dies(served: Serving) -> None:
        os.kill(served.triton, signal.SIGKILL)

    def triton_is_silent(served: Serving) -> None:
        os.kill(served.triton, signal.SIGSTOP)

    faults: dict[Callable[[Serving], None], str] = {
        a_process_dies: MODEL, a_process_stops: MODEL, a_batch_hangs: MODEL, triton_dies: "triton", triton_is_silent: "triton",
    }  # fmt: skip
    hangs = answering(f"if {once(trigger)}: time.sleep(3600)")
    repository = make_repository(tmp_path, more_code=hangs, instances=2)
    with administered(repository, hang_s=HANG_S, triton_silent_s=3) as served:
        assert httpx.get(f"{served.status_url}/live").status_code == 200
        assert httpx.get(f"{served.status_url}/other").status_code == 404
        with served.client() as client, Callers(client, references) as callers:
            for fault, what in faults.items():
                callers.wait_for_all()
                before = restarts(served, what)
                fault(served)
                served.wait_ready(False, TRUTH_S + HANG_S)
                answer = served.ready()
                assert answer is not None
                assert answer.json()["models"][MODEL]["reason"]
                assert served.metric("rfm_serve_ready", model=MODEL) == 0
                served.wait_ready()
                callers.wait_for_all()
                assert restarts(served, what) == before + 1
        assert (callers.lost, callers.wrong) == ([], [])
        assert served.metric("rfm_serve_canary_seconds_count", model=MODEL) > 3
    assert served.process.returncode == 0
    assert len(served.said) == len(faults), served.said
    assert served.said[-1] == "rfm: triton is started again: no answer for 3 s"
    assert "Timeout (0:00:03)!" in served.log.read_text()


def test_what_a_request_does_to_its_process(tmp_path: Path, references: list[np.ndarray[Any, Any]]) -> None:
    """It takes long, fails, or ends the process: twice, and no more. A broken instance ends itself."""
    trigger = tmp_path / "trigger"
    code = f"""if {SLOW} in marks:
        for _ in range({4 * HANG_S}):
            time.sleep(0.5)
            execution.on_forward()
    if {FAILING} in marks:
        raise RuntimeError("a kernel that does not like this sample")
    if {DEADLY} in marks:
        os._exit(1)
    if {once(trigger)}:
        type(self).is_broken = True
    if getattr(self, "is_broken", False):
        raise RuntimeError("CUDA error: device-side assert triggered")"""
    repository = make_repository(tmp_path, more_code=answering(code), instances=2)
    with administered(repository, hang_s=HANG_S) as served, served.client() as client:
        before = served.model_processes()
        assert np.isfinite(client.progress(trajectory(0, mark=SLOW)).progress).all()
        for _ in range(4 * FAILED_BATCHES):
            with pytest.raises(InferenceFailedError, match="scoring failed"):
                client.progress(trajectory(99, mark=FAILING))
        assert served.model_processes() == before
        assert served.said == []

        with pytest.raises(ServerUnavailableError, match="ended under this request twice"):
            client.progress(trajectory(99, mark=DEADLY))
        # a process that dies before the supervisor has seen its command line counts as Triton's
        wait_for(lambda: restarts(served, MODEL, "triton") == 2)
        served.wait_ready()
        np.testing.assert_allclose(client.progress(trajectory(0)).progress, references[0], rtol=0, atol=TOLERANCE)

        with Callers(client, references) as callers:
            callers.wait_for_all()
            trigger.touch()
            wait_for(lambda: restarts(served, MODEL, "triton") == 3)
            served.wait_ready()
            assert 0 < len(callers.lost) <= FAILED_BATCHES * CALLERS
            assert {type(error) for error in callers.lost} == {InferenceFailedError}
            callers.lost.clear()
            callers.wait_for_all()
        assert (callers.lost, callers.wrong) == ([], [])
    assert "instance is broken" in served.log.read_text()


def test_what_was_served_is_served_again_and_not_what_was_exported_since(tmp_path: Path) -> None:
    """Models that were loaded since, too; those that were unloaded are not."""
    repository, samples = tmp_path / "repository", rollout.questions()
    rollout.export(rollout.WITH_ENCODERS.checkpoint, repository)
    expected = rollout.answers(rollout.WITH_ENCODERS.checkpoint, samples)
    parts = {MODEL: NO_REASON, "rfm_encoder": NO_REASON, "rfm_frames": NO_REASON}
    others = {OTHER: NO_REASON, f"{OTHER}_encoder": NO_REASON, f"{OTHER}_frames": NO_REASON}
    with administered(repository) as served:
        rollout.export(rollout.other_checkpoint(tmp_path / "other"), repository)
        rollout.export(rollout.WITH_ENCODERS.checkpoint, repository, OTHER)
        with api_of(served) as api:
            api.load(f"{OTHER}_frames")
        wait_for(lambda: served.reasons() == parts | others)
        os.kill(served.model_processes(OTHER)[0], signal.SIGKILL)
        wait_for(lambda: restarts(served, OTHER) == 1)
        served.wait_ready()
        assert served.reasons() == parts | others
        with served.client() as client:
            for got, wanted in zip(client.evaluate(samples), expected, strict=True):
                assert rollout.difference(got, wanted) <= rollout.TOLERANCE
        with api_of(served) as api:
            assert [api.ready_versions(part) for part in parts] == [[1]] * 3
            Rollout(repository, MODEL, api, lambda _: None).to(2)
            for model in reversed(others):
                api.unload(model)
        wait_for(lambda: served.reasons() == parts)
        os.kill(served.triton, signal.SIGKILL)
        wait_for(lambda: restarts(served, "triton") == 1)
        served.wait_ready()
        assert served.reasons() == parts
        with api_of(served) as api:
            assert [api.ready_versions(part) for part in parts] == [[2]] * 3


def test_a_model_that_keeps_ending_is_left_out_and_named_and_the_other_serves(
    tmp_path: Path, references: list[np.ndarray[Any, Any]]
) -> None:
    """A version that cannot be loaded costs nobody anything."""
    trigger, repository = tmp_path / "trigger", make_repository(tmp_path)
    shutil.copytree(repository / MODEL, repository / OTHER)
    config, code = repository / OTHER / "config.pbtxt", repository / OTHER / "1" / "model.py"
    config.write_text(config.read_text().replace(f'name: "{MODEL}"', f'name: "{OTHER}"'))
    code.write_text(code.read_text() + answering(f"if os.path.exists({str(trigger)!r}): os._exit(1)"))
    with administered(repository) as served, served.client() as client:
        broken = shutil.copytree(repository / MODEL / "1", repository / MODEL / "2") / "model.py"
        broken.write_text(broken.read_text() + "\n\nimport os\n\nos._exit(1)\n")
        config = repository / MODEL / "config.pbtxt"
        before = config.read_text()
        config.write_text(before.replace("versions: 1", "versions: 1 versions: 2"))
        with Callers(client, references) as callers:
            with api_of(served) as api, pytest.raises(RepositoryApiError):
                api.load(MODEL)
            callers.wait_for_all()
        assert (callers.lost, callers.wrong) == ([], [])
        assert restarts(served, MODEL) == 0
        config.write_text(before)

        trigger.touch()
        wait_for(lambda: served.reasons().get(OTHER, "").startswith("it is left out"))
        wait_for(lambda: served.reasons().get(MODEL) == NO_REASON)
        assert not served.is_ready()
        assert np.isfinite(client.progress(trajectory(0)).progress).all()
        trigger.unlink()
        with api_of(served) as api:
            api.load(OTHER)
        served.wait_ready()
    assert any(line.startswith(f"rfm: {OTHER} is left out, since it kept ending: ") for line in served.said)


@pytest.mark.alone
def test_a_server_that_is_killed_leaves_nothing_running_and_the_next_removes_the_rest(tmp_path: Path) -> None:
    """In a container of its own, whose process ids mean nothing here, where this user may make one."""
    apart = ["unshare", "--map-root-user", "--pid", "--fork", "--kill-child", "--mount-proc"]
    if subprocess.run([*apart, "true"], check=False, stderr=subprocess.DEVNULL).returncode != 0:
        apart = []
    others = {*SHARED_MEMORY.iterdir()}
    command = [*apart, RFM, "serve", "--repository", make_repository(tmp_path / "killed")]
    command += [f"--{name}-port={Endpoints.free().http_port}" for name in ("http", "grpc", "metrics", "status")]
    killed = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def left() -> set[Path]:
        return {*SHARED_MEMORY.glob(f"{cleanup.REGION_PREFIX}_*")} - others

    try:
        wait_for(lambda: any(not re.search("_(lock|backends)$", path.name) for path in left()))  # a model process runs
        own = left()
        assert not own & set(cleanup.clear())  # it lives
        assert own <= left()
    finally:
        killed.kill()
        killed.wait(PATIENCE_S)
    with serving(make_repository(tmp_path / "next")) as served:
        served.wait_ready()
        assert not own & left()
        assert left()  # its own
        assert not set(cleanup.clear()) & left()
    assert any(f"removed {SHARED_MEMORY}" in line for line in served.said)


def test_a_server_that_is_killed_again_and_again_is_given_up(tmp_path: Path) -> None:
    with serving(make_repository(tmp_path)) as served:
        served.wait_ready()
        killed: set[int] = set()

        def kill() -> bool:
            for pid in children(served.process.pid, "tritonserver"):
                if pid not in killed:
                    os.kill(pid, signal.SIGKILL)
                    killed.add(pid)
            return served.process.poll() is not None

        wait_for(kill)
    assert served.process.returncode == 1
    wanted = r"rfm: tritonserver: expected to run, got 6 ends, each within 180 s of a start; the last: .*exit status -9"
    assert re.fullmatch(wanted, served.said[-1]), served.said
    assert len(killed) == supervisor.MOST + 1


def test_a_full_queue_refuses_at_once_and_a_long_wait_is_cut_short(tmp_path: Path) -> None:
    """By Triton's own policy; with one instance, Triton 2.51 notices a free one half a second late."""
    slow = answering(f"time.sleep(0.5 * ({SLOW} in marks))")
    repository = make_repository(tmp_path, more_code=slow, instances=2, batch_size=2)
    bound_queue(repository / MODEL, max_queue_size=4, timeout_ms=600)
    with (
        (tmp_path / "log").open("wb") as log,
        BriefServer(repository, Endpoints.free(), find_installation(), log=log) as server,
        RewardClient(server.endpoints.grpc_url, retry=False) as client,
        RewardClient(server.endpoints.http_url, retry=False) as over_http,
        RewardClient(server.endpoints.grpc_url) as patient,
        ThreadPoolExecutor(64) as pool,
    ):

        def ask(which: RewardClient) -> Exception | None:
            try:
                which.progress(trajectory(0, mark=SLOW))
            except ServerUnavailableError as error:
                return error
            return None

        for which in (client, over_http):
            outcomes = list(pool.map(ask, [which] * 24))
            assert [error for error in outcomes if error is not None and "Exceeds maximum queue size" in str(error)]
            assert outcomes.count(None) >= 2
        # Who tries again is served in the end.
        assert list(pool.map(ask, [patient] * 12)) == [None] * 12


def run_for(ends: BackOff, clock: Clock, duration_s: float) -> float:
    """The pause behind a run of so long."""
    ends.started()
    clock.now_s += duration_s
    return ends.pause_s("why")


def test_what_ran_for_long_is_no_part_of_a_crash_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(supervisor, "time", clock)
    ends = BackOff("gateway")
    assert [run_for(ends, clock, 1.0) for _ in range(supervisor.MOST)] == [0, 0.5, 1, 2, 4]
    assert run_for(ends, clock, supervisor.STEADY_S) == 0
    for _ in range(supervisor.MOST - 1):
        run_for(ends, clock, 1.0)
    with pytest.raises(CrashLoopError, match="gateway: expected to run, got 6 ends, each within 60 s"):
        run_for(ends, clock, 1.0)


def test_starts_that_fail_are_a_crash_loop_however_long_they_take(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(supervisor, "time", clock)
    ends = BackOff("tritonserver")
    run_for(ends, clock, 5 * supervisor.STEADY_S)
    for _ in range(supervisor.MOST - 1):
        clock.now_s += 2 * supervisor.STEADY_S
        ends.pause_s("it does not start")
    with pytest.raises(CrashLoopError, match="the last: it does not start"):
        ends.pause_s("it does not start")


def test_a_triton_that_never_ran_is_no_crash_loop(tmp_path: Path) -> None:
    program = tmp_path / "tritonserver"
    program.write_text("#!/bin/sh\nexec sleep 0.1\n")
    program.chmod(0o755)
    with serving(make_repository(tmp_path), "--tritonserver", str(program)) as served:
        assert served.process.wait(PATIENCE_S) == 1
    assert served.said[-1] == "rfm: tritonserver: expected to run, got exit status 0"


def test_the_status_port_names_a_taken_port(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with serving(make_repository(tmp_path), f"--status-port={port}") as served:
            assert served.process.wait(PATIENCE_S) == 1
    where = f"rfm: status: expected a free port of this machine at 127.0.0.1:{port}"
    assert served.said == [f"{where}, got: Address already in use; --status-port names another port"]
