# SPDX-License-Identifier: MIT
"""Clients that are closed, forked, or used from callbacks, and arguments that the constructor refuses."""

from __future__ import annotations

import asyncio
import copy
import itertools
import pickle
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import cloudpickle
import gymnasium
import pytest

from mixtures import MODEL, assert_same, plug
from paths import ROOT
from rfm_client import (
    AsyncRewardClient,
    ClientClosedError,
    ProgressResult,
    ProgressSample,
    RewardClient,
    RewardError,
)
from rfm_rl import RewardModelWrapper
from servers import Served
from trajectories import random_trajectory


def test_a_closed_client_says_so(served: Served) -> None:
    client = served.client("grpc")
    client.close()
    client.close()
    with pytest.raises(ClientClosedError, match="is closed"):
        client.progress(random_trajectory(0, 2))

    async def ask() -> None:
        async with AsyncRewardClient(served.url("grpc"), model=MODEL) as client:
            pass
        await client.progress(random_trajectory(0, 2))

    with pytest.raises(ClientClosedError, match="this AsyncRewardClient is closed"):
        asyncio.run(ask())


def test_closing_ends_the_calls_of_all_threads_and_futures_with_an_error_that_says_so(served: Served) -> None:
    """Also the calls that have not been sent yet."""
    with ThreadPoolExecutor(4) as pool:
        with served.client("grpc") as client:
            pending = [client.submit(sample) for sample in plug()]
            pending += [pool.submit(client.evaluate, plug()) for _ in range(4)]
            assert client.is_ready()
        errors = [future.exception(timeout=30) for future in pending]
    assert {type(error) for error in errors} <= {ClientClosedError, type(None)}
    told = {str(error) for error in errors if error is not None}
    assert "this RewardClient was closed during the call" in told
    assert isinstance(ClientClosedError(), RewardError)


def test_closing_an_async_client_ends_the_calls_of_other_tasks(served: Served, protocol: str) -> None:
    async def outcomes() -> list[object]:
        client = AsyncRewardClient(served.url(protocol), model=MODEL, max_in_flight=2)
        asked = [asyncio.create_task(client.score(sample)) for sample in plug()]
        assert await client.is_ready()
        cancelled = asked.pop()
        if sys.version_info >= (3, 11):  # older versions do not tell who cancelled it
            cancelled.cancel()
        await client.close()
        if sys.version_info >= (3, 11):
            with pytest.raises(asyncio.CancelledError):
                await cancelled
        return list(await asyncio.gather(*asked, return_exceptions=True))

    told = [outcome for outcome in asyncio.run(outcomes()) if isinstance(outcome, BaseException)]
    assert {type(error) for error in told} == {ClientClosedError}
    assert any("this client was closed during the call" in str(error) for error in told)


FORKING = """
import os
import numpy as np
from rfm_client import RewardClient, Trajectory
trajectory = Trajectory(video_embeddings=np.ones((1, 2)), text_embedding=np.ones(2))
client = RewardClient("grpc://127.0.0.1:1")
assert not client.is_ready()
if os.fork() == 0:
    for ask in (lambda: client.progress(trajectory), lambda: RewardClient("grpc://127.0.0.1:1").is_ready()):
        try:
            ask()
        except RuntimeError as error:
            print(error, flush=True)
    os._exit(0)
os.wait()
"""


def test_a_fork_is_told_to_make_its_own_client_and_that_grpc_was_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRPC_ENABLE_FORK_SUPPORT", "0")  # gRPC's handlers may crash a fork
    done = subprocess.run([sys.executable, "-c", FORKING], capture_output=True, text=True, timeout=60)
    inherited, used = done.stdout.splitlines()
    assert "which forked this one: make one in each process" in inherited
    assert re.search("gRPC was used in process [0-9]+, which forked this one: .* by spawn or forkserver", used)


