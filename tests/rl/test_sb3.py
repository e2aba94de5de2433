# SPDX-License-Identifier: MIT
"""Rewards for the vectors of Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

from coded_env import Code, CodedEnv, Recorder
from environments import TASK, cart_pole, cart_pole_with_pixels
from rfm_client import InvalidSampleError, RewardClient, ServerUnavailableError, UInt8Array
from rfm_rl import RewardModelWrapper, RewardOptions, SuccessRule
from servers import Served

pytest.importorskip("stable_baselines3", reason="the extra sb3 is not installed")

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from rfm_rl.sb3 import RenderedFrame, RewardModelVecEnv

LENGTHS = (3,), (4, 1, 2)  # steps of the episodes by environment, in turn
TASKS = ["task 0", "task 1"]
ACTIONS = np.zeros(2, int)
# By environment: episode and step of each call, first the reset. The end of an episode is a reset.
ASKED = (
    "0.0 0.1 0.2 0.3+1.0 1.1 1.2 1.3+2.0 2.1 2.2 2.3+3.0",
    "0.0 0.1 0.2 0.3 0.4+1.0 1.1+2.0 2.1 2.2+3.0 3.1 3.2",
)


@pytest.fixture
def recorder() -> Iterator[Recorder]:
    with Recorder() as client:
        yield client


def coded(kind: Any = DummyVecEnv, *, rendered: bool = True, reuse: bool = False) -> Any:
    def make(number: int) -> gym.Env[Any, Any]:
        env = CodedEnv(number, LENGTHS[number], reuse=reuse)
        return RenderedFrame(env) if rendered else env

    return kind(
        [partial(make, number) for number in range(2)], **({"start_method": "spawn"} if kind is SubprocVecEnv else {})
    )


def up_to(number: int, episode: int, step: int) -> tuple[list[Code], str]:
    """Return the question about a step: all frames of the episode so far, and the task."""
    return [(number, episode, each) for each in range(step + 1)], TASKS[number]


def options(source: Any = None, **more: Any) -> RewardOptions:
    return RewardOptions(sampling="all", frames_from=source, **more)


VECTORS: dict[str, tuple[Any, Any, bool]] = {
    "rendered": (DummyVecEnv, None, False),
    "rendered into one array": (DummyVecEnv, None, True),
    "a key": (DummyVecEnv, "pixels", False),
    "a function": (DummyVecEnv, lambda observation: observation["pixels"], False),
    "processes": (SubprocVecEnv, None, True),
}


@pytest.mark.parametrize(("kind", "source", "reuse"), VECTORS.values(), ids=VECTORS)
def test_a_step_asks_once_about_each_episode_s_own_frames(
    recorder: Recorder, kind: Any, source: Any, reuse: bool
) -> None:
    venv = coded(kind, rendered=source is None, reuse=reuse)
    venv = VecMonitor(venv) if kind is DummyVecEnv else venv
    with closing(RewardModelVecEnv(venv, recorder, TASKS, options(source))) as env:
        env.reset()
        ends = []
        for _ in range(9):
            _, rewards, dones, infos = env.step(ACTIONS)
            assert (rewards.dtype, rewards.shape) == (np.float32, (2,))
            assert [info["reward_model"]["env_reward"] for info in infos] == [1.0, 1.0]
            assert not [key for info in infos for key in info if "frame" in key]
            ends.append(dones.tolist())
            for number in np.flatnonzero(dones).tolist():
                assert env.reset_infos[number]["reward_model"]["step"] == 0
                assert infos[number]["reward_model"]["step"] in LENGTHS[number]
    asked = list(zip(*map(str.split, ASKED), strict=True))
    expected = [
        [up_to(number, *map(int, code.split("."))) for number, each in enumerate(call) for code in each.split("+")]
        for call in asked
    ]
    assert [sorted(call) for call in recorder.calls] == expected
    assert ends == [["+" in each for each in call] for call in asked[1:]]


@pytest.mark.triton
@pytest.mark.parametrize("mode", ["absolute", "delta"])
def test_a_vector_is_paid_as_its_environments_would_be(client: RewardClient, mode: Any) -> None:
    rewarded = RewardOptions(mode=mode, every=2, frames_from="pixels")
    singles = DummyVecEnv([lambda: RewardModelWrapper(cart_pole_with_pixels(), client, TASK, rewarded)] * 2)
    vector = RewardModelVecEnv(DummyVecEnv([cart_pole_with_pixels] * 2), client, TASK, rewarded)
    told = []
    for env in (vector, singles):
        env.seed(0)
        env.reset()
        steps = [env.step(np.array([0, 1])) for _ in range(24)]
        assert sum(step[2].sum() for step in steps) >= 4
        told.append([(step[1], [info["reward_model"]["progress"] for info in step[3]]) for step in steps])
    for left, right in zip(*told, strict=True):
        np.testing.assert_allclose(left[0], right[0], atol=1e-5)
        np.testing.assert_allclose(left[1], right[1], atol=1e-5)


@pytest.mark.triton
def test_ppo_learns_500_steps_with_its_reward(served: Served, client: RewardClient) -> None:
    venv = make_vec_env(cart_pole, 4, wrapper_class=RenderedFrame)
    with closing(RewardModelVecEnv(venv, client, TASK, RewardOptions(mode="delta", max_frames=4))) as env:
        model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=1, device="cpu").learn(500)
        assert model.num_timesteps >= 500
        assert np.isfinite(model.rollout_buffer.rewards).all()
        assert np.ptp(model.rollout_buffer.rewards) > 0


def test_a_failure_of_the_server_keeps_the_frame_and_one_of_a_frame_needs_a_reset() -> None:
    with Recorder(failing=2) as client, closing(RewardModelVecEnv(coded(), client, TASKS, options())) as env:
        with pytest.raises(ResetNeeded, match=r"^step: expected a reset before it$"):
            env.step(ACTIONS)
        env.reset()
        env.step(ACTIONS)
        with pytest.raises(ServerUnavailableError):
            env.step(ACTIONS)
        env.step(ACTIONS)
        assert sorted(client.calls[-1])[0] == up_to(0, 0, 3)
    venv = DummyVecEnv([lambda: RenderedFrame(CodedEnv(bad=(0, 0, 1)))])
    with Recorder() as client, closing(RewardModelVecEnv(venv, client, TASKS[0], options())) as env:
        env.reset()
        with pytest.raises(InvalidSampleError, match=r"^envs\[0\]\.frame: expected uint8 \[H, W, 3\]"):
            env.step(ACTIONS[:1])
        with pytest.raises(ResetNeeded, match="since an earlier call failed before its frame was kept"):
            env.step(ACTIONS[:1])
        env.reset()
        env.step(ACTIONS[:1])


def test_a_reset_that_draws_over_the_last_frame_is_refused(recorder: Recorder) -> None:
    venv = DummyVecEnv([lambda: CodedEnv(reuse=True)])
    with closing(RewardModelVecEnv(venv, recorder, TASKS[0], options("pixels"))) as env:
        env.reset()
        for _ in range(2):
            env.step(ACTIONS[:1])
        with pytest.raises(
            InvalidSampleError, match=r"terminal_observation'\]: expected the last frame .*RenderedFrame$"
        ):
            env.step(ACTIONS[:1])


REFUSED: dict[str, tuple[Any, Any, RewardOptions, type[Exception], str]] = {
    "no VecEnv": (
        CodedEnv,
        TASKS,
        options(),
        TypeError,
        "venv: expected a VecEnv of stable_baselines3, got .*CodedEnv",
    ),
    "no pictures": (
        lambda: coded(rendered=False),
        TASKS,
        options(),
        ValueError,
        r"venv: expected each environment in RenderedFrame, .* got none: make_vec_env\(..., wrapper_class=RenderedFrame",
    ),
    "an unknown key": (coded, TASKS, options("camera"), ValueError, "frames_from: expected a key of the observation"),
    "an end at a success": (
        coded,
        TASKS,
        options(terminate_on_success=SuccessRule()),
        ValueError,
        "terminate_on_success: expected None, .*wrap each environment in RewardModelWrapper",
    ),
    "tasks of others": (
        coded,
        TASKS[:1],
        options(),
        ValueError,
        "task: expected one for each of the 2 environments, got 1",
    ),
}


@pytest.mark.parametrize(("make", "task", "asked", "error", "message"), REFUSED.values(), ids=REFUSED)
def test_a_vector_that_cannot_be_paid_is_refused(
    recorder: Recorder, make: Any, task: Any, asked: RewardOptions, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        RewardModelVecEnv(make(), recorder, task, asked)


@pytest.mark.triton
def test_steps_that_do_not_wait_end_with_the_score_of_the_last_frame(client: RewardClient) -> None:
    rewarded = RewardOptions(frames_from="pixels", blocking=False, mode="delta")
    with closing(RewardModelVecEnv(DummyVecEnv([cart_pole_with_pixels] * 2), client, TASK, rewarded)) as env:
        env.seed(0)
        env.reset()
        first = [info["reward_model"]["progress"] for info in env.reset_infos]
        returns, num_ended = np.zeros(2), 0
        while num_ended < 2:
            _, rewards, dones, infos = env.step(np.array([0, 1]))
            returns += rewards
            for number in np.flatnonzero(dones).tolist():
                last = infos[number]["reward_model"]
                assert last["lag"] == 0
                assert returns[number] == pytest.approx(last["progress"] - first[number], abs=1e-5)
                first[number] = env.reset_infos[number]["reward_model"]["progress"]
                returns[number], num_ended = 0.0, num_ended + 1


class Dim(CodedEnv):
    """The pictures are floats in 0..1 that became uint8."""

    def _drawn(self) -> UInt8Array:
        return np.random.default_rng(self.t).integers(0, 2, (32, 32, 3), np.uint8)


def test_the_environment_whose_pictures_show_nothing_is_told(caplog: pytest.LogCaptureFixture) -> None:
    venv = DummyVecEnv([partial(CodedEnv, 0, (20,)), partial(Dim, 1, (20,))])
    options = RewardOptions(sampling="all", frames_from="pixels")
    with Recorder() as client, closing(RewardModelVecEnv(venv, client, TASK, options)) as env:
        env.reset()
        for _ in range(12):
            env.step(ACTIONS)
    told = "envs[1]: frame: expected pictures that show something, got black pictures, no value above 1"
    assert [record.message.startswith(told) for record in caplog.records] == [True]
