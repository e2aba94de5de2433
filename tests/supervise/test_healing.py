# SPDX-License-Identifier: MIT
"""Faults that ``rfm serve`` survives by a restart of Triton."""

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

import httpx
import numpy as np
import pytest

from commands import running
from patients import CALLERS, MARK, answering, calling, make_repository, trajectory
from rfm.launch import cleanup
from rfm.launch.cleanup import SHARED_MEMORY
from rfm.launch.repository_api import RepositoryApiError
from rfm.supervise.status import NO_REASON
from rfm.supervise.supervisor import MOST, STEADY_S, BackOff, CrashLoopError
from rfm.triton_model.watchdog import FAILED_BATCHES
from rfm_client import InferenceFailedError, ServerUnavailableError
from servers import (
    MODEL,
    PATIENCE_S,
    RFM,
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
from tolerances import TOLERANCE

pytestmark = pytest.mark.slow

OTHER = f"{MODEL}_b"
HANG_S = 3
DEADLY, FAILING, SLOW = MARK, MARK + 1, MARK + 2  # marks of samples


def once(trigger: Path) -> str:
    """Return an expression that is true once, in a single process, after the file appears."""
    return f"os.path.exists({str(trigger)!r}) and os.unlink({str(trigger)!r}) is None"


@pytest.mark.triton
def test_what_dies_stops_hangs_or_is_silent_is_healed_and_no_call_is_lost_until_it_is_a_crash_loop(
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
        with served.client() as client, calling(client, references) as callers:
            for fault, what in faults.items():
                callers.wait_for_all()
                before = served.restarts(what)
                fault(served)
                served.wait_ready(False, TRUTH_S + HANG_S)
                answer = served.ready()
                assert answer is not None
                assert answer.json()["models"][MODEL]["reason"]
                assert served.metric("rfm_serve_ready", model=MODEL) == 0
                served.wait_ready()
                callers.wait_for_all()
                assert served.restarts(what) == before + 1
        assert (callers.lost, callers.wrong) == ([], 0)
        assert served.metric("rfm_serve_probe_seconds_count", model=MODEL) > 3
        restarts = [line for line in served.said if "is started again" in line]  # not what other tests' servers left
        assert len(restarts) == len(faults), served.said
        assert served.said[-1] == "rfm: triton is started again: no answer for 3 s"
        log = served.log.read_text()
        assert "Timeout (0:00:03)!" in log
        again = re.findall(r"^\S+Z INFO rfm-serve\[\d+\]: ready again after \d+\.\d s$", log, re.MULTILINE)
        assert len(again) == len(faults)
        assert "rfm: triton is started again: killed by SIGKILL" in served.said

        def kill() -> bool:
            for pid in children(served.process.pid, "tritonserver"):
                with suppress(ProcessLookupError):  # it has ended meanwhile
                    os.kill(pid, signal.SIGKILL)
            return served.process.poll() is not None

        wait_for(kill)
    assert served.process.returncode == 1
    wanted = r"rfm: triton: expected to run, got 6 faults in a row; the last: .*killed by SIGKILL"
    assert re.fullmatch(wanted, served.said[-1]), served.said


@pytest.mark.triton
@pytest.mark.nightly  # three minutes; tests/client/test_fleet.py has the case of a fleet
def test_requests_end_their_process_twice_at_most_and_a_model_that_keeps_ending_is_left_out(
    tmp_path: Path, references: list[np.ndarray[Any, Any]]
) -> None:
    """A request takes long, fails, or ends the process. A broken instance ends itself."""
    trigger, deadly = tmp_path / "trigger", tmp_path / "deadly"
    code = f"""if {SLOW} in marks:
        for _ in range({2 * HANG_S}):
            time.sleep(1)
            execution.on_forward()
    if {FAILING} in marks:
        raise RuntimeError("a kernel that does not like this sample")
    if {DEADLY} in marks:
        os._exit(1)
    if {once(trigger)}:
        type(self).is_broken = True
    if getattr(self, "is_broken", False):
        raise RuntimeError("CUDA error: device-side assert triggered")"""
    repository = make_repository(tmp_path)
    shutil.copytree(repository / MODEL, repository / OTHER)
    config = repository / OTHER / "config.pbtxt"
    config.write_text(config.read_text().replace(f'name: "{MODEL}"', f'name: "{OTHER}"'))
    for model, more in ((MODEL, code), (OTHER, f"if os.path.exists({str(deadly)!r}): os._exit(1)")):
        file = repository / model / "1" / "model.py"
        file.write_text(file.read_text() + answering(more))
    with administered(repository, hang_s=HANG_S) as served, served.client() as client:
        before = served.model_processes()
        assert np.isfinite(client.progress(trajectory(0, mark=SLOW)).progress).all()
        for _ in range(4 * FAILED_BATCHES):
            with pytest.raises(InferenceFailedError, match="scoring failed"):
                client.progress(trajectory(99, mark=FAILING))
        assert served.model_processes() == before

        # A version that cannot be loaded costs no answer.
        broken = shutil.copytree(repository / MODEL / "1", repository / MODEL / "2") / "model.py"
        broken.write_text(broken.read_text() + "\n\nimport os\n\nos._exit(1)\n")
        config = repository / MODEL / "config.pbtxt"
        one_version = config.read_text()
        config.write_text(one_version.replace("versions: 1", "versions: 1 versions: 2"))
        with calling(client, references) as callers:
            with served.api() as api, pytest.raises(RepositoryApiError):
                api.load(MODEL)
            callers.wait_for_all()
        assert (callers.lost, callers.wrong) == ([], 0)
        assert served.said == []
        config.write_text(one_version)

        with pytest.raises(ServerUnavailableError, match="ended twice during this request"):
            client.progress(trajectory(99, mark=DEADLY))
        # A process that dies before the supervisor reads the command line counts as Triton's.
        wait_for(lambda: served.restarts(MODEL, "triton") == 2)
        served.wait_ready()
        np.testing.assert_allclose(client.progress(trajectory(0)).progress, references[0], rtol=0, atol=TOLERANCE)

        with calling(client, references) as callers:
            callers.wait_for_all()
            trigger.touch()
            wait_for(lambda: served.restarts(MODEL, "triton") == 3)
            served.wait_ready()
            assert 0 < len(callers.lost) <= FAILED_BATCHES * CALLERS
            assert {type(error) for error in callers.lost} == {InferenceFailedError}
            callers.lost.clear()
            callers.wait_for_all()
        assert (callers.lost, callers.wrong) == ([], 0)
        assert "instance is broken" in served.log.read_text()

        deadly.touch()
        wait_for(
            lambda: served.reasons().get(OTHER, "").startswith("it is left out"), 3 * PATIENCE_S
        )  # of starts that fail
        wait_for(lambda: served.reasons().get(MODEL) == NO_REASON)
        assert served.is_ready()
        assert np.isfinite(client.progress(trajectory(0)).progress).all()
        deadly.unlink()
        away = (repository / OTHER).rename(tmp_path / OTHER)
        wait_for(lambda: served.reasons() == {MODEL: NO_REASON})  # without the folder it is forgotten
        away.rename(repository / OTHER)
        with served.api() as api:
            api.load(OTHER)
        wait_for(lambda: served.reasons() == {MODEL: NO_REASON, OTHER: NO_REASON})
    assert served.process.returncode == 0
    told = f"rfm: {OTHER} is left out, since it had (4 of [4-6]|[1-3] of 6) faults in a row; the last: "  # after others' faults
    assert any(re.match(told, line) for line in served.said)


@pytest.mark.triton
def test_a_process_that_dies_while_its_model_loads_is_noticed_and_each_fault_counts_for_its_process(
    tmp_path: Path,
) -> None:
    repository = make_repository(tmp_path)
    with administered(repository) as served:
        half_copied = shutil.copytree(repository / MODEL, repository / OTHER)
        config = half_copied / "config.pbtxt"
        config.write_text(config.read_text().replace(f'name: "{MODEL}"', f'name: "{OTHER}"'))
        (half_copied / "1" / "model.py").unlink()
        with served.api() as api, pytest.raises(RepositoryApiError):
            api.load(OTHER)
        wait_for(lambda: served.restarts(OTHER) == 1)
        served.wait_ready()
        assert served.reasons() == {MODEL: NO_REASON}

        num_said = len(served.said)
        os.kill(served.model_processes()[0], signal.SIGKILL)
        wait_for(lambda: len(served.said) > num_said)  # the restart begins
        wait_for(lambda: children(served.process.pid, "tritonserver"))
        os.kill(served.triton, signal.SIGKILL)
        wait_for(lambda: served.restarts("triton") == 1)
        served.wait_ready()
        assert served.restarts(MODEL) == 1


@pytest.mark.triton
@pytest.mark.parametrize("imports", [False, True], ids=["it appears", "it imports"])
def test_a_start_is_repeated_when_a_model_process_is_killed(tmp_path: Path, imports: bool) -> None:
    begun = tmp_path / "begun"
    waits = f"if not os.path.exists({str(begun)!r}):\n    open({str(begun)!r}, 'w')\n    time.sleep(3600)"
    repository = make_repository(tmp_path, more_code=f"\n\nimport os, time\n\n{waits}\n" if imports else "")

    def loading() -> set[int]:  # found by the repository, since this process may have started other servers
        return running(f"{repository}/{MODEL}/", 2)

    def kill_first() -> set[int]:
        wait_for(begun.exists if imports else loading)
        processes = loading()
        for pid in processes:
            os.kill(pid, signal.SIGKILL)
        return processes

    with ThreadPoolExecutor(1) as thread:
        killed = thread.submit(kill_first)
        with start_triton(repository) as server:
            assert killed.result()
            assert model_processes(server.pid)
            assert killed.result().isdisjoint(model_processes(server.pid))


@pytest.mark.triton
@pytest.mark.alone
def test_a_server_that_is_killed_leaves_nothing_running_and_the_next_removes_the_rest(tmp_path: Path) -> None:
    """In a separate container, whose process ids mean nothing here, if this user may make one."""
    apart = ["unshare", "--map-root-user", "--pid", "--fork", "--kill-child", "--mount-proc"]
    if subprocess.run([*apart, "true"], check=False, stderr=subprocess.DEVNULL).returncode != 0:
        apart = []
    repository, others = make_repository(tmp_path), {*SHARED_MEMORY.iterdir()}
    command = [*apart, RFM, "serve", "--repository", repository]
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
    with serving(repository) as served:
        wait_for(lambda: served.said and not own & left())
    assert any(f"removed {SHARED_MEMORY}" in line for line in served.said)


def test_the_row_names_what_had_each_fault() -> None:
    ends = BackOff()
    assert [ends.failed(cause) for cause in ("rfm", "triton", "rfm")] == [1, 1, 2]
    assert ends.row == ["rfm", "triton", "rfm"]


def test_a_crash_loop_is_many_faults_each_soon_after_a_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """A long run resets the count; failed starts do not, however long they take."""
    now_s = 0.0
    monkeypatch.setattr("time.monotonic", lambda: now_s)

    def run_for(duration_s: float) -> float:
        nonlocal now_s
        ends.started()
        now_s += duration_s
        ends.failed("triton")
        return ends.pause_s("why")

    ends = BackOff()
    assert [run_for(1.0) for _ in range(MOST)] == [0, 0.5, 1, 2, 4]
    assert run_for(STEADY_S) == 0
    assert [run_for(1.0) for _ in range(MOST - 1)] == [0.5, 1, 2, 4]
    wanted = r"^triton: expected to run, got 6 faults in a row; the last: why$"
    with pytest.raises(CrashLoopError, match=wanted):
        run_for(1.0)
    ends = BackOff()
    run_for(5 * STEADY_S)
    for _ in range(MOST - 1):
        now_s += 2 * STEADY_S
        ends.failed("triton")
        ends.pause_s("it does not start")
    ends.failed("triton")
    with pytest.raises(CrashLoopError, match="the last: it does not start"):
        ends.pause_s("it does not start")
