# SPDX-License-Identifier: MIT
"""A conversation, ready for a batch: its tokens, its videos, and the tokens whose hidden states are read.

L tokens.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from rfm.vlm.leaves import Leaf
from rfm.vlm.video import Indices, VlmVideo
from rfm_client.contract.samples import UInt8Array

Spans: TypeAlias = list[tuple[int, int]]


@dataclass(frozen=True, eq=False)
class VlmRow:
    """A conversation.

    input_ids: int64 [L]
    videos: of each trajectory
    spans: for each trajectory, the tokens (first, behind the last) whose states are read for each frame
    query: index of the token whose state gives preference or similarity; None: a single trajectory
    picked: in dense mode int64 [frame_steps], the frames in the conversation; None: all
    position_ids: int64 [3, L]
    packs: conversations about the same video that begin like this one, the trunk, and precede it (``rfm.vlm.tree``)
    alone: all conversations of a row with packs, as rows
    """

    input_ids: Indices
    videos: tuple[VlmVideo, ...]
    spans: tuple[Spans, ...]
    query: int | None
    is_similarity: bool
    picked: Indices | None = None
    position_ids: Indices = field(kw_only=True)
    packs: tuple[tuple[Leaf, ...], ...] = ()
    alone: tuple[VlmRow, ...] = ()

    @property
    def leaves(self) -> list[Leaf]:
        """The conversations that begin like this one, in order."""
        return [leaf for pack in self.packs for leaf in pack]

    @property
    def cost(self) -> int:
        """Number of tokens that the language model computes: the conversation's, and those that its leaves add."""
        return self.num_tokens + sum(leaf.num_tokens for leaf in self.leaves)

    @property
    def frames(self) -> tuple[Sequence[UInt8Array] | UInt8Array, ...]:
        """The frames of each trajectory before resizing, uint8 [H, W, 3] each."""
        return tuple(video.frames for video in self.videos)

    @property
    def shown(self) -> Iterator[tuple[VlmVideo, Indices]]:
        """Each trajectory, and the indices of its frames in the conversation."""
        return ((video, np.arange(video.num_shown) if self.picked is None else self.picked) for video in self.videos)

    @property
    def num_tokens(self) -> int:
        """L, the number of tokens in the conversation."""
        return len(self.input_ids)
