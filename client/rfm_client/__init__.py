# SPDX-License-Identifier: MIT
"""Rewards for robot trajectories from a served reward model.

from rfm_client import RewardClient, Trajectory

with RewardClient("grpc://localhost:8001") as client:
    result = client.progress(Trajectory(frames=frames, task="put the red block in the bowl"))
    result.progress, result.success  # float32 [T] each
"""

from rfm_client.client import RewardClient
from rfm_client.errors import (
    DeadlineExceededError,
    InferenceFailedError,
    InvalidSampleError,
    ModelNotFoundError,
    RewardError,
    ServerError,
    ServerUnavailableError,
)
from rfm_client.samples import (
    BatchTiming,
    FrameScores,
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Result,
    Sample,
    SimilarityResult,
    SimilaritySample,
    Trajectory,
    float_frames_to_uint8,
)

__all__ = [
    "BatchTiming",
    "DeadlineExceededError",
    "FrameScores",
    "InferenceFailedError",
    "InvalidSampleError",
    "ModelNotFoundError",
    "PreferenceResult",
    "PreferenceSample",
    "ProgressResult",
    "ProgressSample",
    "Result",
    "RewardClient",
    "RewardError",
    "Sample",
    "ServerError",
    "ServerUnavailableError",
    "SimilarityResult",
    "SimilaritySample",
    "Trajectory",
    "float_frames_to_uint8",
]
