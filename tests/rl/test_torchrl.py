# SPDX-License-Identifier: MIT
"""TorchRL's environment around a rewarded vector. ``make test-newest`` installs TorchRL."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from coded_env import Code, CodedEnv, CodeReader, Recorder
from rfm_rl import RewardModelVectorWrapper, RewardOptions

torchrl = pytest.importorskip("torchrl.envs", reason="make test-newest installs it")


class Rising(CodeReader):
    """Scores each frame by its step."""

    def scores(self, codes: list[Code]) -> dict[str, Any]:
        return {"progress": np.array([0.0, 0.1, 0.3, 0.6])[[step for *_, step in codes]]}


def test_torchrl_gets_the_rewards_of_each_environment_and_resets_those_that_have_ended() -> None:
    envs = [lambda: CodedEnv(0, (3,)), lambda: CodedEnv(1, (2,))]
    options = RewardOptions(sampling="all", mode="delta", frames_from="pixels")
    with Recorder(server=Rising()) as client:
        vector = SyncVectorEnv(envs, autoreset_mode=AutoresetMode.DISABLED)
        env = torchrl.GymWrapper(RewardModelVectorWrapper(vector, client, ["task 0", "task 1"], options))
        rewards = env.rollout(6, break_when_any_done=False)["next", "reward"][..., 0]
    expected = [[0.1, 0.2, 0.3, 0.1, 0.2, 0.3], [0.1, 0.2, 0.1, 0.2, 0.1, 0.2]]
    np.testing.assert_allclose(rewards, expected, atol=1e-6)
