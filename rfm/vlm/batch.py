# SPDX-License-Identifier: MIT
"""A batch of conversations on its way to the device: tokens and uint8 pixels on the host, float pixels on the device.

B conversations of L tokens. Each shot is there once, whichever videos and conversations it stands in. Frames of one
size, H' x W' pixels, go together.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from rfm.engine.device import pinned
from rfm.vlm.images import QwenImages, SmolImages
from rfm.vlm.qwen import VisionPlan
from rfm.vlm.video import Indices, Shot, SizedFrames, VlmVideo, shots_of


@dataclass(eq=False)
class SizedShots:
    """Shots of one size that the vision tower is to read.

    videos: uint8 [N, H', W', 3] each
    firsts: of each video, by the id of its sized frames, the first among those of all videos
    shots: by key, its frames among those of all videos
    """

    videos: list[Tensor] = field(default_factory=list)
    firsts: dict[int, int] = field(default_factory=dict)
    shots: dict[Hashable, Shot] = field(default_factory=dict)

    def add(self, sized: SizedFrames, key: Hashable, shot: Shot) -> None:
        """Adds a shot of a video."""
        if id(sized) not in self.firsts:
            self.firsts[id(sized)] = sum(map(len, self.videos))
            self.videos.append(sized.pixels)
        first = self.firsts[id(sized)]
        places = [int(sized.places[frame]) for frame in shot]
        assert min(places) >= 0  # it is not kept
        self.shots[key] = tuple(first + place for place in places)

    def frames(self) -> FramesOfOneSize:
        """The videos, and which of their frames each shot is made of."""
        shots = torch.tensor(list(self.shots.values()))
        is_each = torch.equal(shots, torch.arange(sum(map(len, self.videos)))[:, None])
        return FramesOfOneSize(self.videos, None if is_each else shots)


class Shots:
    """Finds the shots of a batch.

    are_images: each frame is a shot; else two
    """

    def __init__(self, *, are_images: bool) -> None:
        self._are_images = are_images
        self._of_size: dict[torch.Size, SizedShots] = {}
        self._kept: dict[Hashable, Tensor] = {}
        self._seen: set[Hashable] = set()
        self._sized: list[SizedFrames] = []  # whose ids are taken

    @property
    def sizes(self) -> list[SizedShots]:
        """The shots of each size that are to be read, in the order in which they first came."""
        return list(self._of_size.values())

    def add(self, video: VlmVideo, shown: Indices) -> list[Hashable]:
        """The keys of the shots of a conversation that shows these frames of a video."""
        sized, keys = video.ready, []
        self._sized.append(sized)
        for shot in shots_of(shown, are_images=self._are_images):
            key = sized.keys[shot]
            if key not in self._seen:
                self._seen.add(key)
                self._place(sized, key, shot)
            keys.append(key)
        return keys

    def layout(self, tokens_per_shot: Sequence[int]) -> Layout:
        """Where each shot's tokens lie. ``tokens_per_shot``: of each of ``sizes``."""
        made: dict[Hashable, slice] = {}
        start = 0
        for size, tokens in zip(self.sizes, tokens_per_shot, strict=True):
            for key in size.shots:
                made[key] = slice(start, start + tokens)
                start += tokens
        return Layout(made, self._kept)

    def _place(self, sized: SizedFrames, key: Hashable, shot: Shot) -> None:
        if key in sized.kept:
            self._kept[key] = sized.kept[key]
        else:
            self._of_size.setdefault(sized.pixels.shape[1:3], SizedShots()).add(sized, key, shot)


@dataclass(frozen=True)
class FramesOfOneSize:
    """Frames that share a size, video by video, and the shots that are read of them.

    videos: uint8 [T, H', W', 3] each
    shots: int64 [S, 1], which frames are images, or [S, 2], which pairs are temporal groups; None: each frame an image
    """

    videos: Sequence[Tensor]
    shots: Tensor | None

    @property
    def num_shown(self) -> int:
        """Frames in the shots; of a group that is filled up with a frame, that frame twice."""
        return sum(map(len, self.videos)) if self.shots is None else self.shots.numel()

    def frames(self, device: torch.device) -> Tensor:
        """uint8 [T of all videos, H', W', 3] on ``device``."""
        return torch.cat([video.to(device, non_blocking=True) for video in self.videos])


