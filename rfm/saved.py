# SPDX-License-Identifier: MIT
"""Checkpoints as ``rfm export`` writes them: all that serving reads.

A checkpoint on a Qwen backbone is a folder with one weights file, transformers' ``config.json`` with this project's
settings under the key SETTINGS, and the processor's files.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors.torch import save_file
from torch import Tensor

from rfm.files import NETWORK_CONFIG, WEIGHTS, CheckpointError, network_config, read_json, read_tensors, shown

SETTINGS = "rfm"  # key in config.json
REWARD_MODEL = "reward_model"  # key in SETTINGS for a model that is asked in words
PROCESSOR_FOLDER = "processor"


@dataclass(frozen=True)
class Saved:
    """The files of a checkpoint on a Qwen backbone.

    backbone: transformers' configuration
    settings: this project's fields
    processor: folder with tokenizer and preprocessing
    """

    folder: Path
    backbone: dict[str, Any]
    settings: dict[str, Any]
    weights: dict[str, Tensor]

    @property
    def processor(self) -> Path:
        """The folder with tokenizer and preprocessing."""
        return self.folder / PROCESSOR_FOLDER

    @classmethod
    def read(cls, folder: Path) -> Saved:
        """Read a folder. Raises CheckpointError."""
        content = read_json(folder / NETWORK_CONFIG)
        settings = content.pop(SETTINGS, None)
        if not isinstance(settings, dict):
            raise CheckpointError.at(
                f"{folder / NETWORK_CONFIG}: {SETTINGS}", "the settings of an export", shown(settings)
            )
        return cls(folder, content, settings, read_tensors(folder / WEIGHTS))


def write_network(folder: Path, config: Mapping[str, Any], weights: Mapping[str, Tensor]) -> None:
    """Write configuration and weights into a new folder."""
    folder.mkdir(parents=True)
    (folder / NETWORK_CONFIG).write_text(json.dumps(config, indent=2) + "\n")
    save_file({name: tensor.contiguous() for name, tensor in weights.items()}, folder / WEIGHTS, {"format": "pt"})


def is_saved(folder: Path) -> bool:
    """True if the folder is an export on a Qwen backbone."""
    return network_config(folder).get(SETTINGS) is not None


def reward_model_of(folder: Path) -> str | None:
    """Return the reward model that an export's config.json names; None: there is none."""
    settings = network_config(folder).get(SETTINGS)
    name = settings.get(REWARD_MODEL) if isinstance(settings, dict) else None
    return name if isinstance(name, str) else None
