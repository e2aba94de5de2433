# SPDX-License-Identifier: MIT
"""The forward pass of the Qwen backbones, through the layers of ``transformers``' modules, in which no step waits.

B conversations of L tokens, D width, M visual tokens of all conversations. Where everything stands is worked out on the
host beforehand: the device is asked for nothing, so that it never runs out of work. Padding stands behind the tokens,
where causal attention does not see it: no mask is needed, and PyTorch's fastest attention takes none.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from rfm.checkpoint.content import CheckpointError

FULL_ATTENTION = "full_attention"


def last_hidden_state(language: Any, inputs: dict[str, Tensor], features: Tensor) -> Tensor:
    """[B, L, D], behind the final norm.

    language: transformers' language model
    inputs: of a batch on its device
    input_ids: int64 [B, L]; position_ids: int64 [3, B, L]
    visual_tokens: int64 [M], where visual tokens stand among all B * L
    visual_features: int64 [M], which of the shots' merged tokens each of them is
    features: [N, levels, D], the merged tokens of all shots
    """
    at, picked = inputs["visual_tokens"], inputs["visual_features"]
    merged, *deeper = features.unbind(1)
    hidden = language.embed_tokens(inputs["input_ids"])
    hidden.flatten(0, 1).index_copy_(0, at, merged[picked].to(hidden.dtype))
    turned = language.rotary_emb(hidden, inputs["position_ids"])
    for number, layer in enumerate(language.layers):
        hidden = layer(hidden, position_embeddings=turned, attention_mask=None)
        hidden = hidden[0] if isinstance(hidden, tuple) else hidden  # transformers 4.57 of Qwen2.5-VL
        if number < len(deeper):
            hidden.flatten(0, 1).index_add_(0, at, deeper[number][picked].to(hidden.dtype))
    return language.norm(hidden)


def check_attention(backbone: Any) -> None:
    """Raises CheckpointError for a language model with layers that do not see all tokens before."""
    kinds = set(getattr(backbone.config.get_text_config(), "layer_types", None) or [FULL_ATTENTION])
    if kinds != {FULL_ATTENTION}:
        raise CheckpointError(f"text_config.layer_types: expected {FULL_ATTENTION} alone, got {sorted(kinds)}")
