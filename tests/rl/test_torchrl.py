# SPDX-License-Identifier: MIT
"""TorchRL's environment around a rewarded vector. ``make test-newest`` installs TorchRL."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from coded_env import CodedEnv, Recorder
from rfm_rl import RewardModelVectorWrapper, RewardOptions

torchrl = pytest.importorskip("torchrl.envs", reason="make test-newest installs it")
STEPS = 6


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED], ids=lambda mode: mode.name)
def test_torchrl_gets_the_rewards_of_the_vector(recorder: Recorder, mode: AutoresetMode) -> None:
    def vector() -> RewardModelVectorWrapper:
        env = SyncVectorEnv([lambda: CodedEnv(0, (3,)), lambda: CodedEnv(1, (2,))], autoreset_mode=mode)
        options = RewardOptions(sampling="all", mode="delta", frames_from="pixels")
        return RewardModelVectorWrapper(env, recorder, ["task 0", "task 1"], options)

    rollout = torchrl.GymWrapper(vector()).rollout(STEPS, break_when_any_done=False)
    by_torchrl, asked = rollout["next", "reward"][..., 0].T, list(recorder.calls)
    plain, rewards = vector(), []
    plain.reset()
    for _ in range(STEPS):
        _, reward, terminated, truncated, _ = plain.step(np.zeros(2, int))
        rewards.append(reward)
        if mode is AutoresetMode.DISABLED and (ended := terminated | truncated).any():
            plain.reset(options={"reset_mask": ended})
    np.testing.assert_allclose(by_torchrl, rewards, atol=1e-6)
    assert len(np.unique(rewards)) > 2
    assert recorder.calls[len(asked) :] == asked
