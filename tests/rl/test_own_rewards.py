# SPDX-License-Identifier: MIT
"""The environment's reward stays out of learning and logs."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RecordEpisodeStatistics
from gymnasium.wrappers.vector import RecordEpisodeStatistics as RecordVectorStatistics

from coded_env import Code, CodedEnv, CodeReader, Recorder
from environments import TASK
from paths import ROOT
from rfm_client import RewardClient
from rfm_rl import RewardModelVectorWrapper, RewardModelWrapper, RewardOptions, SuccessRule

pytest.importorskip("stable_baselines3", reason="the extra sb3 is not installed")

from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecMonitor, VecNormalize

from rfm_rl.sb3 import RenderedFrame, RewardModelVecEnv

ALL = RewardOptions(sampling="all")
LENGTH = 5  # steps of an episode


class Reach(CodedEnv):
    """An environment with goals, whose rewards no reward model would give."""

    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self) -> None:
        super().__init__(1, (LENGTH,))
        point = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.observation_space = gym.spaces.Dict(dict.fromkeys(("observation", "achieved_goal", "desired_goal"), point))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        _, _, *told = super().step(action)
        return self.observation_space.sample(), -100.0, *told

    def compute_reward(self, achieved: Any, desired: Any, infos: Any) -> Any:
        return np.full(np.shape(achieved)[:-1], -100.0)


def vector(client: RewardClient, venv: Any) -> Any:
    return RewardModelVecEnv(venv, client, TASK, ALL)


def single(client: RewardClient, env: gym.Env[Any, Any], **options: Any) -> gym.Env[Any, Any]:
    return RewardModelWrapper(env, client, TASK, RewardOptions(sampling="all", **options))


def rendered() -> Any:
    return DummyVecEnv([lambda: RenderedFrame(Reach())])


def monitored(**options: Any) -> Any:
    return make_vec_env(Reach, 2, wrapper_class=RenderedFrame, **options)


WRAPPINGS: dict[str, Callable[[RewardClient], Any]] = {
    "a VecMonitor outside": lambda client: VecMonitor(vector(client, rendered())),
    "a VecMonitor inside": lambda client: vector(client, VecMonitor(rendered())),
    "a Monitor inside": lambda client: vector(client, monitored()),
    "a VecNormalize outside": lambda client: VecNormalize(VecMonitor(vector(client, rendered()))),
    "a Monitor inside one environment": lambda client: DummyVecEnv([lambda: single(client, Monitor(Reach()))]),
    "a Monitor outside one environment": lambda client: make_vec_env(lambda: single(client, Reach()), 2),
}


class Varied(CodeReader):
    """Scores each frame otherwise."""

    def scores(self, codes: list[Code]) -> dict[str, Any]:
        return {"progress": [np.random.default_rng(code).random() for code in codes], "success": 0.0}


class Ledger(VecEnvWrapper):  # type: ignore[misc]
    """Add up the reward model's rewards, whatever the environment paid."""

    def __init__(self, venv: Any) -> None:
        super().__init__(venv)
        self.progress: list[list[float]] = []  # of each step
        self.sums: list[float] = []  # of each ended episode
        self._running = np.zeros(self.num_envs)

    def reset(self) -> Any:
        self._running[:] = 0
        return self.venv.reset()

    def step_wait(self) -> Any:
        step = self.venv.step_wait()
        self.progress.append([info["reward_model"]["progress"] for info in step[3]])
        self._running += self.progress[-1]
        for index in np.flatnonzero(step[2]):
            self.sums.append(self._running[index])
            self._running[index] = 0
        return step


@pytest.mark.parametrize("algorithm", [PPO, SAC])
@pytest.mark.parametrize("wrapping", WRAPPINGS.values(), ids=WRAPPINGS)
def test_all_that_stable_baselines3_shows_is_the_reward_model_s(
    wrapping: Callable[[RewardClient], Any], algorithm: Any
) -> None:
    client = Recorder(server=Varied())
    trained, evaluated = Ledger(wrapping(client)), Ledger(wrapping(client))
    num_steps = 2 * LENGTH * trained.num_envs
    settings = {"n_steps": 2 * LENGTH, "batch_size": num_steps} if algorithm is PPO else {"buffer_size": num_steps}
    callback = EvalCallback(evaluated, n_eval_episodes=2, eval_freq=2 * LENGTH, verbose=0)
    model = algorithm("MultiInputPolicy", trained, device="cpu", **settings).learn(num_steps, callback)
    assert [episode["r"] for episode in model.ep_info_buffer] == pytest.approx(trained.sums, abs=1e-4)
    assert [episode["l"] for episode in model.ep_info_buffer] == [LENGTH] * len(trained.sums)
    assert callback.last_mean_reward == pytest.approx(np.mean(evaluated.sums), abs=1e-4)
    evaluated.sums.clear()
    assert evaluate_policy(model, evaluated, 2, return_episode_rewards=True)[0] == pytest.approx(
        evaluated.sums, abs=1e-4
    )
    if algorithm is SAC:
        np.testing.assert_allclose(model.replay_buffer.rewards, trained.progress, atol=1e-6)
    assert len(trained.sums) == 2 * trained.num_envs
    trained.close()
    evaluated.close()
    client.close()


