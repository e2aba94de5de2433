# SPDX-License-Identifier: MIT
"""Messages and engine for the mosec server.

T frames, D frame embedding width, Dt text embedding width.

A message is a msgpack map for one sample, with arrays as float32 bytes. Request: ``type`` (progress, preference or
similarity), ``shapes`` ([T, D] per trajectory), ``video`` (the trajectories' embeddings in sequence) and ``text`` (the
first trajectory's [Dt]). Answer: ``progress`` and ``success`` (float32 [T] per trajectory), and for pairs ``query``; or
``error``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from rfm import published
from rfm.engine import Engine, Outcome
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


def options(told: str | None) -> argparse.Namespace:
    """Parse a peer's command-line options."""
    parser = argparse.ArgumentParser(description=told, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", required=True, help="checkpoint folder")
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    return parser.parse_args()


def sample_of(message: Mapping[str, Any]) -> Sample:
    """Return the sample in a request. Raises KeyError, ValueError, InvalidSampleError."""
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
    """Return the answer to a request."""
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


def engine_of(checkpoint: str) -> Engine:
    """Load a checkpoint's engine on the CPU."""
    return Engine.of(published.load(checkpoint))
