# SPDX-License-Identifier: MIT
"""A batch of RynnValue's conversations, with the places of its value tokens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from rfm.qwen.batch import VlmBatch


@dataclass(frozen=True)
class RynnBatch(VlmBatch):
    """Conversations with G groups of value tokens and Q groups of relative value tokens.

    values, relatives: int64 [G] and [Q], index of the first token of each group among all tokens of the batch: the
        B * L of the conversations, then those of the packs
    """

    values: Tensor = field(kw_only=True)
    relatives: Tensor = field(kw_only=True)

    @classmethod
    def of(cls, batch: VlmBatch, relative_token: int, relative_copies: int) -> RynnBatch:
        """Return the batch whose spans hold, for each frame, its relative values (if any) and its values (if any)."""
        packs = [each.input_ids.flatten() for each in batch.packs]
        ids = torch.cat([batch.inputs["input_ids"].flatten(), *packs]).numpy()
        length = batch.inputs["input_ids"].shape[1]
        rows, starts, stops = batch.spans.numpy().reshape(-1, 3).T
        firsts, ends = rows * length + starts, rows * length + stops
        firsts, ends = firsts[starts < stops], ends[starts < stops]
        has_relative = ids[firsts] == relative_token
        behind = firsts + has_relative * relative_copies
        found = behind[behind < ends], firsts[has_relative]
        values, relatives = (torch.from_numpy(np.ascontiguousarray(each)) for each in found)
        return cls(**vars(batch), values=values, relatives=relatives)

    def _changed(self, change: Callable[[Tensor], Tensor]) -> RynnBatch:
        own = {"values": change(self.values), "relatives": change(self.relatives)}
        return RynnBatch(**{**vars(super()._changed(change)), **own})
