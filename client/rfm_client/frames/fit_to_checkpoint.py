# SPDX-License-Identifier: MIT
"""Fit a sample to its checkpoint: fewer frames, and frames no larger than the model's input size.

Shrinking needs Pillow: ``rfm-client[resize]``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from rfm_client.contract.description import FrameSize
from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.results import ProgressResult, Result, trajectory_scores
from rfm_client.contract.samples import ProgressSample, Sample, Trajectory, UInt8Array, with_pictures, with_trajectories
from rfm_client.frames.sampling import FrameIndices, taken, thinned


def resize_frames(frames: UInt8Array, size: FrameSize) -> UInt8Array:
    """Return frames, uint8 [T, H, W, 3], no larger than the model's input size; the same array if they fit.

    Pillow resizes, bicubic. The network's input changes by at most a grey level or two for ReWiND. For Qwen's backbones
    the input stays identical if they read the size ``exact``. If they round the size to whole patches, frames are
    resized twice, and single pixels differ by up to 15.
    """
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError('making frames smaller needs Pillow: pip install "./client[resize]"') from error
    height, width = size.fitted(frames.shape[1], frames.shape[2])
    if (height, width) == frames.shape[1:3]:
        return frames
    resized = np.empty((len(frames), height, width, 3), np.uint8)
    for frame, smaller in zip(frames, resized, strict=True):
        smaller[:] = Image.fromarray(frame).resize((width, height), Image.Resampling.BICUBIC)
    return resized


@dataclass(frozen=True)
class FittedSample:
    """A sample to send, and which frames it kept.

    frame_indices: for each trajectory int64 [N], its frames in the sample; None: all
    """

    sample: Sample
    frame_indices: Sequence[FrameIndices | None]


def whole(sample: Sample) -> FittedSample:
    """Return the sample with all its frames. Raises InvalidSampleError for any other value."""
    if not isinstance(sample, Sample):
        expected = "ProgressSample, PreferenceSample or SimilaritySample"
        raise InvalidSampleError.at("sample", expected, type(sample).__name__)
    return FittedSample(sample, (None,) * len(sample.trajectories))


def snapshot(sample: Sample) -> Sample:
    """Copy the sample's arrays, so that the caller may change the originals before the sample is sent."""

    def copied(trajectory: Trajectory) -> Trajectory:
        arrays = {name: getattr(trajectory, name) for name in ("video_embeddings", "text_embedding")}
        copies = {name: array.copy() for name, array in arrays.items() if array is not None}
        return replace(with_pictures(trajectory, np.copy), **copies)

    return with_trajectories(sample, [copied(t) for t in sample.trajectories]) if isinstance(sample, Sample) else sample


def fitted(sample: Sample, max_frames: int | None, frame_size: FrameSize | None) -> FittedSample:
    """Return the sample with at most ``max_frames`` frames per trajectory, of at most ``frame_size``.

    max_frames: thin out frames as in training (``sampling.thinned``), but not in dense mode, where the server
        samples each prefix; None: any number
    frame_size: None: any size
    """
    dense = isinstance(sample, ProgressSample) and sample.frame_steps > 0
    limit = None if dense else max_frames
    kept = [thinned(trajectory.num_frames, limit) for trajectory in sample.trajectories]
    trajectories = [
        t if indices is None else taken(t, indices) for t, indices in zip(sample.trajectories, kept, strict=True)
    ]
    if frame_size is not None:
        trajectories = [with_pictures(each, partial(resize_frames, size=frame_size)) for each in trajectories]
    return FittedSample(with_trajectories(sample, trajectories), kept)


def with_frame_indices(result: Result, indices: Sequence[FrameIndices | None]) -> Result:
    """Add the scored frames' indices to the result, as in ``FittedSample.frame_indices``."""
    if all(kept is None for kept in indices):
        return result
    if isinstance(result, ProgressResult):
        return replace(result, frame_indices=indices[0])
    of_both = zip(trajectory_scores(result).items(), indices, strict=True)
    changed: dict[str, Any] = {name: replace(scores, frame_indices=kept) for (name, scores), kept in of_both}
    return replace(result, **changed)
