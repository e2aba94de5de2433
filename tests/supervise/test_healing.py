# SPDX-License-Identifier: MIT
"""Faults that ``rfm serve`` survives: dead and hung processes, poison, more requests than can be served."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from clock import Clock
from prometheus_client.parser import text_string_to_metric_families
from rfm.supervise.model_processes import ProcessWatch
from rfm.supervise.model_reload import OwedAnswersError, Reload
from rfm.triton_model.quarantine import Quarantine
from rfm.triton_model.request_digest import digest
from rfm.triton_model.self_check import FAILED_BATCHES

from commands import is_alive
from one_model import BriefServer, OneModelServer
from patients import CALLERS, DEADLY, MARK, TOLERANCE, Callers, answering_after, make_repository, trajectory
from rfm.launch import cleanup
from rfm.launch.cleanup import SHARED_MEMORY
from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints
from rfm.supervise import back_off
from rfm.supervise.back_off import BackOff, CrashLoopError
from rfm_client import (
    InferenceFailedError,
    InvalidSampleError,
    ProgressSample,
    RewardClient,
    ServerUnavailableError,
)
from rfm_client.contract import triton, wire
from rfm_client.transport.calls import Answer, connect
from rfm_serve import MODEL, PATIENCE_S, RFM, TRUTH_S, Serving, children, serving, wait_for

pytestmark = [pytest.mark.triton, pytest.mark.slow]

SLOW = f"""

_answer = TritonPythonModel.answer


def slow(self, questions, execution):
    import time

    time.sleep(0.5 * sum(q.sample.trajectories[0].text_embedding[0] == {MARK} for q in questions))
    return _answer(self, questions, execution)


TritonPythonModel.answer = slow
"""
CHEAP = f"""

from rfm.triton_model import batch_model

batch_model.CHEAP_ANSWER_S = {{"cpu": {PATIENCE_S}}}  # every answer counts as cheap, however slow the machine is
"""
BREAKS = """

_answer = TritonPythonModel.answer
_broken = []


def breaking(self, questions, execution):
    import os

    if os.path.exists({trigger!r}):
        try:
            os.unlink({trigger!r})  # one process can
            _broken.append(True)
        except FileNotFoundError:
            pass
    if _broken:
        raise RuntimeError("CUDA error: device-side assert triggered")
    return _answer(self, questions, execution)


TritonPythonModel.answer = breaking
"""
STICKY = answering_after(0.3)
FAILS = f"""

_answer = TritonPythonModel.answer


def failing(self, questions, execution):
    if any(q.sample.trajectories[0].text_embedding[0] == {MARK} for q in questions):
        raise RuntimeError("a kernel that does not like this sample")
    return _answer(self, questions, execution)


