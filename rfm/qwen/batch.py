# SPDX-License-Identifier: MIT
"""Conversations, and batches of them."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from rfm.engine.layers import changed, concatenated
from rfm.qwen.backbone import VisionPlan
from rfm.qwen.images import Grid, QwenImages
from rfm.qwen.leaves import Leaf, Packs
from rfm.qwen.video import Indices, Shot, SizedFrames, VlmVideo, shots_of

Spans: TypeAlias = list[tuple[int, int]]


@dataclass(frozen=True, eq=False)
class VlmRow:
    """A conversation.

    input_ids: int64 [L]
    videos: one per trajectory
    spans: per trajectory and frame, the tokens (first, behind the last) whose states are read
    query: index of the token whose state gives preference or similarity; None: a single trajectory
    picked: in dense mode int64 [frame_steps], the frames in the conversation; None: all
    position_ids: int64 [3, L]
    packs: conversations about the same video that begin like this one, the trunk, and precede it (``rfm.qwen.tree``)
    alone: for a row with packs, all its conversations as separate rows
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
        """How many tokens the language model computes: this conversation and what its leaves add."""
        return self.num_tokens + sum(leaf.num_tokens for leaf in self.leaves)

    @property
    def shown(self) -> Iterator[tuple[VlmVideo, Indices]]:
        """The trajectories with their frame indices in the conversation."""
        return ((video, np.arange(video.num_shown) if self.picked is None else self.picked) for video in self.videos)

    @property
    def num_tokens(self) -> int:
        """L, how many tokens the conversation has."""
        return len(self.input_ids)


@dataclass(eq=False)
class SizedShots:
    """Uncached shots with one size for the vision tower.

    videos: frames per video, uint8 [N, H', W', 3]
    firsts: index of a video's first frame among all videos' frames
    shots: indices of a shot's frames among all videos' frames, by key
    """

    videos: list[Tensor] = field(default_factory=list)
    firsts: dict[SizedFrames, int] = field(default_factory=dict)
    shots: dict[Hashable, Shot] = field(default_factory=dict)

    def add(self, sized: SizedFrames, key: Hashable, shot: Shot) -> None:
        """Add a video's shot."""
        if sized not in self.firsts:
            self.firsts[sized] = sum(map(len, self.videos))
            self.videos.append(sized.pixels)
        places = [int(sized.places[frame]) for frame in shot]
        assert min(places) >= 0  # the shot is not cached
        self.shots[key] = tuple(self.firsts[sized] + place for place in places)

    def grid(self, images: QwenImages) -> Grid:
        """Return the grid in which ``groups`` counts the shots."""
        return images.grid(len(self.shots), *self.videos[0].shape[1:3])

    def indices(self) -> Tensor | None:
        """Return the frame indices of S shots, int64 [S, 1] or [S, 2]; None: each frame is an image."""
        shots = torch.tensor(list(self.shots.values()))
        is_each = torch.equal(shots, torch.arange(sum(map(len, self.videos)))[:, None])
        return None if is_each else shots


class Shots:
    """The distinct shots in a batch.

    are_images: each frame is a shot; otherwise each pair
    """

    def __init__(self, *, are_images: bool) -> None:
        self._are_images = are_images
        self._of_size: dict[torch.Size, SizedShots] = {}
        self._kept: dict[Hashable, Tensor] = {}
        self._seen: set[Hashable] = set()

    @property
    def sizes(self) -> list[SizedShots]:
        """The uncached shots by size, in the order in which they were added."""
        return list(self._of_size.values())

    def add(self, video: VlmVideo, shown: Indices) -> list[Hashable]:
        """Add the shots in a conversation that shows these video frames; return their keys."""
        sized, keys = video.ready, []
        for shot in shots_of(shown, are_images=self._are_images):
            key = sized.keys[shot]
            keys.append(key)
            if key in self._seen:
                continue
            self._seen.add(key)
            if key in sized.kept:
                self._kept[key] = sized.kept[key]
            else:
                self._of_size.setdefault(sized.pixels.shape[1:3], SizedShots()).add(sized, key, shot)
        return keys

    def layout(self, tokens_per_shot: Sequence[int]) -> Layout:
        """Return the layout of the shots' tokens. ``tokens_per_shot`` follows ``sizes``."""
        made: dict[Hashable, slice] = {}
        start = 0
        for size, tokens in zip(self.sizes, tokens_per_shot, strict=True):
            for key in size.shots:
                made[key] = slice(start, start + tokens)
                start += tokens
        return Layout(made, self._kept)


