# SPDX-License-Identifier: MIT
"""Gymnasium environments with rewards from a reward model: public names of ``rfm_client.integrations``."""

from rfm_client.episodes.steps import SuccessRule
from rfm_client.integrations.gym import RewardModelWrapper  # first: its ImportError says how to install gymnasium
from rfm_client.integrations.gym_vector import RewardModelVectorWrapper
from rfm_client.integrations.rewards import RewardOptions

__all__ = ["RewardModelVectorWrapper", "RewardModelWrapper", "RewardOptions", "SuccessRule"]
