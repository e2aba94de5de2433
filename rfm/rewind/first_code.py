# SPDX-License-Identifier: MIT
"""Checkpoints of the first ReWiND code, the paper's: progress alone, under names of its own, without a configuration.

https://github.com/Jiahui-3205/ReWiND_Release. D width.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from rfm.checkpoint.content import CheckpointError
from rfm.checkpoint.files import NETWORK_CONFIG

_FIRST_FRAME = "first_pos_embed"  # [1, D]; added to the first frame
_UNREAD = "class_token"  # a parameter that its network never reads
# Its network always has so many heads and a causal mask. Its training script shows 16 frames unless told otherwise.
SETTINGS: Mapping[str, Any] = {"num_attention_heads": 8, "causal_mask": True, "max_len": 16}


def renamed(weights: Mapping[str, Tensor]) -> dict[str, Tensor] | None:
    """The weights under upstream's names; None: they are not of the first code's network."""
    if _FIRST_FRAME not in weights:
        return None
    kept = {name: tensor for name, tensor in weights.items() if name not in (_FIRST_FRAME, _UNREAD)}
    first = weights[_FIRST_FRAME]
    if first.dim() != 2:
        raise CheckpointError(f"{_FIRST_FRAME}: expected 2 axes, got {list(first.shape)}")
    return {**kept, "first_embedding_A": first[None]}


def note(stated: Mapping[str, Any]) -> str | None:
    """A line for the user on what no file says, so that the first code decides it. ``stated``: what files say."""
    assumed = [f"{name} {value}" for name, value in SETTINGS.items() if name not in stated]
    if not assumed:
        return None
    return (
        f"a checkpoint of the first ReWiND code: {', '.join(assumed)} are assumed, as in that code; if the run had "
        f"another --max_length, state it as max_len in {NETWORK_CONFIG}"
    )
