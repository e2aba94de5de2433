# SPDX-License-Identifier: MIT
"""What the LitServe and mosec servers read and write: one msgpack map a sample, arrays as their float32 bytes.

Request: ``type`` (progress, preference or similarity), ``shapes`` ([[T, D]] of each trajectory), ``video`` (the
trajectories' embeddings, one after the other) and ``text`` (the first trajectory's [Dt]).
Answer: ``progress`` and ``success`` (a list of one float32 [T] a trajectory), and of pairs ``query``, the preference or
similarity; or ``error``.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from rfm.engine import Outcome
from rfm_client import (
    FrameScores,
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    RewardError,
    Sample,
    SimilaritySample,
    Trajectory,
)

_PAIRS = {"preference": PreferenceSample, "similarity": SimilaritySample}


def sample_of(message: Mapping[str, Any]) -> Sample:
    """The sample of a request. Raises KeyError, ValueError, InvalidSampleError."""
    text = np.frombuffer(message["text"], np.float32)
    video = np.frombuffer(message["video"], np.float32)
    shapes = message["shapes"]
    ends = np.cumsum([0, *(num_frames * width for num_frames, width in shapes)])
    parts = [video[start:end].reshape(shape) for (start, end), shape in zip(pairwise(ends), shapes, strict=True)]
    trajectories = [Trajectory(video_embeddings=part, text_embedding=text) for part in parts]
    if message["type"] == "progress":
        return ProgressSample(*trajectories)
    return _PAIRS[message["type"]](*trajectories)


def answer_of(outcome: Outcome) -> dict[str, Any]:
    """The answer to a request."""
    if isinstance(outcome, RewardError):
        return {"error": str(outcome)}
    if isinstance(outcome, ProgressResult):
        return _frames(outcome)
    if isinstance(outcome, PreferenceResult):
        return {**_frames(outcome.first, outcome.second), "query": outcome.preference}
    return {**_frames(outcome.reference, outcome.other), "query": outcome.similarity}


def _frames(*scores: FrameScores) -> dict[str, Any]:
    return {
        "progress": [each.progress.tobytes() for each in scores],
        "success": [each.success.tobytes() for each in scores],
    }
