# SPDX-License-Identifier: MIT
"""The public name of what ``rfm_client.integrations`` has for Gymnasium: environments paid by a reward model."""

from rfm_client.episodes.steps import SuccessRule
from rfm_client.integrations.gym import RewardModelWrapper  # first, as it says what is to be installed
from rfm_client.integrations.gym_vector import RewardModelVectorWrapper
from rfm_client.integrations.rewards import RewardOptions

__all__ = ["RewardModelVectorWrapper", "RewardModelWrapper", "RewardOptions", "SuccessRule"]
