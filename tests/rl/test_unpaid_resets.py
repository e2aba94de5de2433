# SPDX-License-Identifier: MIT
"""Early resets, after which the wrappers never pay a reward."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import Autoreset, TimeLimit

from coded_env import CodedEnv, Recorder
from environments import LateClient, cart_pole
from rfm_client import InvalidSampleError, ServerUnavailableError
from rfm_rl import RewardModelVectorWrapper, RewardModelWrapper, RewardOptions

TASK = "task 0"
TASKS = [TASK, "task 1"]
WARNED = (
    "reset: expected the end of the episode before it, got one after 2 steps, whose reward is lost; put the time limit "
    "inside the wrapper: RewardModelWrapper(TimeLimit(env, steps), ...), or gymnasium.make(..., max_episode_steps=steps)"
)
REFUSED = "reset: expected the end of an episode before it, where mode 'final' pays, got one after 2 steps, .*TimeLimit"
FINAL = RewardOptions(mode="final", sampling="all", frames_from="pixels")


@pytest.fixture
def recorder() -> Iterator[Recorder]:
    with Recorder() as client:
        yield client


@pytest.fixture
def told(caplog: pytest.LogCaptureFixture) -> Any:
    """Return the client's log so far."""
    return lambda: [record.message for record in caplog.records if record.levelno == logging.WARNING]


def play(env: gym.Env[Any, Any]) -> float:
    """Return the sum of an episode's rewards."""
    env.reset()
    paid, ended = 0.0, False
    while not ended:
        _, reward, terminated, truncated, _ = env.step(0)
        paid += float(reward)
        ended = terminated or truncated
    return paid


def test_final_refuses_a_time_limit_outside(recorder: Recorder, told: Any) -> None:
    """It says so in the log at the first reset, which might be deliberate."""
    env = TimeLimit(RewardModelWrapper(CodedEnv(), recorder, TASK, FINAL), 2)
    play(env)
    assert told() == []
    play(env)
    assert told() == [WARNED]
    with pytest.raises(ValueError, match=f"^{REFUSED}"):
        play(env)
    assert told() == [WARNED]
    play(env)  # for a caller who means it


def test_final_pays_at_a_time_limit_inside(recorder: Recorder, told: Any) -> None:
    env = RewardModelWrapper(TimeLimit(CodedEnv(), 2), recorder, TASK, FINAL)
    assert [play(env) > 0 for _ in range(4)] == [True] * 4
    assert told() == []


def test_final_allows_early_resets_between_ends(recorder: Recorder, told: Any) -> None:
    """Evaluations and new calls of ``learn`` reset early."""
    env = RewardModelWrapper(CodedEnv(), recorder, TASK, FINAL)
    for _ in range(3):
        assert play(env) > 0
        env.reset()
        env.reset()
        env.step(0)
        env.step(0)
    env.close()
    assert told() == [WARNED]


CUT: dict[str, tuple[dict[str, Any], bool]] = {  # options, and whether the last step's reward is lost
    "each step is paid": ({"mode": "delta"}, False),
    "every fourth step is scored": ({"mode": "delta", "every": 4}, True),
    "final": ({"mode": "final"}, True),
    "final, which scores each step for the bonus": ({"mode": "final", "success_bonus": 1.0}, True),
}


@pytest.mark.parametrize(("options", "is_lost"), CUT.values(), ids=CUT)
def test_a_reset_that_drops_a_reward_warns_once(
    recorder: Recorder, told: Any, options: dict[str, Any], is_lost: bool
) -> None:
    env = RewardModelWrapper(CodedEnv(), recorder, TASK, RewardOptions(sampling="all", **options))
    for _ in range(2):
        env.reset()
        env.step(0)
        env.step(0)
        env.reset()
        play(env)
    assert told() == [WARNED] * is_lost


def test_a_reset_while_a_score_is_open_warns(late: LateClient, told: Any) -> None:
    env = RewardModelWrapper(cart_pole(), late, TASK, RewardOptions(sampling="all", blocking=False))
    env.reset(seed=0)
    late.hold(1, 2)
    env.step(0)
    env.step(0)
    env.reset(seed=0)
    assert told() == [WARNED]
    env.close()


