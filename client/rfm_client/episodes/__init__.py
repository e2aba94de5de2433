# SPDX-License-Identifier: MIT
"""Episodes that grow: each step sends only its new frames, and returns the score of the episode so far."""

from rfm_client.episodes.episodes import AsyncEpisode, AsyncEpisodes, Episode, Episodes
from rfm_client.episodes.steps import (
    EpisodeFrames,
    EpisodeOptions,
    StepRequest,
    StepScore,
    StepScores,
    SuccessRule,
    copied,
)

__all__ = [
    "AsyncEpisode",
    "AsyncEpisodes",
    "Episode",
    "EpisodeFrames",
    "EpisodeOptions",
    "Episodes",
    "StepRequest",
    "StepScore",
    "StepScores",
    "SuccessRule",
    "copied",
]
