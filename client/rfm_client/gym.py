# SPDX-License-Identifier: MIT
"""The public name of ``rfm_client.integrations.gym``: Gymnasium environments paid by a reward model."""

from rfm_client.integrations.gym import RewardModelVectorWrapper, RewardModelWrapper, RewardOptions, SuccessRule

__all__ = ["RewardModelVectorWrapper", "RewardModelWrapper", "RewardOptions", "SuccessRule"]
