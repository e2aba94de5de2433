# SPDX-License-Identifier: MIT
"""Checkpoints with rounded weights: rounded here (``rfm export --weights``), or published in NF4."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rfm.config import Weights
from rfm.engine.family import Checkpoint
from rfm.files import NETWORK_CONFIG, CheckpointError, shown
from rfm.published.nf4 import dequantize
from rfm.published.qwen import NF4, QUANTIZED, UNQUANTIZED, check_not_quantized, quantization
from rfm.published.weights import read_weights
from rfm.qwen.checkpoint import LORA, QwenCheckpoint
from rfm.qwen.lora import changed_by, merged
from rfm.qwen.rounded import may_be_rounded, rounded
from rfm.weights import DECODED

_NF4: Weights = "nf4"
_BACKBONE = "model."  # prefix of the backbone's weights


def read_unrounded_config(backbone: dict[str, Any], file: Path) -> bool:
    """Return True if the configuration says that weights are in NF4, and remove this entry.

    Raises CheckpointError for weights that are rounded in another way.
    """
    is_nf4 = quantization(backbone) == NF4
    if is_nf4:
        del backbone["quantization_config"]
    check_not_quantized(backbone, file, UNQUANTIZED)
    return is_nf4


def read_published(folder: Path, is_nf4: bool, model_type: str | None = None) -> tuple[dict[str, Tensor], int]:
    """Return a folder's tensors, and how many weights are in NF4. Layers stay in NF4, other weights are decoded.

    is_nf4: True if config.json says that some are in NF4
    model_type: as in ``read_weights``
    Raises CheckpointError.
    """
    tensors = read_weights(folder, model_type)
    num_nf4 = dequantize(tensors, may_be_rounded)
    quantized = next((name for name in tensors if QUANTIZED.search(name)), None)
    if quantized is not None:
        raise CheckpointError.at(folder, "weights in full precision", shown(quantized), UNQUANTIZED)
    if is_nf4 and not num_nf4:
        got = "none; if they are meant in full precision, remove it"
        raise CheckpointError.at(f"{folder / NETWORK_CONFIG}: quantization_config", "weights in NF4", got)
    return tensors, num_nf4


def kind_of(weights: Mapping[str, Tensor]) -> Weights | None:
    """Return the format in which weights were published: NF4, or None."""
    return _NF4 if any(name.endswith(DECODED) for name in weights) else None


def rounded_as_asked(checkpoint: Checkpoint, kind: Weights | None) -> Checkpoint:
    """Return the checkpoint, with the backbone's layers rounded if the user asks for it. Raises CheckpointError.

    LoRA factors of these layers are added before rounding.
    kind: the user's option; None, another network, or layers that are already rounded: nothing changes
    """
    if kind is None or not isinstance(checkpoint, QwenCheckpoint) or checkpoint.config.weights is not None:
        return checkpoint
    factors = {**checkpoint.parts.get(LORA, {})}
    whole: dict[str, Tensor] = {}
    for name, weight in checkpoint.weights.items():
        is_layer = name.startswith(_BACKBONE) and may_be_rounded(name)
        if not (is_layer and weight.ndim == 2 and weight.shape[1] % 2 == 0):
            whole[name] = weight
            continue
        own = {factor: factors.pop(factor) for factor in [*factors] if changed_by(factor) == name}
        matrix = merged({name: weight}, own, torch.float32)[name]
        whole |= rounded(name, matrix, kind, checkpoint.config.torch_dtype)
    left: dict[str, Any] = {"factors": factors} if LORA in checkpoint.parts else {}
    changed = replace(checkpoint, config=replace(checkpoint.config, weights=kind), weights=whole, **left)
    changed.check()
    return changed
