# SPDX-License-Identifier: MIT
"""A trajectory's frames, and its shots: the temporal patches (images or frame pairs) that a vision tower reads.

A Qwen shot's key holds all that determines its features: its frames' digests and their size after resizing.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from torch import Tensor

from rfm.engine.feature_cache import digests_of
from rfm.engine.threads import IN_TURN, FrameThreads
from rfm.qwen.images import FRAMES_PER_GROUP
from rfm_client.contract.samples import UInt8Array

Indices: TypeAlias = npt.NDArray[np.int64]
Shot: TypeAlias = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class SizedFrames:
    """A video's resized frames, without those whose shots are all cached.

    pixels: uint8 [N, H', W', 3], on the CPU or the device
    places: int64 [T], where a frame lies in ``pixels``; -1: only cached shots show the frame
    keys: cache keys by shot
    kept: cached shot features by key, [tokens, levels, D]
    """

    pixels: Tensor
    places: Indices
    keys: Mapping[Shot, Hashable]
    kept: Mapping[Hashable, Tensor] = field(default_factory=dict)


@dataclass(eq=False)
class VlmVideo:
    """A trajectory's frames, shared by all its rows.

    frames: T frames, uint8 [H, W, 3], of equal size
    num_shown: frames per conversation
    conversations: frame indices per conversation, int64 [num_shown]
    named: digests for a sample with named frames, computed by the server; None: no named frames
    sized: the resized frames; None: not yet resized
    """

    frames: Sequence[UInt8Array] | UInt8Array
    num_shown: int
    conversations: Sequence[Indices]
    named: Sequence[bytes] | None = None
    sized: SizedFrames | None = None

    @property
    def ready(self) -> SizedFrames:
        """The resized frames, which must exist."""
        assert self.sized is not None
        return self.sized

    @property
    def size(self) -> tuple[int, int]:
        """H and W, equal for all frames."""
        height, width = self.frames[0].shape[:2]
        return height, width

    @cached_property
    def digests(self) -> Sequence[bytes]:
        """The digests by frame, from the server if the frames are named."""
        return self.named or digests_of(list(self.frames), IN_TURN)

    def compute_digests(self, threads: FrameThreads) -> None:
        """Compute ``digests`` in these threads."""
        if self.named is None:
            self.digests = digests_of(list(self.frames), threads)

    @property
    def alike(self) -> Indices:
        """For each frame, the index of the first equal frame, int64 [T]."""
        first: dict[bytes, int] = {}
        return np.array([first.setdefault(digest, index) for index, digest in enumerate(self.digests)])

    def is_blank(self, shot: Shot) -> bool:
        """True if a shot's frames have no names and are black, as a probe's are.

        The network must compute these: cached features would not show that it works.
        """
        return self.named is None and not any(self.frames[frame].any() for frame in shot)

    def stack(self, needed: Sequence[int]) -> UInt8Array:
        """Return the frames at ``needed`` (ascending), uint8 [N, H, W, 3]; neighbours in an array are not copied."""
        if isinstance(self.frames, np.ndarray) and needed and needed[-1] - needed[0] == len(needed) - 1:
            return self.frames[needed[0] : needed[-1] + 1]
        height, width = self.size
        return np.stack([self.frames[i] for i in needed]) if needed else np.empty((0, height, width, 3), np.uint8)

    def shots(self, *, are_images: bool) -> list[Shot]:
        """Return the distinct shots in all conversations."""
        shown = (shot for frames in self.conversations for shot in shots_of(frames, are_images=are_images))
        return list(dict.fromkeys(shown))


def shots_of(shown: Indices, *, are_images: bool) -> Iterable[Shot]:
    """Return the shots in a conversation that shows these frames.

    are_images: each frame is a shot; otherwise each pair, and an odd last frame is repeated
    """
    if are_images:
        return zip(shown.tolist(), strict=True)
    filling = shown[-1:].repeat(-len(shown) % FRAMES_PER_GROUP)
    return map(tuple, np.concatenate([shown, filling]).reshape(-1, FRAMES_PER_GROUP).tolist())
