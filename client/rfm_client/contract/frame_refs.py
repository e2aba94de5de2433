# SPDX-License-Identifier: MIT
"""Frame references: digests sent in place of frames whose features the server keeps."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.samples import UInt8Array, check_frame_steps, check_task

DIGEST_BYTES = 32  # of SHA-256, which excludes two frames of one digest, even by intent


def frame_digest(frame: UInt8Array) -> bytes:
    """Return the SHA-256 of a frame, uint8 [H, W, 3]: of H and W (4 bytes each, little-endian), then the pixels."""
    digest = hashlib.sha256(np.array(frame.shape[:2], "<u4").tobytes())
    digest.update(np.ascontiguousarray(frame).data)
    return digest.digest()


@dataclass(frozen=True, eq=False)
class TrajectoryRefs:
    """A trajectory with frame references.

    digests: digest of each frame, DIGEST_BYTES long
    pixels: frames, uint8 [H, W, 3], by digests that the receiver computed. Other trajectories' frames may be among them
    """

    digests: tuple[bytes, ...]
    pixels: Mapping[bytes, UInt8Array]
    task: str

    @property
    def num_frames(self) -> int:
        """T, the number of frames."""
        return len(self.digests)

    @classmethod
    def of(cls, frames: UInt8Array, task: str, digests: Iterable[bytes] | None = None) -> TrajectoryRefs:
        """Return the trajectory of frames, uint8 [T, H, W, 3], with all pixels.

        digests: of the frames, in order; None: computed here
        """
        known = tuple(map(frame_digest, frames) if digests is None else digests)
        return cls(known, dict(zip(known, frames, strict=True)), task)


@dataclass(frozen=True, eq=False)
class EncoderSampleRefs:
    """An ``EncoderSample`` whose trajectories have frame references."""

    trajectories: tuple[TrajectoryRefs, ...]


@dataclass(frozen=True, eq=False)
class ProgressSampleRefs:
    """A ``ProgressSample`` whose trajectory has frame references. Raises InvalidSampleError."""

    trajectory: TrajectoryRefs
    frame_steps: int = 0

    def __post_init__(self) -> None:
        check_task(self.trajectory.task)
        if not self.trajectory.task.strip():
            raise InvalidSampleError.at("trajectory.task", "a task sentence with frames", repr(self.trajectory.task))
        check_frame_steps(self.frame_steps)

    @property
    def trajectories(self) -> tuple[TrajectoryRefs, ...]:
        """The trajectory in a tuple, as other samples have theirs."""
        return (self.trajectory,)
