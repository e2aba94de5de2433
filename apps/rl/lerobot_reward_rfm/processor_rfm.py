# SPDX-License-Identifier: MIT
"""The pipelines before and after the reward model."""

from __future__ import annotations

from typing import Any

from lerobot.processor import (
    AddBatchDimensionProcessorStep,
    DeviceProcessorStep,
    PolicyProcessorPipeline,
    policy_action_to_transition,
    transition_to_policy_action,
)
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME

from lerobot_reward_rfm.configuration_rfm import RfmRewardConfig


def make_rfm_pre_post_processors(config: RfmRewardConfig, dataset_stats: Any = None) -> tuple[Any, Any]:
    """Return the pipelines that LeRobot requests by this name.

    The first adds a missing batch dimension and leaves pixels alone, because the server normalises them. The second
    changes nothing.

    dataset_stats: not used
    """
    before = PolicyProcessorPipeline(
        steps=[AddBatchDimensionProcessorStep(), DeviceProcessorStep(device=config.device or "cpu")],
        name=POLICY_PREPROCESSOR_DEFAULT_NAME,
    )
    after = PolicyProcessorPipeline(
        steps=[],
        name=POLICY_POSTPROCESSOR_DEFAULT_NAME,
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
    return before, after
