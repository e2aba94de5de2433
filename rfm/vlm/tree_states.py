# SPDX-License-Identifier: MIT
"""The language model's pass over trunks and the leaves behind them, with the layers of ``transformers``.

Each layer computes the trunks, keeps their keys and values, and then computes every call of packs, whose tokens see
them. So memory holds the keys and values of one layer. B trunks of L tokens, D width.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from rfm.vlm.leaves import Packs
from rfm.vlm.qwen import _cached


class TrunkKeyValues:
    """The keys and values of a layer's trunks, in the form of transformers' cache.

    packs: those whose tokens the layer computes; None: it computes the trunks
    """

    packs: Packs | None = None

    def __init__(self) -> None:
        self._of_trunks: tuple[Tensor, ...] = ()

    def update(self, keys: Tensor, values: Tensor, *_: Any, **__: Any) -> tuple[Tensor, Tensor]:
        """Keep a trunk's keys and values, [B, heads, L, D / heads]; return those that the tokens of a call may see."""
        if self.packs is None:
            self._of_trunks = keys, values
            return keys, values
        before = [each[self.packs.trunks, :, : self.packs.num_keys] for each in self._of_trunks]
        return torch.cat([before[0], keys], dim=2), torch.cat([before[1], values], dim=2)


class _Part:
    """The hidden states of the trunks, or of the packs of a call, from layer to layer."""

    def __init__(self, language: Any, inputs: dict[str, Tensor], features: Tensor) -> None:
        merged, *self._deeper = features.unbind(1)
        self._at, self._picked = inputs["visual_tokens"], inputs["visual_features"]
        self.hidden = language.embed_tokens(inputs["input_ids"])
        self.hidden.flatten(0, 1).index_copy_(0, self._at, merged[self._picked].to(self.hidden.dtype))
        self._turned = language.rotary_emb(self.hidden, inputs["position_ids"])

    def run(self, number: int, layer: Any, mask: Tensor | None, options: dict[str, Any]) -> None:
        hidden = layer(self.hidden, position_embeddings=self._turned, attention_mask=mask, **options)
        self.hidden = hidden[0] if isinstance(hidden, tuple) else hidden  # transformers 4.57 of Qwen2.5-VL
        if number < len(self._deeper):
            added = self._deeper[number][self._picked].to(self.hidden.dtype)
            self.hidden.flatten(0, 1).index_add_(0, self._at, added)


def tree_hidden_states(language: Any, inputs: dict[str, Tensor], packs: Sequence[Packs], features: Tensor) -> Tensor:
    """Return the hidden states behind the final norm, of the trunks and then of each call, [1, all tokens, D].

    language, inputs, features: as in ``rfm.vlm.qwen.last_hidden_state``, of the trunks
    """
    key_values = TrunkKeyValues()
    options = _cached(language, key_values)  # type: ignore[arg-type]  # transformers asks for ``update`` alone
    trunks, *calls = (_Part(language, each, features) for each in (inputs, *(each.inputs for each in packs)))
    # The mask of a single call is kept; those of several are made anew for each layer, so that memory holds one.
    kept = packs[0].mask() if len(packs) == 1 else None
    for number, layer in enumerate(language.layers):
        key_values.packs = None
        trunks.run(number, layer, None, options)
        for call, key_values.packs in zip(calls, packs, strict=True):
            call.run(number, layer, key_values.packs.mask() if kept is None else kept, options)
    return language.norm(torch.cat([part.hidden.flatten(0, 1) for part in (trunks, *calls)]))[None]
