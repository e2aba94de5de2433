# SPDX-License-Identifier: MIT
"""Faults that ``rfm serve`` survives, each by the same cure: Triton is started again."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import rollout
from clock import Clock
from commands import is_alive
from one_model import BriefServer
from patients import CALLERS, DEADLY, MARK, TOLERANCE, Callers, make_repository, references, trajectory
from repositories import bound_queue
from rfm.launch import cleanup
from rfm.launch.cleanup import SHARED_MEMORY
from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints
from rfm.launch.repository_api import RepositoryApi, RepositoryApiError
from rfm.supervise import back_off
from rfm.supervise.back_off import BackOff, CrashLoopError
from rfm.supervise.status import NO_REASON
from rfm.triton_model.guard import FAILED_BATCHES
from rfm_client import InferenceFailedError, RewardClient, ServerUnavailableError
from rfm_commands.rollout import Rollout
from rfm_serve import MODEL, PATIENCE_S, RFM, TRUTH_S, Serving, children, serving, wait_for

pytestmark = [pytest.mark.triton, pytest.mark.slow]

__all__ = ["references"]  # a fixture

KEY = "a-key-that-only-tests-know"
OTHER = f"{MODEL}_b"
HANG_S = 3


def answering(body: str) -> str:
    """Code for a model.py that does something before it answers. ``marked``: whether a question is marked"""
    return f"""

_plain_answer = TritonPythonModel.answer


def answer(self, questions, execution):
    import os, time

    marked = any(q.sample.trajectories[0].text_embedding[0] == {MARK} for q in questions)
    {body}
    return _plain_answer(self, questions, execution)


