# SPDX-License-Identifier: MIT
"""Find conversations that begin alike, and make a tree (a trunk with leaves) where this saves tokens.

The last conversation about a video is the trunk: in TOPReward the whole episode. Each other conversation continues the
trunk or the leaf before it, whichever shares more tokens with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from rfm.qwen.batch import VlmRow
from rfm.qwen.leaves import Leaf, fits
from rfm.qwen.video import Indices, Shot, shots_of

WORTH = 1.5  # a tree pays if it has this many times fewer tokens; otherwise padded rows are as fast
MOST_LEAF_TOKENS = 65_536  # limit per tree, which bounds the shots and states held during a pass


@dataclass(frozen=True, eq=False)
class Conversation:
    """A row with its shots.

    starts: first token of each shot
    """

    row: VlmRow
    shots: list[Shot]
    starts: Indices

    @classmethod
    def of(cls, row: VlmRow, pad: int, *, are_images: bool) -> Conversation:
        """Return a conversation about one video. ``pad``: the vision token."""
        ((_, shown),) = row.shown
        shots = list(shots_of(shown, are_images=are_images))
        at = np.flatnonzero(row.input_ids == pad)
        return cls(row, shots, at[:: len(at) // len(shots)])

    @property
    def reads(self) -> tuple[int, int]:
        """The tokens (first, behind the last) whose states are read: the query, or those for the last frame."""
        if self.row.query is not None:
            return self.row.query, self.row.query + 1
        return self.row.spans[0][-1]

    def shared(self, other: Conversation) -> int:
        """Return how many first tokens equal those in ``other``, also in position and features."""
        row, before = self.row, other.row
        most = min(row.num_tokens, before.num_tokens, self.reads[0])
        pairs = enumerate(zip(self.shots, other.shots, strict=False))
        differing = next((number for number, (shot, another) in pairs if shot != another), None)
        if differing is not None:
            most = min(most, int(self.starts[differing]))
        same = row.input_ids[:most] == before.input_ids[:most]
        same &= (row.position_ids[:, :most] == before.position_ids[:, :most]).all(0)
        return most if same.all() else int(same.argmin())

    def leaf(self, from_trunk: int, from_leaves: tuple[tuple[int, int], ...] = ()) -> Leaf:
        """Return the tokens behind those from the trunk and from leaves."""
        start = from_trunk + sum(count for _, count in from_leaves)
        assert self.row.picked is not None
        first, behind = self.reads
        ids, positions = self.row.input_ids[start:].copy(), self.row.position_ids[:, start:].copy()
        return Leaf(from_trunk, from_leaves, ids, positions, self.row.picked, (first - start, behind - start))


def trees(rows: Sequence[VlmRow], pad: int, *, are_images: bool) -> list[VlmRow]:
    """Return a sample's rows as trees, or unchanged where a tree saves too little. The order stays.

    pad: the vision token
    are_images: each frame is a shot; otherwise each pair
    """
    found: list[VlmRow] = []
    for _, group in groupby(rows, key=lambda row: id(row.videos[0])):
        of_video = list(group)
        if len(of_video) == 1 or of_video[0].packs:  # trees already
            found += of_video
        else:
            found += _trees([Conversation.of(row, pad, are_images=are_images) for row in of_video])
    return found


def _trees(conversations: Sequence[Conversation]) -> list[VlmRow]:
    """Return one tree, or one per half if it would be too large."""
    rows = [each.row for each in conversations]
    packs = _packs(conversations[:-1], conversations[-1])
    ends: tuple[list[tuple[int, int]]] = ([] if rows[-1].query is not None else [conversations[-1].reads],)
    tree = replace(rows[-1], packs=packs, spans=ends, alone=tuple(rows))
    trunk = tree.num_tokens
    is_bounded = all(fits(sum(leaf.num_tokens for leaf in pack), trunk) for pack in packs)
    if not is_bounded or tree.cost - trunk > MOST_LEAF_TOKENS:
        half = len(rows) // 2
        return [*_trees(conversations[:half]), *_trees(conversations[half:])]
    return [tree] if packs and sum(row.num_tokens for row in rows) >= WORTH * tree.cost else rows


def _packs(conversations: Sequence[Conversation], trunk: Conversation) -> tuple[tuple[Leaf, ...], ...]:
    """Return the leaves of all conversations. A leaf that does not fit into the last pack starts a new one."""
    packs: list[list[Leaf]] = []
    num_tokens, before = 0, trunk
    for conversation in conversations:
        from_trunk = conversation.shared(trunk)
        leaf = conversation.leaf(from_trunk)
        if packs and (shared := conversation.shared(before)) > from_trunk:
            leaf = conversation.leaf(*_path(packs[-1], shared))
        if not packs or not fits(num_tokens + leaf.num_tokens, trunk.row.num_tokens):
            leaf, num_tokens = conversation.leaf(from_trunk), 0
            packs.append([])
        packs[-1].append(leaf)
        num_tokens, before = num_tokens + leaf.num_tokens, conversation
    return tuple(map(tuple, packs))


def _path(pack: Sequence[Leaf], count: int) -> tuple[int, tuple[tuple[int, int], ...]]:
    """Return where the last conversation's first ``count`` tokens lie: in the trunk, and in leaves."""
    last = pack[-1]
    from_trunk = min(last.from_trunk, count)
    from_leaves, rest = [], count - from_trunk
    for leaf, most in (*last.from_leaves, (len(pack) - 1, last.num_tokens)):
        if taken := min(most, rest):
            from_leaves.append((leaf, taken))
            rest -= taken
    return from_trunk, tuple(from_leaves)
