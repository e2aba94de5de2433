# SPDX-License-Identifier: MIT
"""Samples of raw frames -> samples of embeddings, where a network scores those."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rfm.execution import Execution
from rfm.family import FrameEncoders
from rfm_client.contract import ProgressSample, RewardError, Sample, Trajectory
from rfm_client.contract.samples import Footage


def embedded(samples: Sequence[Sample], encoders: FrameEncoders, execution: Execution) -> list[Sample | RewardError]:
    """The samples with embeddings in place of raw frames, which are encoded together; or why a sample has none.

    execution: what it took is added to it
    """
    outcomes: list[Sample | RewardError] = list(samples)
    raw = {i: Footage(s.trajectories) for i, s in enumerate(samples) if s.trajectories[0].frames is not None}
    encoded = encoders.encode(list(raw.values()), execution) if raw else []
    for index, outcome in zip(raw, encoded, strict=True):
        outcomes[index] = _with_embeddings(samples[index], outcome) if isinstance(outcome, Trajectory) else outcome
    return outcomes


def _with_embeddings(sample: Sample, encoded: Trajectory) -> Sample:
    bounds = np.cumsum([trajectory.num_frames for trajectory in sample.trajectories])[:-1]
    videos = np.split(encoded.positions, bounds)
    parts = [Trajectory(video_embeddings=video, text_embedding=encoded.text_embedding) for video in videos]
    if isinstance(sample, ProgressSample):
        return replace(sample, trajectory=parts[0])
    return type(sample)(parts[0], parts[1])