def test_a_reset_after_a_lost_frame_or_in_a_step_is_silent(recorder: Recorder, told: Any) -> None:
    """The lost frame has raised an error, whose remedy is the reset. ``Autoreset`` resets only after an end."""
    env = RewardModelWrapper(CodedEnv(bad=(0, 0, 1)), recorder, TASK, RewardOptions(mode="final", sampling="all"))
    env.reset()
    with pytest.raises(InvalidSampleError):
        env.step(0)
    env.reset()
    for resetting in (Autoreset(RewardModelWrapper(CodedEnv(), recorder, TASK, FINAL)), autoreset_below(recorder)):
        resetting.reset()
        for _ in range(9):
            resetting.step(0)
    assert told() == []


def autoreset_below(recorder: Recorder) -> RewardModelWrapper:
    return RewardModelWrapper(Autoreset(CodedEnv()), recorder, TASK, FINAL)


def test_an_error_at_the_last_step_is_an_end(told: Any) -> None:
    with Recorder(failing=1) as client:
        env = RewardModelWrapper(CodedEnv(0, (1,)), client, TASK, FINAL)
        with pytest.raises(ServerUnavailableError):
            play(env)
        env.reset()
    assert told() == []


def test_final_allows_a_reset_after_each_error(recorder: Recorder) -> None:
    env = RewardModelWrapper(CodedEnv(), recorder, TASK, replace(FINAL, success_bonus=1.0))
    for _ in range(3):
        env.reset()
        recorder.server.failing = len(recorder.calls)
        with pytest.raises(ServerUnavailableError):
            env.step(0)


def vector(recorder: Recorder, lengths: tuple[int, int], mode: AutoresetMode) -> RewardModelVectorWrapper:
    makers = [partial(CodedEnv, number, (length,)) for number, length in enumerate(lengths)]
    return RewardModelVectorWrapper(SyncVectorEnv(makers, autoreset_mode=mode), recorder, TASKS, FINAL)


def cut(env: RewardModelVectorWrapper) -> None:
    env.reset()
    for _ in range(2):
        env.step(np.zeros(2, int))


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.name)
def test_final_refuses_a_vector_that_is_reset_before_its_episodes_end(
    recorder: Recorder, told: Any, mode: AutoresetMode
) -> None:
    env = vector(recorder, (3, 3), mode)
    for _ in range(2):
        cut(env)
    assert told() == [f"envs[0]: {WARNED}"]
    with pytest.raises(ValueError, match=rf"^envs\[0\]: {REFUSED}"):
        cut(env)


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.name)
def test_final_allows_resets_of_a_vector_in_which_an_episode_has_ended(
    recorder: Recorder, told: Any, mode: AutoresetMode
) -> None:
    """The second environment ends in time; the first never does."""
    env = vector(recorder, (3, 2), mode)
    for _ in range(4):
        cut(env)
    assert told() == [f"envs[0]: {WARNED}"]


class Still:
    """A policy that always takes the first action."""

    def predict(self, observations: Any, *_args: Any, **_options: Any) -> tuple[Any, None]:
        return np.zeros(len(observations["pixels"]), int), None


def test_final_allows_evaluations_that_end_with_the_shortest_episode(recorder: Recorder, told: Any) -> None:
    """``evaluate_policy`` takes a single episode from the last environment, and cuts those of the others."""
    vectors = pytest.importorskip("stable_baselines3.common.vec_env", reason="the extra sb3 is not installed")
    from stable_baselines3.common.evaluation import evaluate_policy

    from rfm_rl.sb3 import RewardModelVecEnv

    makers = [partial(CodedEnv, number, (length,)) for number, length in enumerate((9, 9, 9, 2))]
    env = vectors.VecMonitor(RewardModelVecEnv(vectors.DummyVecEnv(makers), recorder, TASK, FINAL))
    assert [evaluate_policy(Still(), env, n_eval_episodes=1)[0] > 0 for _ in range(4)] == [True] * 4
    assert told() == [f"envs[0]: {WARNED}"]


def test_final_refuses_a_vecenv_that_is_reset_before_its_episodes_end(recorder: Recorder, told: Any) -> None:
    vectors = pytest.importorskip("stable_baselines3.common.vec_env", reason="the extra sb3 is not installed")
    from rfm_rl.sb3 import RewardModelVecEnv

    makers = [partial(CodedEnv, number) for number in range(2)]
    env = RewardModelVecEnv(vectors.DummyVecEnv(makers), recorder, TASKS, FINAL)
    with pytest.raises(ValueError, match=rf"^envs\[0\]: {REFUSED}"):
        for _ in range(3):
            env.reset()
            for _ in range(2):
                env.step(np.zeros(2, int))
    assert told() == [f"envs[0]: {WARNED}"]
