# SPDX-License-Identifier: MIT
"""Episodes that grow: each step sends only new frames, and returns the score for the episode so far."""

from rfm_client.episodes.episodes import Episode
from rfm_client.episodes.options import EpisodeOptions, FrameOptions, StepScore, SuccessRule

__all__ = [
    "Episode",
    "EpisodeOptions",
    "FrameOptions",
    "StepScore",
    "SuccessRule",
]