TritonPythonModel.answer = answer
"""


@contextmanager
def administered(repository: Path, **settings: int) -> Iterator[tuple[Serving, RepositoryApi]]:
    """The repository is served, with these settings, and ready; and the API that changes what is."""
    key_file, config = repository.parent / "key", repository.parent / "serve.yaml"
    key_file.touch(0o600)
    key_file.write_text(KEY)
    config.write_text("".join(f"{name}: {value}\n" for name, value in settings.items()))
    with serving(repository, f"--admin-key-file={key_file}", f"--config={config}") as served:
        served.wait_ready()
        with RepositoryApi(served.endpoints.grpc_url, KEY) as api:
            yield served, api


def change(file: Path, pattern: str, wanted: str) -> None:
    text, count = re.subn(pattern, wanted, file.read_text())
    assert count == 1, pattern
    file.write_text(text)


def restarts(served: Serving, what: str) -> float:
    return served.metric("rfm_serve_restarts_total", what=what)


def add_other(repository: Path, more_code: str = "") -> Path:
    """A second model; its model.py."""
    shutil.copytree(repository / MODEL, repository / OTHER)
    change(repository / OTHER / "config.pbtxt", f'name: "{MODEL}"', f'name: "{OTHER}"')
    code = repository / OTHER / "1" / "model.py"
    code.write_text(code.read_text() + more_code)
    return code


def test_dead_and_hung_processes_are_healed_and_no_call_is_lost(
    tmp_path: Path, references: list[np.ndarray[Any, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    def kill_a_stub(served: Serving) -> None:
        os.kill(served.model_processes()[0], signal.SIGKILL)

    def stop_a_stub(served: Serving) -> None:
        os.kill(served.model_processes()[0], signal.SIGSTOP)

    def kill_triton(served: Serving) -> None:
        os.kill(served.triton, signal.SIGKILL)

    faults: dict[Callable[[Serving], None], str] = {kill_a_stub: MODEL, stop_a_stub: MODEL, kill_triton: "triton"}
    with serving(make_repository(tmp_path, instances=2)) as served:
        load_s = served.wait_ready()
        assert httpx.get(f"{served.status_url}/live").status_code == 200
        assert httpx.get(f"{served.status_url}/other").status_code == 404
        with served.client() as client, Callers(client, references) as callers:
            for fault, what in faults.items():
                callers.wait_for_all()
                before = restarts(served, what)
                fault(served)
                told_s = served.wait_ready(False, TRUTH_S)
                answer = served.ready()
                assert answer is not None
                assert answer.json()["models"][MODEL]["reason"]
                assert served.metric("rfm_serve_ready", model=MODEL) == 0
                back_s = told_s + served.wait_ready(True, 10 + 2 * load_s + 5)
                callers.wait_for_all()
                assert restarts(served, what) == before + 1
                with capsys.disabled():
                    print(f"\n{fault.__name__}: not ready after {told_s:.1f} s, back after {back_s:.1f} s", end="")
        with capsys.disabled():
            print(f"; the first start took {load_s:.1f} s; {sum(callers.answered)} answers, ", end="")
            print(f"{len(callers.wrong)} wrong, {len(callers.lost)} lost")
        assert callers.lost == []
        assert callers.wrong == []
        assert served.metric("rfm_serve_canary_seconds_count", model=MODEL) > 3
    assert served.process.returncode == 0
    assert len(served.said) == 3, served.said


@pytest.mark.alone
def test_a_server_that_is_killed_leaves_nothing_running_and_the_next_removes_the_rest(tmp_path: Path) -> None:
    endpoints, port = Endpoints.free(), Endpoints.free().http_port
    ports = {
        "http": endpoints.http_port,
        "grpc": endpoints.grpc_port,
        "metrics": endpoints.metrics_port,
        "status": port,
    }
    command = [RFM, "serve", "--repository", make_repository(tmp_path / "killed")]
    killed = subprocess.Popen(
        [*command, *(f"--{name}-port={number}" for name, number in ports.items())],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        served = Serving(killed, endpoints, f"http://127.0.0.1:{port}", tmp_path / "none")
        served.wait_ready()
        started = [served.triton, *served.model_processes()]
        assert len(started) == 2
    finally:
        killed.kill()
        killed.wait(PATIENCE_S)
    wait_for(lambda: not any(is_alive(pid) for pid in started))
    left = list(SHARED_MEMORY.glob(f"*_rfm_{killed.pid}_*"))
    assert left
    with serving(make_repository(tmp_path / "next")) as served:
        wait_for(lambda: not any(path.exists() for path in left))
        served.wait_ready()
        assert list(SHARED_MEMORY.glob(f"*_rfm_{served.process.pid}_*"))
        cleanup.clear()
        assert list(SHARED_MEMORY.glob(f"*_rfm_{served.process.pid}_*"))  # it lives
    assert any(f"removed {left[0]}" in line for line in served.said)
    assert not list(Path(tempfile.gettempdir()).glob(f"rfm-backends-{killed.pid}-*"))


@pytest.mark.alone
def test_what_a_killed_container_left_is_removed_and_what_a_living_one_has_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its process ids mean nothing here. Where this user may make no namespace, it is a server like any other."""
    apart = ["unshare", "--map-root-user", "--pid", "--fork", "--kill-child", "--mount-proc"]
    if subprocess.run([*apart, "true"], check=False, stderr=subprocess.DEVNULL).returncode != 0:
        apart = []
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    command = [*apart, RFM, "serve", "--repository", make_repository(tmp_path)]
    command += [f"--{name}-port={Endpoints.free().http_port}" for name in ("http", "grpc", "metrics", "status")]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    container = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def left() -> set[Path]:
        return {path for name in names for path in SHARED_MEMORY.glob(f"*_rfm_{name}_*")} | set(folders())

    def folders() -> list[Path]:
        return list(tmp_path.glob("rfm-backends-*"))

    names: list[str] = []
    try:
        wait_for(folders)
        names += [folder.name.removeprefix("rfm-backends-").replace("-", "_") for folder in folders()]
        wait_for(
            lambda: any(not path.name.endswith("_lock") and path.parent == SHARED_MEMORY for path in left())
        )  # a model process of it runs
        own = left()
        assert not own & set(cleanup.clear())
        assert own <= left()
    finally:
        container.kill()
        container.wait(PATIENCE_S)
    wait_for(lambda: cleanup.clear() or not own & left())  # its processes have ended
    assert not own & left()


