# SPDX-License-Identifier: MIT
"""Checkpoints of the first ReWiND code, the paper's: progress alone, under names of its own, without a configuration.

https://github.com/Jiahui-3205/ReWiND_Release. D width.
"""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from rfm.checkpoint.content import CheckpointError
from rfm.checkpoint.decision import Decision

_FIRST_FRAME = "first_pos_embed"  # [1, D]; added to the first frame
_UNREAD = "class_token"  # a parameter that its network never reads
# Its network always has so many heads and a causal mask. Its training script shows 16 frames unless told otherwise.
SETTINGS = {
    name: Decision(name, value, "default of the first ReWiND code", is_assumed=True)
    for name, value in {"num_attention_heads": 8, "causal_mask": True, "max_len": 16}.items()
}


def renamed(weights: Mapping[str, Tensor]) -> dict[str, Tensor] | None:
    """The weights under upstream's names; None: they are not of the first code's network."""
    if _FIRST_FRAME not in weights:
        return None
    kept = {name: tensor for name, tensor in weights.items() if name not in (_FIRST_FRAME, _UNREAD)}
    first = weights[_FIRST_FRAME]
    if first.dim() != 2:
        raise CheckpointError(f"{_FIRST_FRAME}: expected 2 axes, got {list(first.shape)}")
    return {**kept, "first_embedding_A": first[None]}
