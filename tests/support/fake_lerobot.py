# SPDX-License-Identifier: MIT
"""A fake of the few classes of LeRobot that the plug-in extends, for a Python without LeRobot.

It knows no registry, parser, factory, pipeline or file: ``test_lerobot_itself.py`` tries those with the real one.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

import torch


@dataclass
class RewardModelConfig:
    device: str | None = None

    def __post_init__(self) -> None:
        pass

    @staticmethod
    def register_subclass(name: str) -> Callable[[type], type]:
        return lambda config: config


class PreTrainedRewardModel(torch.nn.Module):
    def __init__(self, config: RewardModelConfig) -> None:
        super().__init__()
        self.config = config


MODULES: dict[str, dict[str, Any]] = {
    "lerobot": {},
    "lerobot.configs": {},
    "lerobot.configs.rewards": {"RewardModelConfig": RewardModelConfig},
    "lerobot.rewards": {},
    "lerobot.rewards.pretrained": {"PreTrainedRewardModel": PreTrainedRewardModel},
    "lerobot.processor": dict.fromkeys(
        (
            "AddBatchDimensionProcessorStep",
            "DeviceProcessorStep",
            "PolicyProcessorPipeline",
            "policy_action_to_transition",
            "transition_to_policy_action",
        )
    ),
    "lerobot.utils": {},
    "lerobot.utils.constants": dict.fromkeys(("POLICY_POSTPROCESSOR_DEFAULT_NAME", "POLICY_PREPROCESSOR_DEFAULT_NAME")),
}


def provide() -> None:
    """Let the plug-in import the fake, unless LeRobot is installed."""
    if "lerobot" not in sys.modules and importlib.util.find_spec("lerobot") is None:
        sys.modules.update({name: module(name, names) for name, names in MODULES.items()})


def module(name: str, names: Mapping[str, Any]) -> ModuleType:
    made = ModuleType(name, "A fake of LeRobot, for tests.")
    made.__spec__ = ModuleSpec(name, None)  # TorchRL looks for it
    made.__dict__.update(names)
    return made
