# SPDX-License-Identifier: MIT
"""Episodes that grow: each step sends its new frames alone, and has the score of the episode so far."""

from rfm_client.episodes.async_episodes import AsyncEpisode, AsyncEpisodes
from rfm_client.episodes.episodes import Episode, Episodes
from rfm_client.episodes.live import LiveView
from rfm_client.episodes.options import EpisodeOptions, SuccessRule
from rfm_client.episodes.scores import StepScore, StepScores

__all__ = [
    "AsyncEpisode",
    "AsyncEpisodes",
    "Episode",
    "EpisodeOptions",
    "Episodes",
    "LiveView",
    "StepScore",
    "StepScores",
    "SuccessRule",
]
