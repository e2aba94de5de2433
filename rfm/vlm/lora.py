# SPDX-License-Identifier: MIT
"""LoRA weights, merged into those that they belong to: W + alpha / r * B A (https://arxiv.org/abs/2106.09685)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from rfm.checkpoint.content import CheckpointError

LORA_NAME = re.compile(r"(?P<module>.+)\.lora_(?P<side>[AB])(\.default)?\.weight")
_BASE_LAYER = ".base_layer."
# Fields of adapter_config.json that would make the merged weight another one.
_UNSUPPORTED_LORA = ("use_dora", "use_rslora", "lora_bias", "alpha_pattern", "rank_pattern", "fan_in_fan_out")


def scaling(file: Path, config: Mapping[str, Any]) -> float:
    """alpha / r of a LoRA configuration."""
    unsupported = [name for name in _UNSUPPORTED_LORA if config.get(name)]
    if unsupported:
        raise CheckpointError(f"{file}: expected plain LoRA, got {', '.join(unsupported)}")
    try:
        return float(config["lora_alpha"]) / float(config["r"])
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise CheckpointError(f"{file}: expected lora_alpha and r of the LoRA weights, got {error!r}") from error


def merged(weights: Mapping[str, Tensor], factor: float) -> dict[str, Tensor]:
    """The weights with each pair of LoRA factors added to the weight that it belongs to."""
    factors: dict[str, dict[str, Tensor]] = {}
    whole: dict[str, Tensor] = {}
    for name, tensor in weights.items():
        match = LORA_NAME.fullmatch(name)
        if match:
            factors.setdefault(match["module"], {})[match["side"]] = tensor
        else:
            whole[name.replace(_BASE_LAYER, ".")] = tensor
    for module, pair in factors.items():
        base = whole.get(f"{module}.weight")
        if base is None or pair.keys() != {"A", "B"}:
            raise CheckpointError(f"{module}: expected a weight and LoRA factors A and B, got {sorted(pair)}")
        shapes = [list(pair[side].shape) for side in ("B", "A")]
        if [len(shape) for shape in shapes] != [2, 2] or [shapes[0][0], shapes[1][1]] != list(base.shape):
            raise CheckpointError(
                f"{module}: expected LoRA factors of {list(base.shape)}, got {shapes[0]} and {shapes[1]}"
            )
        update = factor * (pair["B"].float() @ pair["A"].float())
        whole[f"{module}.weight"] = (base.float() + update).to(base.dtype)
    return whole
