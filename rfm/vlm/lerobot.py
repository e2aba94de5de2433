# SPDX-License-Identifier: MIT
"""Robometer as LeRobot publishes it: ``config.json`` of type ``robometer`` and one file of weights, no ``config.yaml``.

The network, prompts and pixels are those of Robometer. Format: ``lerobot/rewards/robometer`` of LeRobot, July 2026.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from rfm.checkpoint.content import NETWORK_CONFIG, CheckpointError, shown
from rfm.vlm.backbone import Renames, renamed
from rfm.vlm.run_config import RunConfig

TYPE = "robometer"  # the value of config.json's key ``type``
LEROBOT_BACKBONE = "vlm_config"  # the key of the backbone's configuration
_NAMES: Renames = ((r"^model\.model\.", "model."),)
_EMBEDDING, _TEXT_HEAD = "model.language_model.embed_tokens.weight", "model.lm_head.weight"
# Keys of config.json that decide scores, by their section in the config.yaml of a Robometer run.
_DECIDING = {
    "model": (
        "average_temporal_patches", "base_model_id", "frame_pooling", "frame_pooling_attn_temperature", "torch_dtype",
        "use_multi_image", "use_per_frame_progress_token",
    ),
    "data": ("max_frames",),
}  # fmt: skip
_BINS, _LOSS, _LOSSES = "progress_discrete_bins", "progress_loss_type", ("discrete", "l1", "l2")
# Keys about LeRobot's own pipelines and uploads.
_IDLE = {
    "default_task", "device", "image_key", "input_features", "license", "normalization_mapping", "output_features",
    "pretrained_path", "pretrained_revision", "private", "push_to_hub", "repo_id", "reward_output",
    "success_threshold", "tags", "task_key", "type",
}  # fmt: skip


def is_lerobot(content: Mapping[str, Any]) -> bool:
    """True if this config.json is a Robometer's of LeRobot."""
    return content.get("type") == TYPE


def lerobot_run(content: Mapping[str, Any], file: Path) -> RunConfig:
    """Return the settings in LeRobot's config.json. Raises CheckpointError for a missing, null or unknown key."""
    known = {LEROBOT_BACKBONE, _BINS, _LOSS, *_IDLE, *(key for keys in _DECIDING.values() for key in keys)}
    if unknown := sorted(content.keys() - known):
        remedy = "if it changes no score, remove it"
        raise CheckpointError.at(file, "the keys of LeRobot's Robometer", shown(unknown[0]), remedy)
    for key in (LEROBOT_BACKBONE, *_DECIDING["model"]):
        if content.get(key) is None:
            raise CheckpointError.at(f"{file}: {key}", "a value", "none", "save the model with LeRobot again")
    sections = {name: {key: content.get(key) for key in keys} for name, keys in _DECIDING.items()}
    sections["data"] |= {"resized_height": None, "resized_width": None}  # LeRobot has no common size of frames
    return RunConfig(file, NETWORK_CONFIG, {"training": {}, "peft": {}, **sections}, has_sections=False)


def lerobot_weights(tensors: Mapping[str, Tensor], backbone: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the weights under the network's names.

    If text head and embedding are tied, LeRobot's file holds the tensor once, as the text head's.
    """
    weights = renamed(tensors, _NAMES)
    if backbone.get("tie_word_embeddings") and _EMBEDDING not in weights and _TEXT_HEAD in weights:
        weights[_EMBEDDING] = weights.pop(_TEXT_HEAD)
    return weights


def check_bins(content: Mapping[str, Any], weights: Mapping[str, Tensor], file: Path) -> None:
    """Raise CheckpointError if config.json states other progress bins than the weights have."""
    loss, bins = content.get(_LOSS), content.get(_BINS)
    if loss not in _LOSSES:
        raise CheckpointError.at(f"{file}: {_LOSS}", f"one of {', '.join(_LOSSES)}", shown(loss))
    head = weights.get("progress_head.4.weight")
    stated = bins if loss == "discrete" else 1
    if head is not None and len(head) != stated:
        got = f"{shown(bins)} with {_LOSS} {loss}; correct what the run did not have"
        raise CheckpointError.at(f"{file}: {_BINS}", f"{len(head)} outputs, as progress_head has", got)
