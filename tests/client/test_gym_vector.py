# SPDX-License-Identifier: MIT
"""Rewards for vectors of environments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from environments import (
    MODEL,
    TASK,
    TOLERANCE,
    Camera,
    LateClient,
    assert_close,
    cart_pole,
    cart_pole_with_pixels,
    progress,
    two_cameras,
)
from reference_server import Served
from rfm_client import (
    InvalidSampleError,
    RewardClient,
)
from rfm_client.gym import RewardModelVectorWrapper, RewardModelWrapper, RewardOptions, SuccessRule


def vector_env(env_fns: Sequence[Callable[[], gym.Env[Any, Any]]], mode: AutoresetMode) -> SyncVectorEnv:
    return SyncVectorEnv(env_fns, autoreset_mode=mode)


Steps = list[tuple[Any, ...]]


def roll(env: Any, mode: AutoresetMode, steps: int = 24) -> Steps:
    """What each step gives, and each reset; both poles fall twice, not at the same time. The first is reset in any mode."""
    told: Steps = [env.reset(seed=[0, 1])]
    num_ended = 0
    for _ in range(steps):
        told.append(env.step(np.array([0, 1])))
        ended = told[-1][2] | told[-1][3]
        if ended.any() and (mode is AutoresetMode.DISABLED or not num_ended):
            told.append(env.reset(seed=[3, 4], options={"reset_mask": ended}))
        num_ended += ended.sum()
    assert num_ended >= 4
    return told


def assert_same_steps(left: Any, right: Any, where: str = "") -> None:
    """Also of infos, masks included; where the mask says there is nothing, nothing is compared."""
    if isinstance(left, dict):
        assert left.keys() == right.keys(), where
        for key in left:
            assert_same_steps(left[key], right[key], f"{where}.{key}")
    elif isinstance(left, tuple | list):
        assert len(left) == len(right), where
        for index, (a, b) in enumerate(zip(left, right, strict=True)):
            assert_same_steps(a, b, f"{where}[{index}]")
    elif isinstance(left, np.ndarray) and left.dtype == object:
        assert_same_steps(left.tolist(), right.tolist(), where)
    elif left is None:
        assert right is None, where
    else:
        np.testing.assert_allclose(left, right, rtol=0, atol=TOLERANCE, err_msg=where)
        assert np.asarray(left).dtype == np.asarray(right).dtype, where


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
    left, right = roll(vector, mode), roll(vector_env(singles, mode), mode)
    assert_same_steps(left, right)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED], ids=lambda mode: mode.name)
def test_late_rewards_of_a_vector_s_rendered_frames_add_up(client: RewardClient, mode: AutoresetMode) -> None:
    cameras = [Camera(cart_pole()), Camera(cart_pole())]
    envs = vector_env([lambda: cameras[0], lambda: cameras[1]], mode)
    options = RewardOptions(mode="delta", blocking=False)
    env = RewardModelVectorWrapper(envs, client, TASK, options)
    paid: list[list[float]] = [[], []]
    told = roll(env, mode)
    for step in told:
        if len(step) == 5:
            for index in range(2):
                if step[4]["reward_model"]["_env_reward"][index]:
                    paid[index].append(step[1][index])
                else:
                    assert step[1][index] == 0
    for index, camera in enumerate(cameras):
        lengths = [len(film) - 1 for film in camera.films]
        ends = np.cumsum(lengths)
        for film, end, length in zip(camera.films[:-1], ends, lengths, strict=False):
            first, last = progress(client, film, [0, length])
            assert_close(sum(paid[index][end - length : end]), last - first)
    env.close()


def test_a_reset_of_a_vector_takes_back_what_is_open_about_what_it_resets(late: LateClient) -> None:
    envs = vector_env([cart_pole] * 2, AutoresetMode.DISABLED)
    env = RewardModelVectorWrapper(
        envs, late, [TASK, "let the pole fall"], RewardOptions(sampling="all", blocking=False)
    )
    env.reset(seed=0)
    late.hold(1)
    env.step(np.array([0, 1]))
    env.reset(seed=0, options={"reset_mask": np.array([False, True])})
    assert [answer.cancelled() for answer in late.submitted] == [False, True]
    env.close()
    assert [answer.cancelled() for answer in late.submitted] == [True, True]


def test_the_questions_of_a_step_go_in_one_request(late: LateClient) -> None:
    env = RewardModelVectorWrapper(
        vector_env([cart_pole] * 3, AutoresetMode.NEXT_STEP), late, TASK, RewardOptions(sampling="all")
    )
    env.reset(seed=0)
    env.step(np.array([0, 1, 0]))
    assert late.connection.lengths == [1, 2]


def test_success_ends_an_episode_of_a_vector_that_the_caller_resets(client: RewardClient) -> None:
    envs = vector_env([cart_pole] * 2, AutoresetMode.DISABLED)
    options = RewardOptions(every=2, terminate_on_success=SuccessRule(threshold=0.0))
    env = RewardModelVectorWrapper(envs, client, TASK, options)
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


REFUSED_VECTORS: dict[str, tuple[AutoresetMode, Any, dict[str, Any], str]] = {
    "tasks": (AutoresetMode.DISABLED, [TASK] * 3, {}, "^task: expected one for each of the 2 environments, got 3$"),
    "rendered, SAME_STEP": (
        AutoresetMode.SAME_STEP,
        TASK,
        {},
        r"^autoreset_mode: expected NEXT_STEP or DISABLED with frames from render\(\), .* got SAME_STEP; wrap each",
    ),
    "success, NEXT_STEP": (
        AutoresetMode.NEXT_STEP,
        TASK,
        {"terminate_on_success": SuccessRule()},
        "^autoreset_mode: expected DISABLED with terminate_on_success, got NEXT_STEP; wrap each environment",
    ),
}


@pytest.mark.parametrize(("mode", "task", "options", "message"), REFUSED_VECTORS.values(), ids=REFUSED_VECTORS)
def test_what_cannot_be_right_in_a_vector_is_refused(
    client: RewardClient, mode: AutoresetMode, task: Any, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        RewardModelVectorWrapper(vector_env([cart_pole] * 2, mode), client, task, RewardOptions(**options))


def test_an_error_tells_which_environment_of_the_vector_it_is_about(client: RewardClient) -> None:
    env = RewardModelVectorWrapper(vector_env([cart_pole] * 2, AutoresetMode.DISABLED), client, [TASK, "lift " * 50])
    with pytest.raises(InvalidSampleError, match=r"^envs\[1\]\.task: expected at most 32 tokens"):
        env.reset()


def test_wrapped_environments_work_in_processes_of_their_own(served: Served, client: RewardClient) -> None:
    connect = partial(RewardClient, served.url("grpc"), model=MODEL)
    options = RewardOptions(max_frames=4)

    def env_fn() -> gym.Env[Any, Any]:
        env = gym.make("CartPole-v1", render_mode="rgb_array")
        return RewardModelWrapper(env, connect, "balance the pole", options)

    env = AsyncVectorEnv([env_fn] * 2, context="spawn")
    env.reset(seed=[5, 6])
    frames = [[frame] for frame in env.render()]
    for _ in range(2):
        rewards = env.step(np.array([0, 1]))[1]
        for film, frame in zip(frames, env.render(), strict=True):
            film.append(frame)
    env.close()
    assert_close(rewards, [progress(client, film, [2], max_frames=4)[0] for film in frames])