def test_a_request_that_ends_its_process_fails_after_two_and_others_are_answered(
    tmp_path: Path, references: list[np.ndarray[Any, Any]]
) -> None:
    with serving(make_repository(tmp_path, more_code=DEADLY)) as served:
        served.wait_ready()
        with served.client() as client:
            with pytest.raises(ServerUnavailableError, match="ended under this request twice"):
                client.progress(trajectory(99, mark=MARK))
            wait_for(lambda: restarts(served, MODEL) == 2)
            served.wait_ready()
            np.testing.assert_allclose(client.progress(trajectory(0)).progress, references[0], rtol=0, atol=TOLERANCE)


def test_a_batch_that_hangs_ends_its_process_and_is_asked_again(
    tmp_path: Path, references: list[np.ndarray[Any, Any]]
) -> None:
    trigger = tmp_path / "trigger"
    hangs = f"""if os.path.exists({str(trigger)!r}):
        os.unlink({str(trigger)!r})
        time.sleep(3600)"""
    with administered(make_repository(tmp_path, more_code=answering(hangs), instances=2), hang_s=HANG_S) as (served, _):
        with served.client() as client, Callers(client, references) as callers:
            callers.wait_for_all()
            trigger.touch()
            wait_for(lambda: restarts(served, MODEL) == 1)
            served.wait_ready()
            callers.wait_for_all()
        assert (callers.lost, callers.wrong) == ([], [])
    assert "Timeout (0:00:03)!" in served.log.read_text()


def test_a_batch_that_gets_on_may_take_long(tmp_path: Path) -> None:
    gets_on = f"""for _ in range({4 * HANG_S} if marked else 0):
        time.sleep(0.5)
        execution.on_forward()"""
    with administered(make_repository(tmp_path, more_code=answering(gets_on)), hang_s=HANG_S) as (served, _):
        with served.client() as client:
            assert np.isfinite(client.progress(trajectory(0, mark=MARK)).progress).all()
        assert restarts(served, MODEL) == restarts(served, "triton") == 0


def test_one_broken_instance_of_several_ends_and_is_healed(
    tmp_path: Path, references: list[np.ndarray[Any, Any]]
) -> None:
    trigger = tmp_path / "trigger"
    breaks = f"""if os.path.exists({str(trigger)!r}):
        os.unlink({str(trigger)!r})
        type(self).is_broken = True
    if getattr(self, "is_broken", False):
        raise RuntimeError("CUDA error: device-side assert triggered")"""
    with serving(make_repository(tmp_path, more_code=answering(breaks), instances=2)) as served:
        served.wait_ready()
        with served.client() as client, Callers(client, references) as callers:
            callers.wait_for_all()
            trigger.touch()
            wait_for(lambda: restarts(served, MODEL) == 1)
            served.wait_ready()
            assert 0 < len(callers.lost) <= FAILED_BATCHES * CALLERS
            assert {type(error) for error in callers.lost} == {InferenceFailedError}
            callers.lost.clear()
            callers.wait_for_all()
        assert (callers.lost, callers.wrong) == ([], [])
    assert "instance is broken" in served.log.read_text()


def test_samples_that_fail_do_not_end_the_instance(tmp_path: Path, references: list[np.ndarray[Any, Any]]) -> None:
    fails = """if marked:
        raise RuntimeError("a kernel that does not like this sample")"""
    with serving(make_repository(tmp_path, more_code=answering(fails))) as served, served.client(retry=False) as client:
        served.wait_ready()
        before = served.model_processes()
        for _ in range(4 * FAILED_BATCHES):
            with pytest.raises(InferenceFailedError, match="scoring failed"):
                client.progress(trajectory(99, mark=MARK))
        np.testing.assert_allclose(client.progress(trajectory(0)).progress, references[0], rtol=0, atol=TOLERANCE)
        assert served.model_processes() == before
    assert served.said == []


