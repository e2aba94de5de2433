# SPDX-License-Identifier: MIT
"""Synthetic trajectories: blank, to probe a model, and random, to compare answers.

``widths``: D and Dt of the embeddings that the model reads; None: it reads raw frames.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from rfm_client.contract.samples import Trajectory

Widths: TypeAlias = tuple[int, int] | None

BLANK_FRAMES = 2
SIDE_PX = 64
PROBE_TASK = "probe"  # of a blank trajectory


def blank_trajectory(widths: Widths, task: str = PROBE_TASK) -> Trajectory:
    """Return BLANK_FRAMES embeddings, or frames, of zeros."""
    if widths is None:
        return Trajectory(frames=np.zeros((BLANK_FRAMES, SIDE_PX, SIDE_PX, 3), np.uint8), task=task)
    video_dim, text_dim = widths
    return Trajectory(
        video_embeddings=np.zeros((BLANK_FRAMES, video_dim), np.float32), text_embedding=np.zeros(text_dim, np.float32)
    )


def random_trajectory(
    random: np.random.Generator,
    num_frames: int,
    widths: Widths,
    *,
    task: str,
    size_px: tuple[int, int] = (SIDE_PX, SIDE_PX),
) -> Trajectory:
    """Return normally distributed embeddings, or noise frames with ``task`` and ``size_px`` = (height, width)."""
    if widths is None:
        return Trajectory(frames=random.integers(0, 256, (num_frames, *size_px, 3), np.uint8), task=task)
    video_dim, text_dim = widths
    return Trajectory(
        video_embeddings=random.standard_normal((num_frames, video_dim), np.float32),
        text_embedding=random.standard_normal(text_dim, np.float32),
    )
