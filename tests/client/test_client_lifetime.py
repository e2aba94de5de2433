# SPDX-License-Identifier: MIT
"""Clients that are closed, forked, or used from callbacks, and arguments that the constructor refuses."""

from __future__ import annotations

import asyncio
import copy
import pickle
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from queue import SimpleQueue
from typing import Any

import cloudpickle
import gymnasium
import numpy as np
import pytest

from engine_server import EngineServer
from mixtures import assert_same
from rfm_client import (
    AsyncRewardClient,
    ClientClosedError,
    DeadlineExceededError,
    ModelInfo,
    ProgressResult,
    ProgressSample,
    RewardClient,
)
from rfm_client.episodes import Episode
from rfm_rl import RewardModelWrapper
from shelves import Shelf
from trajectories import random_trajectory
from transports import Answer, Tensors


def test_a_closed_client_says_so() -> None:
    client = RewardClient(NOBODY)
    client.close()
    client.close()
    with pytest.raises(ClientClosedError, match="is closed"):
        client.progress(random_trajectory(0, 2))

    async def ask() -> None:
        async with AsyncRewardClient(NOBODY) as client:
            pass
        await client.progress(random_trajectory(0, 2))

    with pytest.raises(ClientClosedError, match="this AsyncRewardClient is closed"):
        asyncio.run(ask())


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


def test_the_error_in_a_fork_asks_for_its_own_client_and_mentions_used_grpc(monkeypatch: pytest.MonkeyPatch) -> None:
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
    "RewardModelWrapper": lambda client: RewardModelWrapper(
        gymnasium.make("CartPole-v1", render_mode="rgb_array"), client, "lift"
    ),
}


@pytest.mark.parametrize("name", HOLDERS)
def test_pickling_an_object_with_a_client_fails_and_suggests_a_partial_instead(name: str) -> None:
    told = r"pass functools\.partial\(RewardClient, url\) instead, and call that in each"
    with RewardClient(NOBODY) as client:
        holder = HOLDERS[name](client)
        for dumps in (pickle.dumps, cloudpickle.dumps, copy.deepcopy):
            with pytest.raises(TypeError, match=told):
                dumps(holder)
    assert pickle.loads(pickle.dumps(partial(RewardClient, NOBODY))).args == (NOBODY,)


def test_an_async_client_in_a_second_event_loop_says_so() -> None:
    client = AsyncRewardClient("", transports=[Shelf()])
    with closing(asyncio.new_event_loop()) as first, closing(asyncio.new_event_loop()) as second:
        assert first.run_until_complete(client.is_ready())
        with pytest.raises(RuntimeError, match=r"that it was first used in, .*: make one in each loop"):
            second.run_until_complete(client.progress(random_trajectory(0, 2)))
        first.run_until_complete(client.close())


def test_a_call_in_a_future_s_callback_is_refused_rather_than_waiting_for_itself() -> None:
    told: SimpleQueue[str] = SimpleQueue()
    with RewardClient("", transports=[Shelf()]) as client:

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


FRAME = np.ones((4, 4, 3), np.uint8)


@dataclass
class Slow(Shelf):
    """A server that takes its time to describe a model, and more to score frames than embeddings."""

    describes_s: float = 0.0
    scores_s: float = 0.4
    is_asked: threading.Event = field(default_factory=threading.Event)

    async def infer(self, model: str, inputs: Tensors, outputs: Any, timeout_s: float, **more: str) -> Answer:
        if model == "rfm_frames":
            self.is_asked.set()
        await pause(self.scores_s if model == "rfm_frames" else 0.1, timeout_s)
        return await super().infer(model, inputs, outputs, timeout_s, **more)

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        await pause(self.describes_s, timeout_s)
        return await super().model_info(model, timeout_s)


async def pause(seconds: float, timeout_s: float) -> None:
    await asyncio.sleep(min(seconds, timeout_s))
    if timeout_s < seconds:
        raise DeadlineExceededError("too slow")


