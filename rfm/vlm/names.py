# SPDX-License-Identifier: MIT
"""Names of weights as training code, transformers and PEFT write them, and as VlmRewardModel has them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TypeAlias

from torch import Tensor

from rfm.checkpoint.content import CheckpointError, shown

# Renames of one form, tried in order on each name; the first that matches is applied.
Renames: TypeAlias = Sequence[tuple[str, str]]
SMOL_NAMES: Renames = ((r"^model\.model\.", "model."),)
LORA_INSIDE: Renames = ((r"^(model(\.\w+)?)\.base_model\.model\.", r"\1."),)
ADAPTER_NAMES: Renames = ((r"^base_model\.model\.", "model."),)
# Of a Qwen backbone as transformers had its weights before 4.52, and as it writes them since in some cases.
QWEN_NAMES: Renames = (
    (r"^visual\.", "model.visual."),
    (r"^model\.(embed_tokens|layers|norm)\.", r"model.language_model.\1."),
)

# What makes text, which no reward head reads; the rotary frequencies, which transformers once saved, and computes.
UNUSED = re.compile(r"(model\.)?lm_head\.weight|.*\.(rotary_emb|rotary_pos_emb)\.(original_)?inv_freq")
# What bitsandbytes, GPTQ, AWQ and FP8 write beside or in place of a weight.
QUANTIZED = re.compile(
    r"\.(absmax|quant_map|nested_absmax|SCB|qweight|qzeros|weight_packed|weight_scale|weight_scale_inv)$|\.quant_state\."
)


def renamed(weights: Mapping[str, Tensor], renames: Renames) -> dict[str, Tensor]:
    """The weights under other names. Raises CheckpointError if two would have one."""

    def rename(name: str) -> str:
        for pattern, replacement in renames:
            changed, count = re.subn(pattern, replacement, name)
            if count:
                return changed
        return name

    names = {rename(name): name for name in weights}
    if len(names) < len(weights):
        twice = next(name for name in weights if names[rename(name)] != name)
        got = f"{shown(twice)} and {shown(names[rename(twice)])}"
        raise CheckpointError(f"{rename(twice)}: expected one weight, got {got}; remove the one that is not meant")
    return {name: weights[old] for name, old in names.items()}
