# SPDX-License-Identifier: MIT
"""The loops that the guide names: CleanRL's vectors, and Meta-World where it is installed."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from coded_env import Recorder
from environments import TASK, cart_pole
from meta_world import meta_world
from rfm_client import RewardClient
from rfm_rl import RewardModelVectorWrapper, RewardOptions

STEPS = 500


@pytest.mark.triton
def test_cleanrl_s_statistics_are_of_the_reward_model_s_rewards(client: RewardClient) -> None:
    """The library's scripts count returns in the outermost wrapper, by ``infos["episode"]``."""
    vector = SyncVectorEnv([cart_pole] * 4, autoreset_mode=AutoresetMode.NEXT_STEP)
    rewarded = RewardModelVectorWrapper(vector, client, TASK, RewardOptions(mode="delta", max_frames=4))
    with closing(RecordEpisodeStatistics(rewarded)) as envs:
        envs.action_space.seed(0)
        envs.reset(seed=0)
        returns, num_ended = np.zeros(4), 0
        for _ in range(STEPS // 4):
            _, rewards, terminations, truncations, infos = envs.step(envs.action_space.sample())
            returns += rewards
            for number in np.flatnonzero(terminations | truncations).tolist():
                assert infos["episode"]["r"][number] == pytest.approx(returns[number], abs=1e-4)
                returns[number], num_ended = 0, num_ended + 1
    assert num_ended > 4


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_meta_world_steps_in_processes(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """Where it is installed (with mujoco below 4), and MuJoCo can draw without a window."""
    pytest.importorskip("metaworld", reason="Meta-World is not installed")
    monkeypatch.setenv("MUJOCO_GL", "egl")
    vector = AsyncVectorEnv([meta_world] * 2, context="spawn", autoreset_mode=AutoresetMode.NEXT_STEP)
    options = RewardOptions(mode="shaping", gamma=0.99, orient="rotate180")
    with Recorder() as client, closing(RewardModelVectorWrapper(vector, client, TASK, options)) as envs:
        envs.reset(seed=0)
        for _ in range(STEPS // 2):
            envs.step(envs.action_space.sample())
        assert min(frames[-1].std() for frames in client.pixels) > 10  # pictures, not black
    assert not [record for record in caplog.records if "black" in record.message]