TritonPythonModel.answer = failing
"""


def num_restarts(served: Serving, what: str) -> float:
    """Restarts of Triton, or of a model: a process that owes answers when it ends takes Triton along."""
    restarts = {name: served.metric("rfm_serve_restarts_total", what=name) for name in (MODEL, "triton")}
    return sum(restarts.values()) if what == MODEL else restarts[what]


def test_dead_and_hung_processes_are_healed_and_no_call_is_lost(
    tmp_path: Path, references: list[np.ndarray[Any, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    def kill_a_stub(served: Serving) -> None:
        served.model_processes[0].kill()

    def stop_a_stub(served: Serving) -> None:
        os.kill(served.model_processes[0].pid, signal.SIGSTOP)

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
                before = num_restarts(served, what)
                fault(served)
                told_s = served.wait_ready(False, TRUTH_S)
                answer = served.ready()
                assert answer is not None
                assert answer.json()["models"][MODEL]["reason"]
                assert served.metric("rfm_serve_ready", model=MODEL) == 0
                back_s = told_s + served.wait_ready(True, 10 + 2 * load_s + 5)
                callers.wait_for_all()
                assert num_restarts(served, what) == before + 1
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
        started = [served.triton, *(process.pid for process in served.model_processes)]
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
        wait_for(lambda: any(path.name.endswith("_rfm_batch") for path in left()))  # a model process of it runs
        own = left()
        assert not own & set(cleanup.clear())
        assert own <= left()
    finally:
        container.kill()
        container.wait(PATIENCE_S)
    wait_for(lambda: cleanup.clear() or not own & left())  # its processes have ended
    assert not own & left()


def test_a_request_that_kills_the_model_twice_is_refused_and_its_neighbours_are_served(
    tmp_path: Path, references: list[np.ndarray[Any, Any]]
) -> None:
    with serving(make_repository(tmp_path, more_code=DEADLY)) as served:
        served.wait_ready()
        with served.client() as client, Callers(client, references) as callers:
            callers.wait_for_all()
            with pytest.raises(InvalidSampleError, match="request: expected one that the model survives, got one that"):
                client.progress(trajectory(99, mark=MARK))  # sent again and again, until it is refused
            served.wait_ready()
            callers.wait_for_all()
            with pytest.raises(InvalidSampleError, match="ended its process 2 times: it is refused for 10 minutes"):
                client.progress(trajectory(99, mark=MARK))
        assert (callers.lost, callers.wrong) == ([], [])
        # The first death takes Triton along if the process owed answers, as it may under load.
        restarts = [served.metric("rfm_serve_restarts_total", what=what) for what in (MODEL, "triton")]
        assert restarts in ([2, 0], [1, 1]), served.said
        wait_for(lambda: served.metric("rfm_serve_poison_refused_total") == 2)


@pytest.mark.parametrize(("number", "times"), [(signal.SIGKILL, 1), (signal.SIGSTOP, 2)])
def test_who_waits_for_a_process_that_dies_or_stops_is_answered_by_the_next(
    tmp_path: Path, references: list[np.ndarray[Any, Any]], number: signal.Signals, times: int
) -> None:
    """Answers that take long are sent later. Triton never tells those who wait for them that they will not come.

    What a stopped process works on is no suspect: it may be stopped as often as you like.
    """
    with (
        serving(make_repository(tmp_path, more_code=STICKY)) as served,
        served.client(timeout_s=PATIENCE_S) as client,
        ThreadPoolExecutor(8) as pool,
    ):
        for _ in range(times):
            served.wait_ready()
            client.progress(trajectory(0))  # from now on it is known how long answers take
            waiting = [pool.submit(client.progress, trajectory(seed)) for seed in range(6)]
            (process,) = served.model_processes
            wait_for(lambda process=process: process.journal is not None and process.journal.num_owed > 1)  # type: ignore[misc]
            os.kill(process.pid, number)
            for future, expected in zip(waiting, references, strict=False):
                np.testing.assert_allclose(future.result().progress, expected, rtol=0, atol=TOLERANCE)
        assert served.metric("rfm_serve_restarts_total", what="triton") == times
        assert served.metric("rfm_serve_restarts_total", what=MODEL) == 0


def test_a_reload_that_ends_a_process_says_what_it_owed(tmp_path: Path) -> None:
    """A stopped process that Triton takes for dead is ended by the unload, so nobody finds it dead later."""
    with (
        OneModelServer(make_repository(tmp_path, more_code=STICKY), Endpoints.free()) as server,
        ThreadPoolExecutor(6) as pool,
        RewardClient(server.endpoints.grpc_url, retry=False) as client,
    ):
        (process,) = ProcessWatch(server.pid, PATIENCE_S).of_model(MODEL)
        client.progress(trajectory(0))
        waiting = [pool.submit(client.progress, trajectory(seed)) for seed in range(6)]
        wait_for(lambda: process.journal is not None and process.journal.num_owed > 1)
        os.kill(process.pid, signal.SIGSTOP)
        with server.repository_api() as api:
            config = api.config(MODEL, 1)
        with pytest.raises(OwedAnswersError, match=r"processes of rfm have ended, and owe [2-6] answers"):
            Reload(MODEL, server, config, is_out=False, was_hung=False).load([process])
        assert not process.is_alive
        server.kill()
        assert any(isinstance(future.exception(), ServerUnavailableError) for future in waiting)


def test_a_suspect_is_remembered_when_triton_is_started_again(tmp_path: Path) -> None:
    """The first death takes Triton along, since answers are owed; the second one only its process."""
    with serving(make_repository(tmp_path, more_code=STICKY + DEADLY)) as served:
        served.wait_ready()
        with served.client(timeout_s=PATIENCE_S) as client:
            client.progress(trajectory(0))
            with pytest.raises(InvalidSampleError, match="ended its process 2 times: it is refused for 10 minutes"):
                client.progress(trajectory(99, mark=MARK))
        assert served.metric("rfm_serve_restarts_total", what="triton") == 1
        assert served.metric("rfm_serve_restarts_total", what=MODEL) == 1


def test_one_broken_instance_of_several_is_found_and_healed(
    tmp_path: Path, references: list[np.ndarray[Any, Any]]
) -> None:
    trigger = tmp_path / "trigger"
    repository = make_repository(tmp_path, more_code=BREAKS.format(trigger=str(trigger)), instances=2)
    with serving(repository) as served, served.client() as client:
        served.wait_ready()
        with Callers(client, references) as callers:
            for count in (1, 2):
                callers.wait_for_all()
                trigger.touch()
                wait_for(lambda count=count: served.metric("rfm_serve_restarts_total", what=MODEL) == count)  # type: ignore[misc]
                served.wait_ready()
                failed = list(callers.lost)
                callers.lost.clear()
                assert 0 < len(failed) <= FAILED_BATCHES * CALLERS
                assert {type(error) for error in failed} == {InferenceFailedError}
                callers.wait_for_all()
        assert (callers.lost, callers.wrong) == ([], [])
        assert served.metric("rfm_serve_poison_refused_total") == 0  # nobody is blamed
    assert served.log.read_text().count("instance_broken") == 2


def test_samples_that_fail_do_not_end_the_instance(tmp_path: Path, references: list[np.ndarray[Any, Any]]) -> None:
    with serving(make_repository(tmp_path, more_code=FAILS)) as served, served.client(retry=False) as client:
        served.wait_ready()
        before = served.model_processes
        for _ in range(4 * FAILED_BATCHES):
            with pytest.raises(InferenceFailedError, match="scoring failed"):
                client.progress(trajectory(99, mark=MARK))
        np.testing.assert_allclose(client.progress(trajectory(0)).progress, references[0], rtol=0, atol=TOLERANCE)
        assert served.model_processes == before
        assert served.metric("rfm_serve_restarts_total") == 0
    assert served.said == []


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
    wanted = r"rfm: tritonserver: expected to run, got 6 ends, each within 60 s of a start; the last: .*exit status -9"
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


@pytest.mark.parametrize("instances", [1, 2])
def test_a_full_queue_refuses_at_once_and_a_long_wait_is_cut_short(tmp_path: Path, instances: int) -> None:
    bounds = {"max_queue_size": 4, "queue_timeout_ms": 1500}
    repository = make_repository(tmp_path, more_code=SLOW, instances=instances, batch_size=2, **bounds)
    with (
        (tmp_path / "log").open("wb") as log,
        BriefServer(repository, Endpoints.free(), find_installation(), log=log) as server,
        RewardClient(server.endpoints.grpc_url, retry=False) as client,
        RewardClient(server.endpoints.http_url, retry=False) as over_http,
        RewardClient(server.endpoints.grpc_url) as patient,
        ThreadPoolExecutor(64) as pool,
    ):
        slow = trajectory(0, mark=MARK)
        client.progress(slow)

        def ask(which: RewardClient) -> tuple[float, Exception | None]:
            started_s = time.monotonic()
            try:
                which.progress(slow)
                return time.monotonic() - started_s, None
            except ServerUnavailableError as error:
                return time.monotonic() - started_s, error

        outcomes = [future.result() for future in [pool.submit(ask, which) for which in (client, over_http) * 12]]
        full = [took_s for took_s, error in outcomes if error is not None and triton.QUEUE_FULL in str(error)]
        late = [took_s for took_s, error in outcomes if error is not None and "has waited for longer" in str(error)]
        served = [took_s for took_s, error in outcomes if error is None]
        assert len(full) + len(late) + len(served) == len(outcomes)
        # Each instance works on a batch, four requests wait, and each instance may begin another batch.
        assert len(full) >= len(outcomes) - 2 * instances - 4 - 2 * instances
        wait_for(lambda: rejected(server.endpoints.metrics_url) == len(full) + len(late))
        assert served
        assert max(served) < PATIENCE_S / 4
        assert sorted(full)[len(full) // 2] < max(served)  # they did not wait for anybody
        # Who tries again is served in the end.
        assert [future.result()[1] for future in [pool.submit(ask, patient) for _ in range(12)]] == [None] * 12


def test_a_full_queue_refuses_cheap_requests_that_triton_hands_over_one_by_one(tmp_path: Path) -> None:
    """Every other request has one more input, so none shares a batch with the next, however many wait in Triton."""
    repository = make_repository(tmp_path, more_code=CHEAP, max_queue_size=4)
    with (repository / MODEL / "config.pbtxt").open("a") as config:
        config.write('input { name: "more" data_type: TYPE_FP32 dims: [ 1 ] optional: true }\n')
    inputs = wire.encode_samples([ProgressSample(trajectory(0))])
    others = inputs | {"more": np.zeros((1, 1), np.float32)}

    async def outcomes(url: str) -> list[Answer | BaseException]:
        server = connect(url)
        try:
            await server.infer(MODEL, inputs, ["progress"], PATIENCE_S)
            asked = [server.infer(MODEL, each, ["progress"], PATIENCE_S) for each in [inputs, others] * 128]
            return await asyncio.gather(*asked, return_exceptions=True)
        finally:
            await server.close()

    with (
        (tmp_path / "log").open("wb") as log,
        BriefServer(repository, Endpoints.free(), find_installation(), log=log) as server,
    ):
        came = asyncio.run(outcomes(server.endpoints.grpc_url))
        errors = [outcome for outcome in came if isinstance(outcome, BaseException)]
        assert 0 < len(errors) < len(came)
        assert all(triton.QUEUE_FULL in str(error) for error in errors)
        wait_for(lambda: rejected(server.endpoints.metrics_url) == len(errors))


def rejected(metrics_url: str) -> float:
    """Samples that a model has counted as rejected."""
    families = text_string_to_metric_families(httpx.get(metrics_url).text)
    counted = (sample for family in families if family.name == "rfm_samples" for sample in family.samples)
    return sum(sample.value for sample in counted if sample.labels.get("outcome") == "rejected")


def test_a_journal_outlives_its_process_and_tells_what_it_was_working_on(tmp_path: Path) -> None:
    tensors = {"a": np.arange(100_000, dtype=np.float32), "task": np.array([[b"stack"]], np.object_)}
    first = digest(tensors)
    assert first == digest({name: array.copy() for name, array in tensors.items()})
    changed = dict(tensors, a=tensors["a"].copy())
    changed["a"] += 1
    others = [digest(changed), digest(dict(tensors, task=np.array([[b"sort"]], np.object_)))]
    assert len({first, *others}) == 3

    def die(name: str) -> None:
        """A process that dies while it works on two requests."""
        code = "import os, sys; from pathlib import Path; from rfm.triton_model.quarantine import Quarantine; folder = Path(sys.argv[1])\n"
        code += "own = Quarantine(folder / sys.argv[2], sorted(folder.glob('*_batch')), 4)\n"
        code += "with own.at_work_on([bytes.fromhex(word) for word in sys.argv[3:]]): os._exit(1)"
        words = [told.hex() for told in (first, others[0])]
        subprocess.run([sys.executable, "-c", code, tmp_path, name, *words], check=False, timeout=PATIENCE_S)

    die("1_batch")
    one = Quarantine(tmp_path / "2_batch", tmp_path.glob("1_batch"), 4)
    assert [one.is_suspect(told) for told in (first, *others)] == [True, True, False]
    one.check(first)
    with one.at_work_on([others[0]]):
        pass
    assert [one.is_suspect(told) for told in (first, *others)] == [True, False, False]
    one.close()
    die("3_batch")
    two = Quarantine(tmp_path / "4_batch", sorted(tmp_path.glob("*_batch")), 4)
    with pytest.raises(InvalidSampleError, match="ended its process 2 times"):
        two.check(first)
    two.check(others[0])  # once: it was survived meanwhile
    assert two.is_suspect(others[0])
    two.close()


def test_the_status_port_names_a_taken_port(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with serving(make_repository(tmp_path), f"--status-port={port}") as served:
            assert served.process.wait(PATIENCE_S) == 1
    where = f"rfm: status: expected a free port of this machine at 127.0.0.1:{port}"
    assert served.said == [f"{where}, got: Address already in use; --status-port names another port"]