@dataclass(frozen=True)
class QwenPixels:
    """Pixels for the Qwen backbones: patches from images or frame pairs, size by size.

    videos: frames by size and video, uint8 [T, H', W', 3] each
    shots: as ``SizedShots.indices``, by size
    """

    images: QwenImages
    videos: Sequence[Sequence[Tensor]]
    shots: Sequence[Tensor | None]

    @property
    def num_shown(self) -> int:
        """How many frames all shots have; a frame that fills up a pair counts twice."""
        of_sizes = zip(self.videos, self.shots, strict=True)
        return sum(sum(map(len, videos)) if shots is None else shots.numel() for videos, shots in of_sizes)

    def changed(self, change: Callable[[Tensor], Tensor]) -> QwenPixels:
        """Return these pixels with ``change`` applied to the shots' indices."""
        return replace(self, shots=[None if shots is None else change(shots) for shots in self.shots])

    def inputs(self, device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
        """Return the backbone's input: the patches of all shots on ``device``."""
        patches = []
        for videos, shots in zip(self.videos, self.shots, strict=True):
            frames = concatenated([video.to(device, non_blocking=True) for video in videos])
            patches.append(self.images.patches(frames, shots, dtype))
        return {"pixel_values": concatenated(patches)} if patches else {}


class Layout:
    """The indices of the shots' merged tokens: those from the vision tower by size, then those from the cache.

    made: indices by shot, for shots that the tower reads
    kept: features of cached shots, [tokens, levels, D]
    """

    def __init__(self, made: dict[Hashable, slice], kept: dict[Hashable, Tensor]) -> None:
        self.made, self.kept = made, kept
        self._tokens, start = dict(made), max((tokens.stop for tokens in made.values()), default=0)
        for key, features in kept.items():
            self._tokens[key] = slice(start, start + len(features))
            start += len(features)

    def tokens(self, keys: Sequence[Hashable]) -> Indices:
        """Return the indices of the merged tokens of equally large shots, in order, int64 [M]."""
        first = self._tokens[keys[0]]
        starts = np.array([self._tokens[key].start for key in keys], np.int64)
        tokens: Indices = (starts[:, None] + np.arange(first.stop - first.start)).ravel()
        return tokens


@dataclass(frozen=True)
class VlmBatch:
    """Conversations, padded to the longest, with F frames (or temporal patches) and Q queries.

    Spans and queries are indices among all tokens: the conversations' B * L, then those in the packs.

    inputs: the backbone's arguments by name
    spans: int64 [F, 2], per frame the first token and the token behind the last whose states are read
    queries: int64 [Q], the queries' tokens
    num_tokens, num_span_tokens: tokens without padding; tokens in all spans
    pixels: source of the pixel arguments; None: these are in ``inputs``
    plan: for the vision tower; None: all shots are cached
    layout: where the shots' tokens lie
    packs: conversations that begin like others (``rfm.qwen.tree``)
    """

    inputs: dict[str, Tensor]
    spans: Tensor
    queries: Tensor
    num_tokens: int
    num_span_tokens: int
    pixels: QwenPixels | None
    plan: VisionPlan | None
    layout: Layout
    packs: tuple[Packs, ...]

    @property
    def num_slots(self) -> int:
        """How many tokens there are, with padding."""
        return sum(ids.numel() for ids in (self.inputs["input_ids"], *(packs.input_ids for packs in self.packs)))

    def pinned(self) -> VlmBatch:
        """Return the batch with all tensors except the frames in pinned memory, which a GPU copies asynchronously."""
        return self._changed(Tensor.pin_memory)

    def to(self, device: torch.device, dtype: torch.dtype) -> VlmBatch:
        """Return the batch on ``device``, where pixels are normalised, cut into patches and converted to ``dtype``."""
        moved = self._changed(lambda tensor: tensor.to(device, non_blocking=True))
        made = {} if moved.pixels is None else moved.pixels.inputs(device, dtype)
        return replace(moved, inputs=moved.inputs | made, pixels=None)

    def _changed(self, change: Callable[[Tensor], Tensor]) -> VlmBatch:
        return replace(
            changed(self, change),
            inputs={name: change(tensor) for name, tensor in self.inputs.items()},
            pixels=None if self.pixels is None else self.pixels.changed(change),
            plan=None if self.plan is None else changed(self.plan, change),
            packs=tuple(changed(packs, change) for packs in self.packs),
        )
