# SPDX-License-Identifier: MIT
"""Rewards of a served reward model in reinforcement learning: Gymnasium environments, vectors, live reports."""

from rfm_client.episodes import SuccessRule
from rfm_rl.gym import RewardModelWrapper
from rfm_rl.gym_vector import RewardModelVectorWrapper
from rfm_rl.live import LiveView
from rfm_rl.rewards import RewardOptions

__all__ = ["LiveView", "RewardModelVectorWrapper", "RewardModelWrapper", "RewardOptions", "SuccessRule"]
