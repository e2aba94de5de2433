# SPDX-License-Identifier: MIT
"""A LeRobot reward model whose scores come from a served checkpoint. Importing it registers the type ``rfm``."""

from lerobot_reward_rfm.configuration_rfm import RfmRewardConfig
from lerobot_reward_rfm.modeling_rfm import RfmPrediction, RfmRewardModel
from lerobot_reward_rfm.processor_rfm import make_rfm_pre_post_processors

__all__ = ["RfmPrediction", "RfmRewardConfig", "RfmRewardModel", "make_rfm_pre_post_processors"]
