# SPDX-License-Identifier: MIT
"""Clients that are closed, forked, or used from callbacks, and what is refused when one is made."""

from __future__ import annotations

import asyncio
import copy
import pickle
import shutil
import subprocess
import sys
import sysconfig
import threading
import venv
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium
import numpy as np
import pytest

from mixtures import MODEL, assert_same, plug
from paths import ROOT
from reference_server import Served
from rfm_client import (
    AsyncRewardClient,
    InferenceFailedError,
    ProgressResult,
    ProgressSample,
    RewardClient,
    ServerUnavailableError,
)
from rfm_client.contract import wire
from rfm_client.gym import RewardModelWrapper
from rfm_client.transport.access import Access
from rfm_client.transport.calls import Answer, GrpcTransport
from trajectories import random_trajectory


def test_a_closed_client_says_so(served: Served) -> None:
    client = served.client("grpc")
    client.close()
    client.close()
    with pytest.raises(RuntimeError, match="is closed"):
        client.progress(random_trajectory(0, 2))

    async def ask() -> None:
        async with AsyncRewardClient(served.url("grpc"), model=MODEL) as client:
            pass
        await client.progress(random_trajectory(0, 2))

    with pytest.raises(RuntimeError, match="this AsyncRewardClient is closed"):
        asyncio.run(ask())


def test_closing_cancels_what_is_under_way(served: Served) -> None:
    with served.client("grpc") as client:
        pending = [client.submit(sample) for sample in plug()]
    assert all(future.done() for future in pending)
    assert any(future.cancelled() for future in pending)


def test_a_fork_is_told_to_make_its_own_client() -> None:
    code = """
import os
from rfm_client import ProgressSample, RewardClient, Trajectory
import numpy as np
trajectory = Trajectory(video_embeddings=np.ones((1, 2)), text_embedding=np.ones(2))
client = RewardClient("grpc://127.0.0.1:1")
if os.fork() == 0:
    try:
        client.progress(trajectory)
    except RuntimeError as error:
        print(error, flush=True)
        client.close()
        os._exit(0)
    os._exit(1)
raise SystemExit(os.waitstatus_to_exitcode(os.wait()[1]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "which forked this one: make one in each process" in done.stdout


def test_a_fork_of_what_used_grpc_is_told_so(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a fork: gRPC's own handlers may crash one."""
    monkeypatch.setattr(GrpcTransport, "_first_process", 1)
    expected = "gRPC was used in process 1, which forked this one: .* by spawn or forkserver"
    with served.client("grpc") as client, pytest.raises(RuntimeError, match=expected):
        client.is_ready()
    with served.client("http") as client:
        assert client.is_ready()


NOBODY = "grpc://127.0.0.1:1"  # a port where nothing listens
POLE = "CartPole-v1"
HOLDERS: dict[str, Callable[[RewardClient], Any]] = {
    "RewardClient": lambda client: client,
    "AsyncRewardClient": lambda client: AsyncRewardClient(NOBODY),
    "Episode": lambda client: client.episode("lift"),
    "Episodes": lambda client: client.episodes(2, "lift"),
    "AsyncEpisode": lambda client: AsyncRewardClient(NOBODY).episode("lift"),
    "RewardModelWrapper": lambda client: RewardModelWrapper(
        gymnasium.make(POLE, render_mode="rgb_array"), client, "lift"
    ),
}


@pytest.mark.parametrize("name", HOLDERS)
def test_what_holds_a_client_says_what_to_pickle_instead(name: str) -> None:
    told = r"pass functools\.partial\(RewardClient, url\) instead, and call that in each"
    with RewardClient(NOBODY) as client:
        holder = HOLDERS[name](client)
        for dumps in (pickle.dumps, cloudpickle.dumps, copy.deepcopy):
            with pytest.raises(TypeError, match=told):
                dumps(holder)
    assert pickle.loads(pickle.dumps(partial(RewardClient, NOBODY))).args == (NOBODY,)


def test_an_async_client_in_a_second_event_loop_says_so(served: Served, protocol: str) -> None:
    client = AsyncRewardClient(served.url(protocol), model=MODEL)

    async def ask() -> ProgressResult:
        return await client.progress(random_trajectory(0, 2))

    async def ask_and_close() -> None:
        await ask()
        await client.close()

    with closing(asyncio.new_event_loop()) as first, closing(asyncio.new_event_loop()) as second:
        assert len(first.run_until_complete(ask()).progress) == 2
        for use in (ask, client.is_ready, client.model_info):
            with pytest.raises(RuntimeError, match=r"that it was first used in, .*: make one in each loop"):
                second.run_until_complete(use())
        first.run_until_complete(ask_and_close())