@pytest.mark.parametrize("name", ["a VecMonitor outside", "a Monitor inside", "a Monitor outside one environment"])
def test_hindsight_relabelling_is_refused(recorder: Recorder, name: str) -> None:
    """Four fifths of a batch would have the environment's own reward."""
    settings = {"replay_buffer_class": HerReplayBuffer, "learning_starts": 4 * LENGTH, "buffer_size": 100}
    model = SAC("MultiInputPolicy", WRAPPINGS[name](recorder), device="cpu", **settings)
    refusal = "compute_reward: expected no rewards for other goals, .* turn off hindsight relabelling"
    with pytest.raises(NotImplementedError, match=refusal):
        model.learn(8 * LENGTH)
    assert model.env.env_method("render")


class Pleased(CodeReader):
    """Sees a success in each frame."""

    def scores(self, codes: list[Code]) -> dict[str, Any]:
        return {"progress": 1.0, "success": 1.0}


@pytest.mark.parametrize("is_first", [True, False])
def test_the_callback_of_the_guide_logs_each_rollout_once_before_and_after_others(
    tmp_path: Path, is_first: bool
) -> None:
    """EvalCallback writes the log within a rollout."""
    guide = (ROOT / "docs" / "guides" / "reward_an_rl_loop.md").read_text()
    (code,) = (each for each in re.findall(r"^```python\n(.*?)^```", guide, re.M | re.S) if "class LogRewards" in each)
    shown: dict[str, Any] = {}
    exec(code, shown)
    with Recorder(server=Pleased()) as client:
        model = PPO("MultiInputPolicy", single(client, Reach()), n_steps=4, batch_size=4, device="cpu")
        model.set_logger(configure(str(tmp_path), ["json"]))
        callbacks = [
            shown["LogRewards"](),
            EvalCallback(Monitor(single(client, Reach())), n_eval_episodes=1, eval_freq=2),
        ]
        model.learn(8, callbacks if is_first else callbacks[::-1]).logger.close()
    rows = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    logged = [row for row in rows if "reward_model/progress" in row]
    assert [row["time/total_timesteps"] for row in logged] == [4, 8]
    assert all([row[f"reward_model/{key}"] for key in ("reward", "progress", "success")] == [1, 1, 1] for row in logged)


@pytest.mark.parametrize(
    "inside", [lambda env: env, Monitor, RecordEpisodeStatistics], ids=["none", "Monitor", "Record"]
)
def test_an_end_by_success_is_an_episode_for_statistics(inside: Any) -> None:
    """Those inside do not see it: without it, ``evaluate_policy`` would wait for ever for an episode's end."""
    with Recorder(server=Pleased()) as client:
        env = single(client, inside(Reach()), terminate_on_success=SuccessRule())
        model = PPO("MultiInputPolicy", env, n_steps=4, batch_size=4, device="cpu").learn(4)
        assert [(episode["r"], episode["l"]) for episode in model.ep_info_buffer] == [(1, 1)] * 4
        assert evaluate_policy(model, model.env, 2) == (1, 0)


def both(mode: AutoresetMode, each: Callable[[CodedEnv], Any] = lambda env: env) -> SyncVectorEnv:
    return SyncVectorEnv([lambda n=n: each(CodedEnv(n, (3 + n,))) for n in range(2)], autoreset_mode=mode)


INSIDE: dict[str, Callable[[AutoresetMode], Any]] = {
    "each environment": lambda mode: both(mode, RecordEpisodeStatistics),
    "the vector": lambda mode: RecordVectorStatistics(both(mode)),
}


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("inside", INSIDE.values(), ids=INSIDE)
def test_statistics_inside_a_vector_show_the_reward_model_s_rewards(
    recorder: Recorder, inside: Callable[[AutoresetMode], Any], mode: AutoresetMode
) -> None:
    options = RewardOptions(sampling="all", frames_from="pixels")
    env = RewardModelVectorWrapper(inside(mode), recorder, TASK, options)
    env.reset()
    returns, num_ended = np.zeros(2), 0
    for _ in range(12):
        _, rewards, terminations, truncations, infos = env.step(np.zeros(2, int))
        returns += rewards
        for index in np.flatnonzero(terminations | truncations).tolist():
            told = infos if "episode" in infos else infos["final_info"]
            assert told["episode"]["r"][index] == pytest.approx(returns[index], abs=1e-5)
            assert told["episode"]["l"][index] == 3 + index
            returns[index], num_ended = 0, num_ended + 1
    assert num_ended >= 5


REFUSED: dict[str, tuple[Any, type[Exception], str]] = {
    "no VecEnv": (Reach, TypeError, "^venv: expected a VecEnv of stable_baselines3, got .*Reach"),
    "no pictures": (
        lambda: DummyVecEnv([Reach]),
        ValueError,
        r"^venv: expected each environment in RenderedFrame, .*: make_vec_env\(..., wrapper_class=RenderedFrame\)$",
    ),
    "a normalization": (
        lambda: VecMonitor(VecNormalize(rendered(), norm_obs=False)),
        ValueError,
        r"^venv: expected no VecNormalize inside.*; wrap in the other order: VecNormalize\(RewardModelVecEnv",
    ),
}


@pytest.mark.parametrize(("make", "error", "message"), REFUSED.values(), ids=REFUSED)
def test_a_vector_that_cannot_be_paid_is_refused(
    recorder: Recorder, make: Any, error: type[Exception], message: str
) -> None:
    """Off-policy algorithms look for a ``VecNormalize`` and store the rewards that it got."""
    with pytest.raises(error, match=message):
        vector(recorder, make())
