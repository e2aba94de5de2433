# SPDX-License-Identifier: MIT
"""Environments, and a client whose answers come late."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from rfm_client import ProgressResult, RewardClient, Trajectory, UInt8Array
from rfm_client.episodes import Episode, StepScore
from rfm_client.transport.calls import TritonTransport
from tolerances import TOLERANCE
from transports import Answer, Tensors

MODEL = "enc_c1_t1_disc10"
MAX_FRAMES = 16  # of that checkpoint
TASK = "balance the pole"
PUSH_RIGHT = 1  # the pole falls within ten steps
SIZE = 240, 160  # pixels; fewer would not show the cart

Video = list[UInt8Array]


def cart_pole(**options: Any) -> gym.Env[Any, Any]:
    env = gym.make("CartPole-v1", render_mode="rgb_array", **options)
    env.unwrapped.screen_width, env.unwrapped.screen_height = SIZE  # type: ignore[attr-defined]
    return env


def scores(
    client: RewardClient, video: Video, step: int, max_frames: int | None = MAX_FRAMES, task: str = TASK
) -> ProgressResult:
    """Score the frames up to a step as upstream's RL loop does, cut or padded to ``max_frames``; None: all frames.

    Without the padded slots but the last, which is the newest frame's.
    """
    slots = step + 1 if max_frames is None else max_frames
    count = min(step + 1, slots)
    picked = np.rint(np.linspace(0, step, count)).astype(int)
    padded = [*picked, *[step] * (slots - count)]
    result = client.progress(Trajectory(frames=np.stack([video[index] for index in padded]), task=task))
    shown = [*range(count - 1), slots - 1]
    return replace(result, progress=result.progress[shown], success=result.success[shown])


def progress(
    client: RewardClient, video: Video, steps: Sequence[int], max_frames: int | None = MAX_FRAMES, task: str = TASK
) -> list[float]:
    return [float(scores(client, video, step, max_frames, task).progress[-1]) for step in steps]


def play(env: gym.Env[Any, Any], seed: int = 0) -> tuple[list[float], list[dict[str, Any]]]:
    """Rewards and infos of an episode; the reset's info is the first."""
    info = env.reset(seed=seed)[1]
    rewards, infos = play_on(env)
    return rewards, [info, *infos]


def play_on(env: gym.Env[Any, Any]) -> tuple[list[float], list[dict[str, Any]]]:
    """Rewards and infos from here to the end of the episode."""
    rewards: list[float] = []
    infos: list[dict[str, Any]] = []
    ended = False
    while not ended:
        _, reward, terminated, truncated, info = env.step(PUSH_RIGHT)
        rewards.append(float(reward))
        infos.append(info)
        ended = terminated or truncated
    return rewards, infos


def assert_close(left: Any, right: Any) -> None:
    np.testing.assert_allclose(left, right, rtol=0, atol=TOLERANCE)


class SlowConnection(TritonTransport):
    """A connection to the real server that holds questions by the length of the longest trajectory."""

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.held: dict[int, Future[None]] = {}

    async def infer(self, model: str, inputs: Tensors, outputs: Any, timeout_s: float, **_id: str) -> Answer:
        length = int(inputs["num_frames"].max())
        if length in self.held:
            await asyncio.shield(asyncio.wrap_future(self.held[length]))  # several questions may wait for it
        return await super().infer(model, inputs, outputs, timeout_s)


class LateClient(RewardClient):
    """A client whose answers the test lets come when it wants."""

    def __init__(self, url: str) -> None:
        self.connection = SlowConnection(url)
        super().__init__(url, transports=[self.connection], model=MODEL, retry=False)
        self.submitted: list[Future[list[StepScore]]] = []
        self.answers: dict[int, Future[list[StepScore]]] = {}  # by step

    def hold(self, *steps: int) -> None:
        self.connection.held |= {step + 1: Future() for step in steps}

    def submit_episodes(self, episodes: Sequence[Episode]) -> Future[list[StepScore]]:
        answer = super().submit_episodes(episodes)
        self.submitted.append(answer)
        self.answers |= {episode.step: answer for episode in episodes}
        return answer

    def let_come(self, *steps: int) -> None:
        for step in steps:
            if step + 1 in self.connection.held:
                self.connection.held.pop(step + 1).set_result(None)
            self.answers[step].result()