class LosesConnection:
    """A server under whose request the connection seems to end when the request is cancelled."""

    url = NOBODY

    def __init__(self) -> None:
        self.has_request = threading.Event()

    async def infer(self, *_: Any, **__: Any) -> Answer:
        self.has_request.set()
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            raise ServerUnavailableError("Stream removed") from None
        raise AssertionError("nothing sets the event")

    async def model_info(self, *_: Any) -> Any:
        raise ServerUnavailableError("Stream removed")

    async def is_ready(self, *_: Any) -> bool:
        return False

    async def close(self) -> None:
        pass


def test_a_client_that_is_closed_does_not_try_again(caplog: pytest.LogCaptureFixture) -> None:
    server = LosesConnection()
    with RewardClient("", transports=[server]) as client:
        future = client.submit(ProgressSample(random_trajectory(0, 2)))
        assert server.has_request.wait(10.0)
    assert isinstance(future.exception(), ServerUnavailableError)
    assert not caplog.records


def test_submitting_while_it_is_closed_leaves_no_future_open(served: Served) -> None:
    """Over HTTP, where closing cancels nothing on the server: see ``Served.revive``."""
    for _ in range(20):
        client = served.client("http")
        futures: list[Future[ProgressResult]] = []

        def submit(client: RewardClient = client, futures: list[Future[ProgressResult]] = futures) -> None:
            with pytest.raises(RuntimeError, match="is closed"):
                while True:
                    futures.append(client.submit(ProgressSample(random_trajectory(0, 1))))

        with ThreadPoolExecutor(2) as pool:
            submitting = [pool.submit(submit) for _ in range(2)]
            client.close()
            for thread in submitting:
                thread.result()
        assert all(future.done() for future in futures)


def test_what_makes_the_samples_may_ask_the_client(served: Served) -> None:
    with served.client("grpc") as client:
        samples = (ProgressSample(random_trajectory(0, 2)) for _ in range(2) if client.is_ready())
        assert len(client.evaluate(samples)) == 2


def test_a_call_in_a_future_s_callback_is_refused_rather_than_waiting_for_itself(served: Served) -> None:
    told: Future[str] = Future()
    with served.client("grpc") as client:

        def ask(_done: Future[ProgressResult]) -> None:
            try:
                client.is_ready()
            except RuntimeError as error:
                told.set_result(str(error))

        client.submit(ProgressSample(random_trajectory(0, 2))).add_done_callback(ask)
        assert "use submit" in told.result(timeout=30)


def test_a_future_keeps_its_client_and_its_arrays(served: Served) -> None:
    trajectory = random_trajectory(0, 8)
    with served.client("grpc") as client:
        expected = client.progress(trajectory)
        future = client.submit(ProgressSample(trajectory))
        trajectory.positions[:] = 0
        assert_same(future.result(), expected)
    assert served.client("grpc").submit(ProgressSample(random_trajectory(0, 2))).result().last_progress > 0


def test_a_score_that_is_missing_fails_alone(served: Served) -> None:
    class Losing(GrpcTransport):
        """A real transport that loses the progress of one sample in answers to several."""

        async def infer(self, model: str, inputs: wire.Tensors, *rest: Any, **options: Any) -> Answer:
            answer = await super().infer(model, inputs, *rest, **options)
            lost = inputs[wire.VIDEO_EMBEDDINGS].sum(axis=(1, 2)) == marked
            progress = np.where(lost[:, None], np.nan, answer.tensors[wire.PROGRESS])
            return replace(answer, tensors={**answer.tensors, wire.PROGRESS: progress})

    url = served.url("grpc")
    samples = [ProgressSample(random_trajectory(seed, 3)) for seed in range(4)]
    marked = wire.encode_samples(samples[2:3])[wire.VIDEO_EMBEDDINGS].sum(axis=(1, 2))[0]
    transport = Losing(url, Access(), shared_memory=False)
    with RewardClient("", transports=[transport], model=MODEL) as client:
        outcomes = client.evaluate(samples, return_errors=True)
    assert [type(outcome) for outcome in outcomes] == [ProgressResult] * 2 + [InferenceFailedError, ProgressResult]


def test_an_http_client_at_the_grpc_port_is_told_at_once(served: Served) -> None:
    url = served.url("grpc").replace("grpc://", "http://")
    with RewardClient(url) as client, pytest.raises(ServerUnavailableError, match="got its gRPC port: use grpc://"):
        client.progress(random_trajectory(0, 2))


