# SPDX-License-Identifier: MIT
"""The decoder layers of the Qwen language models, with fewer calls and kernels than in ``transformers``.

The parameters are those of transformers' layers, and so is every rounding. Queries and keys are normalised and turned
together, by sines whose first half is negated once per pass.

B conversations, L tokens, width D, S tokens that they see, E = D / heads.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Any, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Cache(Protocol):
    """Keeps keys and values of earlier tokens."""

    def update(self, keys: Tensor, values: Tensor, layer: int) -> tuple[Tensor, Tensor]:
        """Add those of new tokens, [B, heads, L, E], and return those of all tokens that they see, [B, heads, S, E]."""
        ...


class DecoderLayer:
    """A layer: transformers' ``layer`` with this number."""

    def __init__(self, layer: Any, number: int) -> None:
        attention = layer.self_attn
        self._layer, self._attention, self._number = layer, attention, number
        self._head_dim, self._scale = attention.head_dim, attention.scaling
        self._groups = attention.num_key_value_groups
        num_keys = attention.config.num_key_value_heads
        self._num_heads = [num_keys * self._groups, num_keys]
        self._norm, self._sources = None, _sources(layer)
        if hasattr(attention, "q_norm"):  # Qwen3-VL
            # Kept, so that no other weight gets their addresses.
            self._weights = [norm.weight.detach() for norm in (attention.q_norm, attention.k_norm)]
            weight = torch.cat([w.expand(count, -1) for w, count in zip(self._weights, self._num_heads, strict=True)])
            self._norm = deepcopy(attention.q_norm)
            self._norm.weight = nn.Parameter(weight, requires_grad=False)  # [heads of queries and keys, E]

    def __call__(self, states: Tensor, turn: tuple[Tensor, Tensor], mask: Tensor | None, cache: Cache | None) -> Tensor:
        """Return the states behind the layer, [B, L, D] -> [B, L, D].

        turn: as from ``turn_of``
        mask: bool [B, 1, L, S], the tokens that each token sees; None: the earlier ones
        cache: receives the keys and values; None: the tokens see only each other
        """
        layer, attention, shape = self._layer, self._attention, (*states.shape[:2], -1, self._head_dim)
        x = layer.input_layernorm(states)
        heads = torch.cat((attention.q_proj(x), attention.k_proj(x)), dim=-1).view(shape)
        if self._norm is not None:
            heads = self._norm(heads)
        cosine, sine = turn
        heads = heads * cosine + heads.roll(self._head_dim // 2, -1) * sine
        query, key = heads.transpose(1, 2).split(self._num_heads, dim=1)
        value = attention.v_proj(x).view(shape).transpose(1, 2)
        if cache is not None:
            key, value = cache.update(key, value, self._number)
        if mask is not None:  # the kernels that take a mask share no keys between heads
            key, value = (each[:, :, None].expand(-1, -1, self._groups, -1, -1).flatten(1, 2) for each in (key, value))
        mixed = F.scaled_dot_product_attention(
            query,
            key,
            value,
            mask,
            scale=self._scale,
            is_causal=mask is None and shape[1] > 1,
            enable_gqa=mask is None,
        )
        states = states + attention.o_proj(mixed.transpose(1, 2).flatten(2))
        return states + layer.mlp(layer.post_attention_layernorm(states))


def turn_of(language: Any, states: Tensor, position_ids: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rotary embedding of tokens: cosine and sine, [B, L, 1, E]; the first half of the sines is negated.

    states: [B, L, D]; position_ids: int64 [3, B, L]
    """
    cosine, sine = language.rotary_emb(states, position_ids)
    if cosine.ndim == 4:  # Qwen2.5-VL of transformers 4.57: each coordinate's, of which a token has sections
        sections = language.config.rope_scaling["mrope_section"] * 2
        cosine, sine = (
            torch.cat([part[number % 3] for number, part in enumerate(each.split(sections, dim=-1))], dim=-1)
            for each in (cosine, sine)
        )
    first, second = sine.chunk(2, dim=-1)
    return cosine.unsqueeze(2), torch.cat((-first, second), dim=-1).unsqueeze(2)


def decoder_layers(language: Any) -> list[DecoderLayer]:
    """Return the layers of transformers' language model, made again if layers or weights of norms have changed.

    Raises RuntimeError if that happens while a CUDA graph is captured: a copy made then has no values yet.
    """
    made: list[DecoderLayer] = vars(language).get("_decoder_layers", [])
    layers = list(language.layers)
    if [each._sources for each in made] != [_sources(layer) for layer in layers]:  # a layer holds copies of them
        if torch.cuda.is_available() and torch.cuda.is_current_stream_capturing():
            raise RuntimeError("expected the weights of the last pass, got others")
        made = [DecoderLayer(layer, number) for number, layer in enumerate(layers)]
        vars(language)["_decoder_layers"] = made
    return made


def _sources(layer: Any) -> tuple[object, ...]:
    """Return what differs once the layer, or a weight that ``DecoderLayer`` copies, is another."""
    modules = layer._modules["self_attn"]._modules  # as attributes, they would take 0.2 ms per pass
    weights = [modules[name]._parameters["weight"] for name in ("q_norm", "k_norm") if name in modules]
    # Inference tensors count no changes.
    return layer, *((w.data_ptr(), object() if w.is_inference() else w._version) for w in weights)
