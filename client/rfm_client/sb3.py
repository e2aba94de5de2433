# SPDX-License-Identifier: MIT
"""Vectors of Stable-Baselines3 with rewards from a reward model: public names of ``rfm_client.integrations``."""

from rfm_client.integrations.rewards import RewardOptions
from rfm_client.integrations.sb3 import RenderedFrame, RewardModelVecEnv

__all__ = ["RenderedFrame", "RewardModelVecEnv", "RewardOptions"]