def test_a_client_that_is_not_closed_does_not_keep_the_interpreter(served: Served) -> None:
    code = f"""
from rfm_client import RewardClient
assert RewardClient({served.url("grpc")!r}, model={MODEL!r}).is_ready()
client = RewardClient({served.url("http")!r}, model={MODEL!r})
assert client.is_ready()
"""
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("url", ["localhost:8001", "grpc://localhost", "grpc://", "", "ftp://b:2", "grpc://a:70000"])
def test_a_wrong_url_is_refused_when_the_client_is_made(url: str) -> None:
    with pytest.raises(ValueError, match="url") as raised:
        RewardClient(["grpc://a:1", url])
    forms = "grpc://host:port or http://host:port, or grpcs:// or https://"
    assert str(raised.value) == f"url: expected {forms}, got {url!r}"


def test_a_client_needs_a_url() -> None:
    with pytest.raises(ValueError, match="url: expected at least one, got none"):
        RewardClient([])


def test_an_unknown_option_is_refused() -> None:
    options: dict[str, Any] = {"sub_sample": True}
    with RewardClient(NOBODY) as client, pytest.raises(TypeError, match="sub_sample"):
        client.progress(random_trajectory(0, 1), **options)
    with pytest.raises(TypeError, match="sub_sample"):
        RewardClient(NOBODY, **options)


@pytest.mark.parametrize("timeout_s", [float("inf"), float("nan"), 0, -1, 2e9])
def test_a_deadline_must_lie_ahead_and_within_reach(timeout_s: float) -> None:
    wanted = f"timeout_s: expected a number of seconds above 0 and at most 1e+09, got {timeout_s}"
    with RewardClient(NOBODY) as client:
        calls: list[Callable[[], object]] = [
            lambda: RewardClient(NOBODY, timeout_s=timeout_s),
            lambda: client.progress(random_trajectory(0, 1), timeout_s=timeout_s),
            lambda: client.model_info(timeout_s=timeout_s),
            lambda: client.wait_ready(timeout_s),
        ]
        for call in calls:
            with pytest.raises(ValueError, match="timeout_s") as caught:
                call()
            assert str(caught.value) == wanted


def test_the_client_imports_no_heavy_package() -> None:
    code = """
import sys
import rfm_client
heavy = {"torch", "pandas", "av", "PIL", "gymnasium", "typer", "rich", "matplotlib", "grpc", "gevent", "aiohttp"}
print(*sorted(heavy & set(sys.modules)))
"""
    heavy = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    assert heavy == []


USER_FILE = """
from concurrent.futures import Future

import numpy as np
from rfm_client import (
    AsyncRewardClient, PreferenceSample, ProgressResult, ProgressSample, Result, RewardClient, RewardError, Trajectory
)

trajectory = Trajectory(frames=np.zeros((2, 8, 8, 3), np.uint8), task="stack the cups")
with RewardClient(["grpc://a:8001", "http://b:8000"], model="rfm", timeout_s=5.0, shared_memory=True) as client:
    reward: float = client.progress(trajectory, frame_steps=4, subsample=True).last_progress
    future: Future[ProgressResult] = client.submit(ProgressSample(trajectory), timeout_s=1.0)
    some: list[Result] = client.evaluate([ProgressSample(trajectory), PreferenceSample(trajectory, trajectory)])
    each: list[Result | RewardError] = client.evaluate([ProgressSample(trajectory)], return_errors=True)
    preference: float = client.preference(trajectory, trajectory).preference


async def rewards() -> float:
    async with AsyncRewardClient("grpc://a:8001") as client:
        return (await client.similarity(trajectory, trajectory)).similarity
"""


WRONG_USES = {
    'client.progress(trajectory, timeout="5")': "timeout",
    "client.progress(trajectory, sub_sample=True)": "sub_sample",
    "client.submit(ProgressSample(trajectory)).result().preference": "preference",
}


@pytest.mark.slow
def test_a_user_s_file_type_checks_against_the_installed_wheel(tmp_path: Path) -> None:
    source = ROOT / "client"
    wheels, environment = tmp_path / "wheels", tmp_path / "environment"
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    copied = tmp_path / "client"
    shutil.copytree(source, copied, ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__"))
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", wheels, copied], check=True)
    venv.create(environment, with_pip=False)
    installed = next(environment.glob("lib/python*/site-packages"))
    subprocess.run([*pip, "install", "--no-deps", "--target", installed, *wheels.glob("*.whl")], check=True)
    (installed / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    user_file = tmp_path / "user.py"

    def check(text: str) -> subprocess.CompletedProcess[str]:
        user_file.write_text(text)
        options = ["--strict", "--config-file=", f"--python-executable={environment}/bin/python"]
        command = [sys.executable, "-m", "mypy", *options, user_file]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)

    good = check(USER_FILE)
    assert good.returncode == 0, good.stdout
    bad = check(USER_FILE + "\n\n" + "\n".join(WRONG_USES))
    for name in WRONG_USES.values():
        assert f'"{name}"' in bad.stdout
