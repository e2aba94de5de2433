# SPDX-License-Identifier: MIT
"""The frames of a trajectory, and the shots that a vision tower reads of them: images, or groups of two frames.

A shot's key says what the tower is shown: the digests of its frames, and the size that they are brought to.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from torch import Tensor

from rfm.engine.predictor import prefix_indices
from rfm.vlm.images import FRAMES_PER_GROUP
from rfm_client.contract import InvalidSampleError, wire
from rfm_client.contract.frame_refs import TrajectoryRefs, frame_digest
from rfm_client.contract.samples import UInt8Array

Indices: TypeAlias = npt.NDArray[np.int64]
Shot: TypeAlias = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class SizedFrames:
    """The frames of a video that the backbone is still to be shown, brought to size.

    pixels: uint8 [N, H', W', 3], on the CPU or the device
    places: int64 [T], at which of the N each of the video's frames is; -1: only shots that are kept show it
    keys: of each of the video's shots
    kept: [tokens, levels, D] by key, what the vision tower has made before of some of the shots
    """

    pixels: Tensor
    places: Indices
    keys: Mapping[Shot, Hashable]
    kept: Mapping[Hashable, Tensor] = field(default_factory=dict)


@dataclass(eq=False)
class VlmVideo:
    """A trajectory's frames, which all rows about it share.

    frames: uint8 [H, W, 3] each, of one size
    num_shown: of them, in one conversation
    conversations: int64 [num_shown] each, the frames that one shows
    named: digests of the frames, if they came with the frames; they were computed here
    sized: its frames in the size that the backbone reads; None: not yet
    """

    frames: Sequence[UInt8Array] | UInt8Array
    num_shown: int
    conversations: Sequence[Indices]
    named: Sequence[bytes] | None = None
    sized: SizedFrames | None = None

    @classmethod
    def of(
        cls, frames: Sequence[UInt8Array] | UInt8Array, frame_steps: int, named: Sequence[bytes] | None = None
    ) -> VlmVideo:
        """The video of a sample's frames. ``frame_steps``: of dense mode; 0: one conversation shows all frames."""
        count = len(frames)
        conversations = list(prefix_indices(count, frame_steps)) if frame_steps else [np.arange(count)]
        return cls(frames, frame_steps or count, conversations, named)

    @property
    def ready(self) -> SizedFrames:
        """The frames of a video that has been brought to size."""
        assert self.sized is not None
        return self.sized

    @property
    def size(self) -> tuple[int, int]:
        """H and W of each frame."""
        height, width = self.frames[0].shape[:2]
        return height, width

    @cached_property
    def digests(self) -> Sequence[bytes]:
        """The digest of each frame."""
        return self.named or tuple(map(frame_digest, self.frames))

    @property
    def alike(self) -> Indices:
        """int64 [T]: of each frame the first one that shows the same."""
        first: dict[bytes, int] = {}
        return np.array([first.setdefault(digest, index) for index, digest in enumerate(self.digests)])

    def is_blank(self, shot: Shot) -> bool:
        """Whether a shot that came with its pixels is all black, as those are with which a server probes itself: what
        was kept of such a one would tell nothing of how the network is.
        """
        return self.named is None and not any(self.frames[frame].any() for frame in shot)

    def stack(self, needed: Sequence[int]) -> UInt8Array:
        """uint8 [N, H, W, 3]: some of the frames, in order. A copy, unless all are wanted and lie side by side."""
        if isinstance(self.frames, np.ndarray) and len(needed) == len(self.frames):
            return self.frames
        height, width = self.size
        return np.stack([self.frames[i] for i in needed]) if needed else np.empty((0, height, width, 3), np.uint8)

    def shots(self, *, are_images: bool) -> list[Shot]:
        """The different shots of all conversations."""
        shown = (shot for frames in self.conversations for shot in shots_of(frames, are_images=are_images))
        return list(dict.fromkeys(shown))


def named_frames(trajectory: TrajectoryRefs) -> list[UInt8Array]:
    """uint8 [H, W, 3] of each frame. Raises InvalidSampleError for pixels that are not there, or of several sizes."""
    unknown = sum(digest not in trajectory.pixels for digest in trajectory.digests)
    if unknown:
        raise InvalidSampleError.at(wire.FRAME_DIGESTS, wire.UNKNOWN_FRAMES, f"{unknown} others")
    frames = [trajectory.pixels[digest] for digest in trajectory.digests]
    sizes = sorted({frame.shape[:2] for frame in frames})
    if len(sizes) > 1:
        raise InvalidSampleError.at(wire.FRAME_DIGESTS, "digests of frames of one size", f"sizes {sizes}")
    return frames


def shots_of(shown: Indices, *, are_images: bool) -> Iterable[Shot]:
    """The shots of a conversation that shows these frames.

    are_images: each frame is a shot; else two, and an odd count is filled up with the last frame
    """
    if are_images:
        return zip(shown.tolist(), strict=True)
    filling = shown[-1:].repeat(-len(shown) % FRAMES_PER_GROUP)
    return map(tuple, np.concatenate([shown, filling]).reshape(-1, FRAMES_PER_GROUP).tolist())
