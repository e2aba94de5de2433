# SPDX-License-Identifier: MIT
"""Upstream's checkpoint layouts -> configuration and weights.

A checkpoint is a local folder or a Hugging Face id ``org/name[@tag]``. In it: ``model.safetensors`` (or shards
with an index, or an adapter), ``config.json`` (the network) and, in the folder, its parent or on main of the Hub's
repository, ``config.yaml`` (the training run). Nothing in a checkpoint is executed: safetensors only, and YAML tags
construct nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

from rfm.checkpoint.content import CheckpointError, is_there, read_json, read_run_config
from rfm.checkpoint.files import NETWORK_CONFIG, best_tag, check_finite, check_links, find
from rfm.rewind.checkpoint import RewindCheckpoint, load_rewind, save_rewind
from rfm.vlm.checkpoint import ADAPTER_CONFIG, VlmCheckpoint, load_vlm, save_vlm
from rfm.vlm.network import BACKBONES

Checkpoint: TypeAlias = RewindCheckpoint | VlmCheckpoint

__all__ = [
    "Checkpoint",
    "CheckpointError",
    "RewindCheckpoint",
    "VlmCheckpoint",
    "best_tag",
    "check",
    "find",
    "load",
    "read_run_config",
    "save",
]


def load(source: str | Path, *, base_model: str | None = None, resize_images: bool | None = None) -> Checkpoint:
    """The checkpoint at a local folder or Hugging Face id. Raises CheckpointError.

    base_model: folder or id of a vision-language checkpoint's backbone; else the one that the checkpoint names
    resize_images: of a vision-language checkpoint that reads frames as images and whose run set a size for them:
        whether it was trained with that size; None: such a checkpoint is refused
    """
    folder = find(source)
    if is_there(folder / ADAPTER_CONFIG) or _model_type(folder) in BACKBONES:
        return load_vlm(folder, base_model, resize_images)
    return load_rewind(folder)


def check(folder: Path, checkpoint: Checkpoint) -> None:
    """Raises CheckpointError for what is refused before a checkpoint of ``folder`` is served, beyond what ``load``
    refuses: links that lead out of it, and weights that are no numbers.
    """
    check_links(folder)
    if isinstance(checkpoint, RewindCheckpoint):
        for weights in (checkpoint.network, checkpoint.image_encoder, checkpoint.text_encoder):
            check_finite(weights)
    else:
        check_finite(checkpoint.weights)


def save(checkpoint: Checkpoint, folder: Path) -> None:
    """Writes network and configuration in a layout that ``load`` reads; no encoders."""
    if isinstance(checkpoint, RewindCheckpoint):
        save_rewind(checkpoint, folder)
    else:
        save_vlm(checkpoint, folder)


def _model_type(folder: Path) -> str | None:
    config = folder / NETWORK_CONFIG
    told = read_json(config).get("model_type") if is_there(config) else None
    return told if isinstance(told, str) else None
