# SPDX-License-Identifier: MIT
"""Frames that are named by a digest of what they show, so that pixels which the server knows need not be sent again."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.samples import UInt8Array, check_frame_steps, check_task

DIGEST_BYTES = 32  # of SHA-256: nobody can make two frames of one digest


def frame_digest(frame: UInt8Array) -> bytes:
    """The digest of a frame, uint8 [H, W, 3]: SHA-256 of H and W, each as 4 bytes, the lowest first, and the pixels."""
    digest = hashlib.sha256(np.array(frame.shape[:2], "<u4").tobytes())
    digest.update(np.ascontiguousarray(frame).data)
    return digest.digest()


@dataclass(frozen=True, eq=False)
class TrajectoryRefs:
    """A trajectory whose frames are named.

    digests: of each frame
    pixels: uint8 [H, W, 3] by digest, which the receiver has computed; frames of other trajectories may be among them
    """

    digests: tuple[bytes, ...]
    pixels: Mapping[bytes, UInt8Array]
    task: str

    @property
    def num_frames(self) -> int:
        """T, the number of frames."""
        return len(self.digests)

    @classmethod
    def of(cls, frames: UInt8Array, task: str) -> TrajectoryRefs:
        """The trajectory of the frames [T, H, W, 3], all of which are at hand."""
        digests = tuple(map(frame_digest, frames))
        return cls(digests, dict(zip(digests, frames, strict=True)), task)


@dataclass(frozen=True, eq=False)
class EncoderSampleRefs:
    """The trajectories of one sample, for an encoder, with named frames."""

    trajectories: tuple[TrajectoryRefs, ...]


@dataclass(frozen=True, eq=False)
class ProgressSampleRefs:
    """A ``ProgressSample`` of a trajectory with named frames. Raises InvalidSampleError."""

    trajectory: TrajectoryRefs
    frame_steps: int = 0

    def __post_init__(self) -> None:
        check_task(self.trajectory.task)
        if not self.trajectory.task.strip():
            raise InvalidSampleError.at("trajectory.task", "a task sentence with frames", repr(self.trajectory.task))
        check_frame_steps(self.frame_steps)

    @property
    def trajectories(self) -> tuple[TrajectoryRefs, ...]:
        """The trajectory alone, as of any sample."""
        return (self.trajectory,)