def test_what_was_served_is_served_again_and_not_what_was_exported_since(tmp_path: Path) -> None:
    repository, samples = tmp_path / "repository", rollout.questions()
    rollout.export(rollout.WITH_ENCODERS.checkpoint, repository)
    expected = rollout.answers(rollout.WITH_ENCODERS.checkpoint, samples)
    parts = (MODEL, "rfm_encoder", "rfm_frames")
    with administered(repository) as (served, _):
        rollout.export(rollout.other_checkpoint(tmp_path / "other"), repository)
        os.kill(served.triton, signal.SIGKILL)
        served.wait_ready(False)
        served.wait_ready()
        assert served.reasons() == dict.fromkeys(parts, NO_REASON)
        with served.client() as client:
            for got, wanted in zip(client.evaluate(samples), expected, strict=True):
                assert rollout.difference(got, wanted) <= rollout.TOLERANCE
        with RepositoryApi(served.endpoints.grpc_url, KEY) as again:
            assert [again.ready_versions(part) for part in parts] == [[1]] * 3
            Rollout(repository, MODEL, again, lambda _: None).to(2)
            assert [again.ready_versions(part) for part in parts] == [[2]] * 3
        served.wait_ready()
        assert (restarts(served, "triton"), restarts(served, MODEL)) == (1, 0)


def test_models_come_and_go(tmp_path: Path) -> None:
    repository = make_repository(tmp_path)
    with administered(repository) as (served, api):
        add_other(repository)
        api.load(OTHER)
        wait_for(lambda: served.reasons() == {MODEL: NO_REASON, OTHER: NO_REASON})
        os.kill(served.model_processes(OTHER)[0], signal.SIGKILL)
        wait_for(lambda: restarts(served, OTHER) == 1)
        wait_for(lambda: served.reasons() == {MODEL: NO_REASON, OTHER: NO_REASON})
        with RepositoryApi(served.endpoints.grpc_url, KEY) as again:
            again.unload(OTHER)
            wait_for(lambda: served.reasons() == {MODEL: NO_REASON})
            os.kill(served.triton, signal.SIGKILL)
            wait_for(lambda: restarts(served, "triton") == 1)
            served.wait_ready()
            assert served.reasons() == {MODEL: NO_REASON}


def test_a_version_that_does_not_load_costs_the_other_nothing(
    tmp_path: Path, references: list[np.ndarray[Any, Any]]
) -> None:
    repository = make_repository(tmp_path)
    model = repository / MODEL
    shutil.copytree(model / "1", model / "2")
    with (model / "2" / "model.py").open("a") as code:
        code.write("\n\nimport os\n\nos._exit(1)\n")
    with administered(repository) as (served, api), served.client() as client:
        change(model / "config.pbtxt", r"versions: 1", "versions: 1 versions: 2")
        with Callers(client, references) as callers:
            with pytest.raises(RepositoryApiError):
                api.load(MODEL)
            callers.wait_for_all()
        assert (callers.lost, callers.wrong) == ([], [])
        assert restarts(served, MODEL) == 0


def test_a_model_that_keeps_ending_is_left_out_and_named_and_the_other_serves(tmp_path: Path) -> None:
    trigger = tmp_path / "trigger"
    repository = make_repository(tmp_path)
    add_other(
        repository,
        answering(f"""if os.path.exists({str(trigger)!r}):
        os._exit(1)"""),
    )
    with administered(repository) as (served, _), served.client() as client:
        trigger.touch()
        wait_for(lambda: served.reasons().get(OTHER, "").startswith("it is left out"))
        wait_for(lambda: served.reasons().get(MODEL) == NO_REASON)
        assert not served.is_ready()
        assert np.isfinite(client.progress(trajectory(0)).progress).all()
        trigger.unlink()
        with RepositoryApi(served.endpoints.grpc_url, KEY) as api:
            api.load(OTHER)
        served.wait_ready()
    assert any(line.startswith(f"rfm: {OTHER} is left out, since it kept ending: ") for line in served.said)


