# SPDX-License-Identifier: MIT
"""Episodes that grow: each step sends only its new frames, and returns the score of the episode so far."""

from rfm_client.episodes.episodes import AsyncEpisode, AsyncEpisodes, Episode, Episodes
from rfm_client.episodes.options import EpisodeOptions, FrameOptions, StepScore, SuccessRule

__all__ = [
    "AsyncEpisode",
    "AsyncEpisodes",
    "Episode",
    "EpisodeOptions",
    "Episodes",
    "FrameOptions",
    "StepScore",
    "SuccessRule",
]
