# SPDX-License-Identifier: MIT
"""RynnValue's conversations, and batches with the places of their value tokens."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from rfm.vlm.batch import VlmBatch
from rfm.vlm.row import VlmRow


@dataclass(frozen=True, eq=False)
class RynnRow(VlmRow):
    """A conversation. is_analysed: it ends with the question for an analysis, which the model answers"""

    is_analysed: bool = field(kw_only=True)


@dataclass(frozen=True)
class RynnBatch(VlmBatch):
    """Conversations with G groups of value tokens and Q groups of relative value tokens.

    values, relatives: int64 [G] and [Q], index of the first token of each group among all tokens of the batch: the
        B * L of the conversations, then those of the packs
    last_tokens: int64 [A], index of the last token of each conversation that is analysed
    """

    values: Tensor = field(kw_only=True)
    relatives: Tensor = field(kw_only=True)
    last_tokens: Tensor = field(kw_only=True)

    @classmethod
    def of(
        cls, batch: VlmBatch, conversations: Sequence[RynnRow], relative_token: int, relative_copies: int
    ) -> RynnBatch:
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
        last = [index * length + row.num_tokens - 1 for index, row in enumerate(conversations) if row.is_analysed]
        last_tokens = torch.tensor(last, dtype=torch.int64)
        return cls(**vars(batch), values=values, relatives=relatives, last_tokens=last_tokens)

    def _changed(self, change: Callable[[Tensor], Tensor]) -> RynnBatch:
        own = {name: change(getattr(self, name)) for name in ("values", "relatives", "last_tokens")}
        return RynnBatch(**{**vars(super()._changed(change)), **own})
