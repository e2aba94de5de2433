# SPDX-License-Identifier: MIT
"""Conversations that begin like another one: they reuse its shared tokens and add only the others.

The longest conversation is the trunk. A causal language model gives equal states to equal beginnings, so a leaf needs
only the tokens behind the shared ones. Packs hold consecutive leaves and share layer calls.

L tokens in a trunk, R packs in a call, P tokens in the longest, N leaf levels that a token sees.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Indices = npt.NDArray[np.int64]
MOST_PACK_TOKENS = 8192  # per call, with padding
MOST_MASK_BYTES = 64 * 2**20  # per mask: one byte for each pair (token, token that it may see)


@dataclass(frozen=True, eq=False)
class Leaf:
    """The tokens that a conversation adds behind those from the trunk and from other leaves in its pack.

    from_trunk: how many of the trunk's first tokens the leaf begins with
    from_leaves: index in the pack and token count, for each leaf whose first tokens follow
    input_ids: int64 [P], its tokens
    position_ids: int64 [3, P]
    shown: int64, the frames in the whole conversation
    reads: the tokens among the P (first, behind the last) whose states are read
    is_mutual: its tokens see each other in both directions; otherwise only earlier ones
    """

    from_trunk: int
    from_leaves: tuple[tuple[int, int], ...]
    input_ids: Indices
    position_ids: Indices
    shown: Indices
    reads: tuple[int, int]
    is_mutual: bool = False

    @property
    def num_tokens(self) -> int:
        """P, how many tokens the leaf adds."""
        return len(self.input_ids)


def fits(num_tokens: int, num_trunk_tokens: int) -> bool:
    """Return True if a pack of ``num_tokens`` behind a trunk stays within both limits."""
    return num_tokens <= MOST_PACK_TOKENS and num_tokens * (num_trunk_tokens + num_tokens) <= MOST_MASK_BYTES


@dataclass(frozen=True)
class Packs:
    """The packs in one call, padded behind their tokens.

    trunks: int64 [R], the packs' trunks as indices in the batch
    num_keys: tokens in the longest of these trunks
    input_ids: int64 [R, P]
    position_ids: int64 [3, R, P]
    visual_tokens, visual_features: as in ``rfm.qwen.backbone.Part``
    from_trunk: int64 [R, P], how many trunk tokens a token sees
    leaves, places: int64 [R, P], a token's leaf and its place there; -1 and 0 for padding
    seen, upto: int64 [N, R, P], leaves that a token sees, its own first, and how many tokens in each
    """

    trunks: Tensor
    num_keys: int
    input_ids: Tensor
    position_ids: Tensor
    visual_tokens: Tensor
    visual_features: Tensor
    from_trunk: Tensor
    leaves: Tensor
    places: Tensor
    seen: Tensor
    upto: Tensor

    @property
    def inputs(self) -> dict[str, Tensor]:
        """The arguments for a language model, under the names that a batch uses."""
        return {name: getattr(self, name) for name in ("input_ids", "position_ids", "visual_tokens", "visual_features")}

    def mask(self) -> Tensor:
        """Return which trunk and pack tokens each token sees, bool [R, 1, P, num_keys + P]."""
        keys = torch.arange(self.num_keys, device=self.from_trunk.device)
        own = torch.zeros_like(self.leaves[:, None] == self.leaves[..., None])
        for leaf, upto in zip(self.seen, self.upto, strict=True):
            own |= (self.leaves[:, None] == leaf[..., None]) & (self.places[:, None] < upto[..., None])
        return torch.cat([keys < self.from_trunk[..., None], own], dim=-1)[:, None]


@dataclass(frozen=True)
class PlacedPack:
    """A trunk's pack. trunk: index in the batch; num_keys: tokens in the trunk."""

    trunk: int
    num_keys: int
    leaves: tuple[Leaf, ...]

    @property
    def num_tokens(self) -> int:
        """How many tokens the pack has."""
        return sum(leaf.num_tokens for leaf in self.leaves)


def calls(packs: Sequence[PlacedPack]) -> Iterator[list[PlacedPack]]:
    """Yield the packs for each call: similar in length, within the limits with their padding."""
    part: list[PlacedPack] = []
    for pack in sorted(packs, key=lambda pack: pack.num_tokens):
        count = (len(part) + 1) * pack.num_tokens
        num_keys = max([pack.num_keys, *(each.num_keys for each in part)])
        bytes_of_mask = count * (num_keys + pack.num_tokens)
        if part and (count > MOST_PACK_TOKENS or bytes_of_mask > MOST_MASK_BYTES):
            yield part
            part = []
        part.append(pack)
    if part:
        yield part


def padded(
    packs: Sequence[PlacedPack], pad: int, visual_pad: int, features: Callable[[Leaf], Indices]
) -> tuple[Packs, dict[Leaf, int]]:
    """Return the packs for one call, and the index of each leaf's first token among the call's R * P tokens.

    pad, visual_pad: the padding token, the vision token
    features: returns the feature indices that a whole conversation shows, int64
    """
    longest, levels = max(pack.num_tokens for pack in packs), 1
    levels += max(len(leaf.from_leaves) for pack in packs for leaf in pack.leaves)
    shape = (len(packs), longest)
    ids, leaves, places = np.full(shape, pad), np.full(shape, -1), np.zeros(shape, np.int64)
    positions, from_trunk = np.zeros((3, *shape), np.int64), np.ones(shape, np.int64)  # padding sees one token
    seen, upto = np.zeros((levels, *shape), np.int64), np.zeros((levels, *shape), np.int64)
    of_features, starts = [], dict[Leaf, int]()
    for row, pack in enumerate(packs):
        start = 0
        for index, leaf in enumerate(pack.leaves):
            at = (row, slice(start, start + leaf.num_tokens))
            starts[leaf] = row * longest + start
            start += leaf.num_tokens
            ids[at], leaves[at], from_trunk[at] = leaf.input_ids, index, leaf.from_trunk
            positions[:, at[0], at[1]] = leaf.position_ids
            places[at] = np.arange(leaf.num_tokens)
            own = leaf.num_tokens if leaf.is_mutual else places[at] + 1
            for level, (other, count) in enumerate(((index, own), *leaf.from_leaves)):
                seen[(level, *at)], upto[(level, *at)] = other, count
            num_visual = int((leaf.input_ids == visual_pad).sum())
            shown = features(leaf)
            of_features.append(shown[len(shown) - num_visual :])
    at_features = np.flatnonzero(ids == visual_pad)
    arrays = ids, positions, at_features, np.concatenate(of_features), from_trunk, leaves, places, seen, upto
    trunks = torch.tensor([pack.trunk for pack in packs])
    return Packs(trunks, max(pack.num_keys for pack in packs), *map(torch.from_numpy, arrays)), starts
