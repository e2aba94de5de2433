# SPDX-License-Identifier: MIT
"""LoRA: a weight is W + alpha / r * B A (https://arxiv.org/abs/2106.09685); adapters in PEFT's format.

W and the factors stay separate until the network's dtype is known. W is usually bfloat16, and many updates are smaller
than half a bfloat16 step. A sum in bfloat16 would lose them, even for a float32 network.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import torch
from torch import Tensor

from rfm.files import CheckpointError
from rfm.qwen.rounded import is_rounded, shape_of

LORA_NAME = re.compile(r"(?P<module>.+)\.lora_(?P<side>[AB])(\.default)?\.weight")
BASE_LAYER = ".base_layer."
MERGE = "merge it where it was trained (merge_and_unload() of PEFT) and export the whole model that this makes"


def split(tensors: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Split tensors into weights and LoRA factors ``<module>.lora_A.weight`` and ``<module>.lora_B.weight``.

    Raises CheckpointError for factors that do not fit their weight.
    """
    weights: dict[str, Tensor] = {}
    pairs: dict[str, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        match = LORA_NAME.fullmatch(name)
        if match:
            pairs.setdefault(match["module"], {})[match["side"]] = tensor
        else:
            weights[name.replace(BASE_LAYER, ".")] = tensor
    factors: dict[str, Tensor] = {}
    for module, pair in pairs.items():
        _check_pair(module, weights.get(f"{module}.weight"), pair)
        factors |= {_name(module, side): pair[side] for side in "AB"}
    return weights, factors


def changed_by(factor: str) -> str:
    """Return the name of the weight that a factor changes."""
    return f"{module_of(factor)}.weight"


def module_of(factor: str) -> str:
    """Return the name of the module that a factor changes."""
    match = LORA_NAME.fullmatch(factor)
    assert match is not None
    return match["module"]


def merged(weights: Mapping[str, Tensor], factors: Mapping[str, Tensor], dtype: torch.dtype) -> dict[str, Tensor]:
    """Return the weights in ``dtype``, with B A added in float32; rounded weights keep their factors separate."""
    whole = {}
    for name, weight in weights.items():
        module = name.removesuffix(".weight")
        if is_rounded(name, weight):
            whole[name] = weight
            whole |= {each: factors[each].to(dtype) for side in "AB" if (each := _name(module, side)) in factors}
            continue
        if _name(module, "A") in factors:
            weight = weight.float() + factors[_name(module, "B")].float() @ factors[_name(module, "A")].float()
        whole[name] = weight.to(dtype)
    return whole


def _name(module: str, side: str) -> str:
    return f"{module}.lora_{side}.weight"


def _check_pair(module: str, weight: Tensor | None, pair: Mapping[str, Tensor]) -> None:
    if weight is None or pair.keys() != {"A", "B"}:
        raise CheckpointError.at(module, "a weight and LoRA factors A and B", sorted(pair))
    shapes = [list(pair[side].shape) for side in ("B", "A")]
    if [len(shape) for shape in shapes] != [2, 2] or [shapes[0][0], shapes[1][1]] != shape_of(weight):
        got = f"{shapes[0]} and {shapes[1]}"
        raise CheckpointError.at(module, f"LoRA factors of {shape_of(weight)}", got, MERGE)
    if shapes[0][1] != shapes[1][0]:
        raise CheckpointError.at(module, "LoRA factors of one rank", f"{shapes[0]} and {shapes[1]}")
