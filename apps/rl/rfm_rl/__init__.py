# SPDX-License-Identifier: MIT
"""Rewards from a served reward model in reinforcement learning: Gymnasium environments and vectors."""

from rfm_client.episodes import SuccessRule
from rfm_rl.gym import RewardModelWrapper
from rfm_rl.gym_vector import RewardModelVectorWrapper
from rfm_rl.own_resets import CopiedObservation
from rfm_rl.rewards import RewardOptions

__all__ = ["CopiedObservation", "RewardModelVectorWrapper", "RewardModelWrapper", "RewardOptions", "SuccessRule"]