CALLS: dict[str, Callable[[Episode], object]] = {"reset": Episode.reset, "add": lambda episode: episode.add(FRAME)}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_a_future_s_callback_does_not_wait_for_an_open_step(call: Callable[[Episode], object]) -> None:
    told: SimpleQueue[str] = SimpleQueue()
    with RewardClient("", transports=[shelf := Slow()]) as client, ThreadPoolExecutor() as threads:
        episode = client.episode("lift")

        def ask(_done: Future[ProgressResult]) -> None:
            try:
                call(episode)
            except RuntimeError as error:
                told.put(str(error))

        step = threads.submit(episode.add, FRAME)
        assert shelf.is_asked.wait(30)
        client.submit(ProgressSample(random_trajectory(0, 2))).add_done_callback(ask)
        assert "got one from a callback of a future" in told.get(timeout=30)
        assert step.result().step == 0


def test_a_reset_waits_for_the_open_step() -> None:
    with RewardClient("", transports=[shelf := Slow()]) as client, ThreadPoolExecutor() as threads:
        episode = client.episode("lift")
        step = threads.submit(episode.add, FRAME)
        assert shelf.is_asked.wait(30)
        episode.reset()
        assert step.result(timeout=0.2).step == 0
        assert episode.step == -1
        assert episode.add(FRAME).step == 0


def test_one_time_limit_holds_for_a_whole_step() -> None:
    """For the wait for an open step, the description of the model, and the scores."""
    with RewardClient("", transports=[shelf := Slow(describes_s=0.3)]) as client, ThreadPoolExecutor() as threads:
        episode = client.episode("lift", resize=True, timeout_s=0.5)

        def took_s() -> float:
            began_s = time.monotonic()
            with pytest.raises(DeadlineExceededError, match=r"no answer within 0\.5 s"):
                episode.add(FRAME)
            return time.monotonic() - began_s

        first = threads.submit(took_s)  # 0.3 s for the description, 0.2 s for the scores
        assert shelf.is_asked.wait(30)
        assert max(took_s(), first.result()) < 0.65


def test_a_future_keeps_its_client_and_its_arrays(engines: EngineServer) -> None:
    trajectory = random_trajectory(0, 8)
    with engines.client() as client:
        expected = client.progress(trajectory)
        future = client.submit(ProgressSample(trajectory))
        trajectory.positions[:] = 0
        assert_same(future.result(), expected)
    assert engines.client().submit(ProgressSample(random_trajectory(0, 2))).result().last_progress > 0


def test_a_client_that_is_not_closed_does_not_keep_the_interpreter(engines: EngineServer) -> None:
    code = f"""
from rfm_client import RewardClient
client = RewardClient({engines.url!r}, model="c1_t1_disc10")
client.wait_ready(60)  # in a worker thread, too
assert not RewardClient("http://127.0.0.1:1").is_ready()
"""
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


WRONG_URLS = (
    *("localhost:8001", "grpc://localhost", "", "ftp://b:2", "grpc://a:70000", "dns:///a:8001"),
    *("grpc://::1:8001", "http://2001:db8::7:8000", "grpc://::1"),
)


def test_a_client_needs_a_right_url() -> None:
    with pytest.raises(ValueError, match="url: expected at least one, got none"):
        RewardClient([])
    for url in WRONG_URLS:
        expected = r"grpc://host:port or .* \(brackets around an IPv6 address\)"
        with pytest.raises(ValueError, match=rf"^url: expected {expected}, got {re.escape(repr(url))}$"):
            RewardClient(["grpc://a:1", url])


def test_a_deadline_must_be_within_reach() -> None:
    wanted = r"^timeout_s: expected a number of seconds above 0 and at most 1e\+09, got "
    with RewardClient(NOBODY) as client:
        for timeout_s in (float("inf"), 0, -1, 2e9):
            with pytest.raises(ValueError, match=wanted):
                client.progress(random_trajectory(0, 1), timeout_s=timeout_s)
            with pytest.raises(ValueError, match=wanted):
                client.wait_ready(timeout_s)


def test_the_client_imports_no_heavy_package() -> None:
    code = """
import sys
import rfm_client
print(*{"asyncio", "tritonclient"} & set(sys.modules))  # which a server's import of the contract does not need
for name in rfm_client.__all__:
    getattr(rfm_client, name)
heavy = {"torch", "pandas", "av", "PIL", "gymnasium", "typer", "rich", "matplotlib", "grpc", "gevent", "aiohttp"}
print(*sorted(heavy & set(sys.modules)))
"""
    heavy = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    assert heavy == []
