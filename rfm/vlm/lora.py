# SPDX-License-Identifier: MIT
"""LoRA: a weight is W + alpha / r * B A (https://arxiv.org/abs/2106.09685).

W and the factors are kept apart until the dtype of the network is known. Many updates are smaller than half a step of
bfloat16, in which W usually is: a sum in that dtype would lose them, also where float32 is served.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rfm.checkpoint.content import CheckpointError

LORA_NAME = re.compile(r"(?P<module>.+)\.lora_(?P<side>[AB])(\.default)?\.weight")
_BASE_LAYER = ".base_layer."
# Fields of adapter_config.json that would make the weight another one.
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


def split(tensors: Mapping[str, Tensor], scale: float = 1.0) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The weights, and the LoRA factors of some of them: ``<module>.lora_A.weight`` and ``<module>.lora_B.weight``.

    scale: what B is multiplied with. Raises CheckpointError for factors that do not fit their weight.
    """
    weights: dict[str, Tensor] = {}
    pairs: dict[str, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        match = LORA_NAME.fullmatch(name)
        if match:
            pairs.setdefault(match["module"], {})[match["side"]] = tensor
        else:
            weights[name.replace(_BASE_LAYER, ".")] = tensor
    factors = {}
    for module, pair in pairs.items():
        _check(module, weights.get(f"{module}.weight"), pair)
        factors[_name(module, "A")] = pair["A"]
        factors[_name(module, "B")] = pair["B"] if scale == 1 else scale * pair["B"].float()
    return weights, factors


def changed_by(factor: str) -> str:
    """The name of the weight that the factor of this name changes."""
    match = LORA_NAME.fullmatch(factor)
    assert match is not None
    return f"{match['module']}.weight"


def merged(weights: Mapping[str, Tensor], factors: Mapping[str, Tensor], dtype: torch.dtype) -> dict[str, Tensor]:
    """The weights in ``dtype``, with B A of the factors added in float32."""
    whole = {}
    for name, weight in weights.items():
        module = name.removesuffix(".weight")
        if _name(module, "A") in factors:
            weight = weight.float() + factors[_name(module, "B")].float() @ factors[_name(module, "A")].float()
        whole[name] = weight.to(dtype)
    return whole


def _name(module: str, side: str) -> str:
    return f"{module}.lora_{side}.weight"


def _check(module: str, weight: Tensor | None, pair: Mapping[str, Tensor]) -> None:
    if weight is None or pair.keys() != {"A", "B"}:
        raise CheckpointError(f"{module}: expected a weight and LoRA factors A and B, got {sorted(pair)}")
    shapes = [list(pair[side].shape) for side in ("B", "A")]
    if [len(shape) for shape in shapes] != [2, 2] or [shapes[0][0], shapes[1][1]] != list(weight.shape):
        raise CheckpointError(
            f"{module}: expected LoRA factors of {list(weight.shape)}, got {shapes[0]} and {shapes[1]}"
        )
    if shapes[0][1] != shapes[1][0]:
        raise CheckpointError(f"{module}: expected LoRA factors of one rank, got {shapes[0]} and {shapes[1]}")
