# SPDX-License-Identifier: MIT
"""Rewards for robot trajectories from a served reward model.

from rfm_client import RewardClient, Trajectory

with RewardClient("grpc://localhost:8001") as client:
    result = client.progress(Trajectory(frames=frames, task="put the red block in the bowl"))
    result.progress, result.success  # float32 [T] each
"""

from rfm_client.async_client import AsyncRewardClient
from rfm_client.client import RewardClient
from rfm_client.errors import (
    AccessDeniedError,
    DeadlineExceededError,
    InferenceFailedError,
    InvalidSampleError,
    ModelNotFoundError,
    ProcessEndedError,
    RewardError,
    ServerError,
    ServerUnavailableError,
)
from rfm_client.inputs import as_trajectory, load_trajectory
from rfm_client.model_info import ModelInfo
from rfm_client.resize import FrameSize
from rfm_client.results import (
    BatchTiming,
    FrameScores,
    PreferenceResult,
    ProgressResult,
    Result,
    SimilarityResult,
)
from rfm_client.samples import (
    PreferenceSample,
    ProgressSample,
    Sample,
    SimilaritySample,
    Trajectory,
    float_frames_to_uint8,
)

__all__ = [
    "AccessDeniedError",
    "AsyncRewardClient",
    "BatchTiming",
    "DeadlineExceededError",
    "FrameScores",
    "FrameSize",
    "InferenceFailedError",
    "InvalidSampleError",
    "ModelInfo",
    "ModelNotFoundError",
    "PreferenceResult",
    "PreferenceSample",
    "ProcessEndedError",
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
    "as_trajectory",
    "float_frames_to_uint8",
    "load_trajectory",
]