@dataclass(frozen=True)
class QwenPixels:
    """Pixels as the Qwen backbones read them: patches of images, or of pairs of frames, in the order of ``sizes``."""

    images: QwenImages
    sizes: Sequence[FramesOfOneSize]

    @property
    def videos(self) -> list[Tensor]:
        """uint8 [T, H', W', 3] each."""
        return [video for size in self.sizes for video in size.videos]

    @property
    def num_shown(self) -> int:
        """Frames of all shots."""
        return sum(size.num_shown for size in self.sizes)

    def changed(self, change: Callable[[Tensor], Tensor]) -> QwenPixels:
        """The same with ``change`` made to the shots."""
        shots = [None if size.shots is None else change(size.shots) for size in self.sizes]
        sizes = [replace(size, shots=changed) for size, changed in zip(self.sizes, shots, strict=True)]
        return replace(self, sizes=sizes)

    def inputs(self, device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
        """The patches of all shots."""
        patches = [self.images.patches(size.frames(device), size.shots, dtype) for size in self.sizes]
        return {"pixel_values": torch.cat(patches) if len(patches) > 1 else patches[0]}


@dataclass(frozen=True)
class SmolPixels:
    """Pixels as SmolVLM reads them: of each conversation as many squares as of the one with the most.

    squares: uint8 [T, side, side, 3] of all videos
    rows, places, frames: int64 [I], in which conversation each square stands, at which place, and which frame it is
    shape: conversations, and squares of each
    """

    images: SmolImages
    squares: FramesOfOneSize
    rows: Tensor
    places: Tensor
    frames: Tensor
    shape: tuple[int, int]

    @property
    def videos(self) -> list[Tensor]:
        """uint8 [T, side, side, 3] each."""
        return list(self.squares.videos)

    @property
    def num_shown(self) -> int:
        """Frames of all squares."""
        return self.squares.num_shown

    def changed(self, change: Callable[[Tensor], Tensor]) -> SmolPixels:
        """The same with ``change`` made to where each square stands."""
        return replace(self, rows=change(self.rows), places=change(self.places), frames=change(self.frames))

    def inputs(self, device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
        """The squares, and where there are some; the backbone leaves out squares of zeros."""
        squares = self.images.normalisation(self.squares.frames(device)).to(dtype)
        pixels = squares.new_zeros(*self.shape, *squares.shape[1:])
        mask = torch.zeros(*self.shape, *squares.shape[2:], dtype=torch.bool, device=device)
        pixels[self.rows, self.places] = squares[self.frames]
        mask[self.rows, self.places] = True
        return {"pixel_values": pixels, "pixel_attention_mask": mask}


class Layout:
    """Where the merged tokens of each shot lie: those that the tower makes in order of size, then those that are kept.

    made: of each shot that the tower reads
    kept: [tokens, levels, D] of each of the others
    """

    def __init__(self, made: dict[Hashable, slice], kept: dict[Hashable, Tensor]) -> None:
        self.made, self.kept = made, kept
        self._tokens, start = dict(made), max((tokens.stop for tokens in made.values()), default=0)
        for key, features in kept.items():
            self._tokens[key] = slice(start, start + len(features))
            start += len(features)

    def tokens(self, keys: Sequence[Hashable]) -> Indices:
        """int64 [M]: the merged tokens of shots of one size, one shot after the other."""
        first = self._tokens[keys[0]]
        starts = np.array([self._tokens[key].start for key in keys], np.int64)
        tokens: Indices = (starts[:, None] + np.arange(first.stop - first.start)).ravel()
        return tokens


@dataclass(frozen=True)
class VlmBatch:
    """Conversations, padded to the longest.

    inputs: the backbone's arguments by name
    spans: int64 [F, 3], row and first and behind-the-last token of each frame's state
    query_rows, query_tokens: int64 [Q], where the questions' tokens stand
    num_tokens, num_span_tokens: of all conversations, without padding; of all spans
    pixels: of which the arguments about pixels are made; None: they are among the inputs, or all shots are kept
    plan: of a Qwen backbone's vision tower; None: all shots are kept
    layout: of the shots of a Qwen backbone
    """

    inputs: dict[str, Tensor]
    spans: Tensor
    query_rows: Tensor
    query_tokens: Tensor
    num_tokens: int
    num_span_tokens: int
    pixels: QwenPixels | SmolPixels | None = None
    plan: VisionPlan | None = None
    layout: Layout | None = None

    def pinned(self) -> VlmBatch:
        """The batch in memory from which a GPU copies while the host goes on; its frames stay where they are."""
        return self._changed(pinned)

    def to(self, device: torch.device, dtype: torch.dtype) -> VlmBatch:
        """The batch on ``device``. Pixels are rescaled, normalised and put in order there, and come in ``dtype``."""
        moved = self._changed(lambda tensor: tensor.to(device, non_blocking=True))
        made = {} if moved.pixels is None else moved.pixels.inputs(device, dtype)
        return replace(moved, inputs=moved.inputs | made, pixels=None)

    def _changed(self, change: Callable[[Tensor], Tensor]) -> VlmBatch:
        return replace(
            self,
            inputs={name: change(tensor) for name, tensor in self.inputs.items()},
            spans=change(self.spans),
            query_rows=change(self.query_rows),
            query_tokens=change(self.query_tokens),
            pixels=None if self.pixels is None else self.pixels.changed(change),
            plan=None if self.plan is None else self.plan.changed(change),
        )
