# SPDX-License-Identifier: MIT
"""An episode scored prefix by prefix: the sample of each prefix, and each frame's score from their results.

T frames of the episode.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from rfm_client.contract.errors import InferenceFailedError
from rfm_client.contract.results import ProgressResult
from rfm_client.contract.samples import ProgressSample, Trajectory
from rfm_client.data.sampling import FrameIndices, Prefix, Sampling


def taken(trajectory: Trajectory, indices: FrameIndices) -> Trajectory:
    """The trajectory of these of its frames, or frame embeddings; its text stays."""
    if trajectory.frames is not None:
        return replace(trajectory, frames=trajectory.frames[indices])
    assert trajectory.video_embeddings is not None  # a Trajectory has one of them
    return replace(trajectory, video_embeddings=trajectory.video_embeddings[indices])


def prefix_samples(trajectory: Trajectory, sampling: Sampling) -> Iterator[ProgressSample]:
    """The sample of each prefix 0..t of the trajectory, made one after the other. Raises InvalidSampleError."""
    for t in range(trajectory.num_frames):
        yield ProgressSample(taken(trajectory, sampling.prefix(t).indices))


def of_prefixes(results: Sequence[ProgressResult], sampling: Sampling) -> ProgressResult:
    """The result of the episode: frame t's score is the one of the prefix 0..t at the slot that the rule reads.

    results: [T], of the samples of ``prefix_samples``

    Raises InferenceFailedError if several versions of the checkpoint gave them.
    """
    versions = sorted({str(result.model_version) for result in results})
    if len(versions) > 1:
        raise InferenceFailedError(f"model_version: expected one for all frames, got {', '.join(versions)}: ask again")
    reads = [sampling.prefix(t).read for t in range(len(results))]
    return ProgressResult(
        progress=np.array([result.progress[read] for result, read in zip(results, reads, strict=True)], np.float32),
        success=np.array([result.success[read] for result, read in zip(results, reads, strict=True)], np.float32),
        model_version=results[-1].model_version,
    )


def of_frames(result: ProgressResult, prefix: Prefix) -> ProgressResult:
    """The scores of the frames that a prefix shows, each once, without padding."""
    slots = prefix.frame_slots
    return replace(result, progress=result.progress[slots], success=result.success[slots])