NOBODY = "grpc://127.0.0.1:1"  # a port where nothing listens
HOLDERS: dict[str, Callable[[RewardClient], Any]] = {
    "RewardClient": lambda client: client,
    "AsyncRewardClient": lambda client: AsyncRewardClient(NOBODY),
    "Episode": lambda client: client.episode("lift"),
    "Episodes": lambda client: client.episodes(2, "lift"),
    "AsyncEpisode": lambda client: AsyncRewardClient(NOBODY).episode("lift"),
    "RewardModelWrapper": lambda client: RewardModelWrapper(
        gymnasium.make("CartPole-v1", render_mode="rgb_array"), client, "lift"
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


def test_an_async_client_in_a_second_event_loop_says_so(served: Served) -> None:
    client = AsyncRewardClient(served.url("grpc"), model=MODEL)
    with closing(asyncio.new_event_loop()) as first, closing(asyncio.new_event_loop()) as second:
        assert first.run_until_complete(client.is_ready())
        with pytest.raises(RuntimeError, match=r"that it was first used in, .*: make one in each loop"):
            second.run_until_complete(client.progress(random_trajectory(0, 2)))
        first.run_until_complete(client.close())


def test_a_call_in_a_future_s_callback_is_refused_rather_than_waiting_for_itself(served: Served) -> None:
    told: SimpleQueue[str] = SimpleQueue()
    with served.client("grpc") as client:

        def ask(_done: Future[ProgressResult]) -> None:
            try:
                client.is_ready()
            except RuntimeError as error:
                told.put(str(error))
            else:
                told.put("answered")  # the result came first, so that this ran in the test's own thread

        for _ in range(100):
            client.submit(ProgressSample(random_trajectory(0, 2))).add_done_callback(ask)
            if (text := told.get(timeout=30)) != "answered":
                break
        assert "use submit" in text


def test_a_future_keeps_its_client_and_its_arrays(served: Served) -> None:
    trajectory = random_trajectory(0, 8)
    with served.client("grpc") as client:
        expected = client.progress(trajectory)
        future = client.submit(ProgressSample(trajectory))
        trajectory.positions[:] = 0
        assert_same(future.result(), expected)
    assert served.client("grpc").submit(ProgressSample(random_trajectory(0, 2))).result().last_progress > 0


def test_a_client_that_is_not_closed_does_not_keep_the_interpreter(served: Served) -> None:
    code = f"""
from rfm_client import RewardClient
assert RewardClient({served.url("grpc")!r}, model={MODEL!r}).is_ready()
client = RewardClient({served.url("http")!r}, model={MODEL!r})
client.wait_ready(60)  # in a worker thread, too
"""
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("url", ["localhost:8001", "grpc://localhost", "grpc://", "", "ftp://b:2", "grpc://a:70000"])
def test_a_wrong_url_is_refused_when_the_client_is_made(url: str) -> None:
    with pytest.raises(ValueError, match="url") as raised:
        RewardClient(["grpc://a:1", url])
    forms = "grpc://host:port or http://host:port, or grpcs:// or https://"
    assert str(raised.value) == f"url: expected {forms}, got {url!r}"


def test_a_client_needs_a_url_which_may_be_written_as_grpc_does() -> None:
    RewardClient("dns:///rfm-triton-pods:8001").close()
    with pytest.raises(ValueError, match="url: expected at least one, got none"):
        RewardClient([])


def test_a_deadline_must_be_within_reach() -> None:
    wanted = r"^timeout_s: expected a number of seconds above 0 and at most 1e\+09, got "
    with RewardClient(NOBODY) as client:
        calls: list[Callable[[float], object]] = [
            lambda timeout_s: RewardClient(NOBODY, timeout_s=timeout_s),
            lambda timeout_s: client.progress(random_trajectory(0, 1), timeout_s=timeout_s),
            lambda timeout_s: client.model_info(timeout_s=timeout_s),
            client.wait_ready,
        ]
        for call, timeout_s in itertools.product(calls, [float("inf"), 0, -1, 2e9]):
            with pytest.raises(ValueError, match=wanted):
                call(timeout_s)


def test_an_unknown_option_is_refused() -> None:
    options: dict[str, Any] = {"sub_sample": True}
    with RewardClient(NOBODY) as client, pytest.raises(TypeError, match="sub_sample"):
        client.progress(random_trajectory(0, 1), **options)
    with pytest.raises(TypeError, match="sub_sample"):
        RewardClient(NOBODY, **options)


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


@pytest.mark.nightly
def test_a_user_s_file_type_checks_against_the_installed_wheel(tmp_path: Path) -> None:
    copied, wheels, environment, user_file = (
        tmp_path / name for name in ("client", "wheels", "environment", "user.py")
    )
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    shutil.copytree(ROOT / "client", copied, ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__"))
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", wheels, copied], check=True)
    venv.create(environment, with_pip=False)
    installed = next(environment.glob("lib/python*/site-packages"))
    subprocess.run([*pip, "install", "--no-deps", "--target", installed, *wheels.glob("*.whl")], check=True)
    (installed / "dependencies.pth").write_text(sysconfig.get_path("purelib"))

    def check(text: str) -> subprocess.CompletedProcess[str]:
        user_file.write_text(text)
        options = ["--strict", "--config-file=", f"--python-executable={environment}/bin/python"]
        command = [sys.executable, "-m", "mypy", *options, user_file]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)

    good, bad = check(USER_FILE), check(USER_FILE + "\n\n" + "\n".join(WRONG_USES))
    assert good.returncode == 0, good.stdout
    for name in WRONG_USES.values():
        assert f'"{name}"' in bad.stdout