def test_a_triton_that_does_not_answer_is_started_again(tmp_path: Path) -> None:
    with serving(make_repository(tmp_path), "--triton-silent-s=3") as served:
        served.wait_ready()
        os.kill(served.triton, signal.SIGSTOP)
        wait_for(lambda: not served.is_ready())
        wait_for(lambda: restarts(served, "triton") == 1)
        served.wait_ready()
    assert served.said == ["rfm: triton is started again: no answer for 3 s"]


def test_a_crash_loop_ends_with_its_reason(tmp_path: Path) -> None:
    program = tmp_path / "tritonserver"
    program.write_text("#!/bin/sh\nexec sleep 0.1\n")
    program.chmod(0o755)
    with serving(make_repository(tmp_path), "--tritonserver", str(program)) as served:
        assert served.process.wait(PATIENCE_S) == 1
    assert served.said[-1] == "rfm: tritonserver: expected to run, got exit status 0"  # it never ran: no loop


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
    assert len(killed) == back_off.MOST + 1


def test_what_ran_for_long_is_no_part_of_a_crash_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(back_off, "time", clock)
    ends = BackOff("gateway")

    def run(duration_s: float) -> float:
        ends.started()
        clock.now_s += duration_s
        return ends.pause_s("why")

    assert [run(1.0) for _ in range(back_off.MOST)] == [0, 0.5, 1, 2, 4]
    assert run(back_off.STEADY_S) == 0
    for _ in range(back_off.MOST - 1):
        run(1.0)
    with pytest.raises(CrashLoopError, match="gateway: expected to run, got 6 ends, each within 60 s"):
        run(1.0)


@pytest.mark.parametrize("attempt_s", [1.0, 2 * back_off.STEADY_S])
def test_starts_that_fail_are_a_crash_loop_however_long_it_ran_before(
    monkeypatch: pytest.MonkeyPatch, attempt_s: float
) -> None:
    clock = Clock()
    monkeypatch.setattr(back_off, "time", clock)
    ends = BackOff("tritonserver")
    ends.started()
    clock.now_s += 5 * back_off.STEADY_S
    pauses = []
    for _ in range(back_off.MOST):
        pauses.append(ends.pause_s("it does not start"))
        clock.now_s += attempt_s
    assert pauses == [0, 0.5, 1, 2, 4]
    with pytest.raises(CrashLoopError, match="the last: it does not start"):
        ends.pause_s("it does not start")


def test_a_full_queue_refuses_at_once_and_a_long_wait_is_cut_short(tmp_path: Path) -> None:
    """By Triton's own policy; with one instance, Triton 2.51 notices a free one half a second late."""
    repository = make_repository(tmp_path, more_code=answering("time.sleep(0.5 * marked)"), instances=2, batch_size=2)
    bound_queue(repository / MODEL, max_queue_size=4, timeout_ms=600)
    with (
        (tmp_path / "log").open("wb") as log,
        BriefServer(repository, Endpoints.free(), find_installation(), log=log) as server,
        RewardClient(server.endpoints.grpc_url, retry=False) as client,
        RewardClient(server.endpoints.http_url, retry=False) as over_http,
        RewardClient(server.endpoints.grpc_url) as patient,
        ThreadPoolExecutor(64) as pool,
    ):
        slow = trajectory(0, mark=MARK)

        def ask(which: RewardClient) -> Exception | None:
            try:
                which.progress(slow)
            except ServerUnavailableError as error:
                return error
            return None

        outcomes = [future.result() for future in [pool.submit(ask, which) for which in (client, over_http) * 12]]
        full = [error for error in outcomes if error is not None and "Exceeds maximum queue size" in str(error)]
        assert full
        assert outcomes.count(None) >= 4
        # Who tries again is served in the end.
        assert [future.result() for future in [pool.submit(ask, patient) for _ in range(12)]] == [None] * 12


def test_the_status_port_names_a_taken_port(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with serving(make_repository(tmp_path), f"--status-port={port}") as served:
            assert served.process.wait(PATIENCE_S) == 1
    where = f"rfm: status: expected a free port of this machine at 127.0.0.1:{port}"
    assert served.said == [f"{where}, got: Address already in use; --status-port names another port"]
