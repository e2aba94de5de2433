# SPDX-License-Identifier: MIT
"""Samples, results, errors, names and tensors shared by client and server."""

from rfm_client.contract.description import FrameSize, ModelInfo
from rfm_client.contract.errors import (
    AccessDeniedError,
    ClientClosedError,
    DeadlineExceededError,
    InferenceFailedError,
    InvalidSampleError,
    ModelNotFoundError,
    ProcessEndedError,
    RewardError,
    ServerError,
    ServerUnavailableError,
)
from rfm_client.contract.ranking import Ranking
from rfm_client.contract.results import (
    FRAME_SCORES,
    FrameScores,
    PreferenceResult,
    ProgressResult,
    Result,
    SimilarityResult,
)
from rfm_client.contract.samples import (
    PreferenceSample,
    ProgressSample,
    Sample,
    SimilaritySample,
    Trajectory,
    float_frames_to_uint8,
)

__all__ = [
    "FRAME_SCORES",
    "AccessDeniedError",
    "ClientClosedError",
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
    "Ranking",
    "Result",
    "RewardError",
    "Sample",
    "ServerError",
    "ServerUnavailableError",
    "SimilarityResult",
    "SimilaritySample",
    "Trajectory",
    "float_frames_to_uint8",
]
