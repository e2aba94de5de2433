# SPDX-License-Identifier: MIT
"""Rewards for vectors of environments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from environments import MODEL, TASK, LateClient, assert_close, cart_pole, cart_pole_with_pixels, progress, two_cameras
from rfm_client import InvalidSampleError, RewardClient
from rfm_rl import RewardModelVectorWrapper, RewardModelWrapper, RewardOptions, SuccessRule
from servers import Served
from tolerances import TOLERANCE

NEXT_STEP, SAME_STEP, DISABLED = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED


def vector_env(env_fns: Sequence[Callable[[], gym.Env[Any, Any]]], mode: AutoresetMode) -> SyncVectorEnv:
    return SyncVectorEnv(env_fns, autoreset_mode=mode)


def roll(env: Any, mode: AutoresetMode, steps: int = 24) -> list[tuple[Any, ...]]:
    """Yield the results of each step and reset. Both poles fall twice, at different times."""
    told: list[tuple[Any, ...]] = [env.reset(seed=[0, 1])]
    num_ended = 0
    for _ in range(steps):
        told.append(env.step(np.array([0, 1])))
        ended = told[-1][2] | told[-1][3]
        if ended.any() and (mode is DISABLED or not num_ended):
            told.append(env.reset(seed=[3, 4], options={"reset_mask": ended}))
        num_ended += ended.sum()
    assert num_ended >= 4
    return told


def arrays(told: Any, where: str = "") -> dict[str, np.ndarray]:
    """Return all arrays of step results by path: observations, rewards, infos with masks."""
    if told is None:
        return {}
    if isinstance(told, dict):
        parts = list(told.items())
    elif isinstance(told, tuple | list) or (isinstance(told, np.ndarray) and told.dtype == object):
        parts = list(enumerate(told))
    else:
        return {where: np.asarray(told)}
    return {place: array for key, part in parts for place, array in arrays(part, f"{where}.{key}").items()}


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.name)
@pytest.mark.parametrize(
    ("reward_mode", "cameras"), [("absolute", ("front", "wrist")), ("delta", ())], ids=["two cameras", "one camera"]
)
def test_a_vector_is_paid_as_its_environments_would_be(
    client: RewardClient, mode: AutoresetMode, reward_mode: Any, cameras: tuple[str, ...]
) -> None:
    source: Any = two_cameras if cameras else "pixels"
    options = RewardOptions(mode=reward_mode, every=2, frames_from=source, cameras=cameras, fuse="min")
    tasks = [TASK, "let the pole fall"]
    singles = [
        partial(lambda task: RewardModelWrapper(cart_pole_with_pixels(), client, task, options), task) for task in tasks
    ]
    vector = RewardModelVectorWrapper(vector_env([cart_pole_with_pixels] * 2, mode), client, tasks, options)
    left, right = arrays(roll(vector, mode)), arrays(roll(vector_env(singles, mode), mode))
    torch.testing.assert_close(left, right, rtol=0, atol=TOLERANCE)


def test_a_reset_of_a_vector_takes_back_what_is_open_about_what_it_resets(late: LateClient) -> None:
    tasks, options = [TASK, "let the pole fall"], RewardOptions(sampling="all", blocking=False)
    env = RewardModelVectorWrapper(vector_env([cart_pole] * 2, DISABLED), late, tasks, options)
    env.reset(seed=0)
    late.hold(1)
    env.step(np.array([0, 1]))
    env.reset(seed=0, options={"reset_mask": np.array([False, True])})
    assert [answer.cancelled() for answer in late.submitted] == [False, True]
    env.close()
    assert [answer.cancelled() for answer in late.submitted] == [True, True]


def test_success_ends_an_episode_of_a_vector_that_the_caller_resets(client: RewardClient) -> None:
    options = RewardOptions(every=2, terminate_on_success=SuccessRule(threshold=0.0))
    env = RewardModelVectorWrapper(vector_env([cart_pole] * 2, DISABLED), client, TASK, options)
    env.reset(seed=0)
    actions = np.array([0, 1])
    assert [env.step(actions)[2].tolist() for _ in range(2)] == [[False, False], [True, True]]
    infos = env.reset(options={"reset_mask": np.array([True, False])})[1]
    assert infos["reward_model"]["_progress"].tolist() == [True, False]
    with pytest.raises(gym.error.ResetNeeded, match=r"^step: expected a reset of the environments \[1\], since their"):
        env.step(actions)
    env.reset(options={"reset_mask": np.array([False, True])})
    assert env.step(actions)[2].tolist() == [False, False]
    told = env.step(actions)
    assert told[2].tolist() == [True, True]
    assert told[4]["reward_model"]["step"].tolist() == [2, 2]


def test_a_mask_of_a_reset_may_be_a_list(client: RewardClient) -> None:
    env = RewardModelVectorWrapper(vector_env([cart_pole] * 2, DISABLED), client, TASK)
    env.reset(seed=0)
    given = {"reset_mask": [True, False]}
    infos = env.reset(options=given)[1]
    assert infos["reward_model"]["_progress"].tolist() == [True, False]
    assert given == {"reset_mask": [True, False]}
    with pytest.raises(ValueError, match=r"^reset_mask: expected bool \[2\], got int64 \[1\]$"):
        env.reset(options={"reset_mask": [0]})


REFUSED_VECTORS: dict[str, tuple[AutoresetMode, Any, dict[str, Any], str]] = {
    "tasks": (DISABLED, [TASK] * 3, {}, "^task: expected one for each of the 2 environments, got 3$"),
    "rendered, SAME_STEP": (
        SAME_STEP,
        TASK,
        {},
        r"^autoreset_mode: expected NEXT_STEP or DISABLED with frames from render\(\), .* got SAME_STEP; wrap each",
    ),
    "success, NEXT_STEP": (
        NEXT_STEP,
        TASK,
        {"terminate_on_success": SuccessRule()},
        "^autoreset_mode: expected DISABLED with terminate_on_success, got NEXT_STEP; wrap each environment",
    ),
}


@pytest.mark.parametrize(("mode", "task", "options", "message"), REFUSED_VECTORS.values(), ids=REFUSED_VECTORS)
def test_what_cannot_be_right_in_a_vector_is_refused(
    mode: AutoresetMode, task: Any, options: dict[str, Any], message: str
) -> None:
    with RewardClient("grpc://127.0.0.1:1") as client, pytest.raises(ValueError, match=message):
        RewardModelVectorWrapper(vector_env([cart_pole] * 2, mode), client, task, RewardOptions(**options))


def test_an_error_tells_which_environment_of_the_vector_it_is_about(client: RewardClient) -> None:
    env = RewardModelVectorWrapper(vector_env([cart_pole] * 2, DISABLED), client, [TASK, "lift " * 50])
    with pytest.raises(InvalidSampleError, match=r"^envs\[1\]\.task: expected at most 32 tokens"):
        env.reset()


def test_wrapped_environments_work_in_processes_of_their_own(served: Served, client: RewardClient) -> None:
    connect = partial(RewardClient, served.url("grpc"), model=MODEL)

    def env_fn() -> gym.Env[Any, Any]:
        env = gym.make("CartPole-v1", render_mode="rgb_array")
        return RewardModelWrapper(env, connect, "balance the pole", RewardOptions(max_frames=4))

    env = AsyncVectorEnv([env_fn] * 2, context="spawn")
    env.reset(seed=[5, 6])
    videos = [[frame] for frame in env.render()]
    for _ in range(2):
        rewards = env.step(np.array([0, 1]))[1]
        for video, frame in zip(videos, env.render(), strict=True):
            video.append(frame)
    env.close()
    assert_close(rewards, [progress(client, video, [2], max_frames=4)[0] for video in videos])
