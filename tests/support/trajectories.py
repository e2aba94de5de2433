# SPDX-License-Identifier: MIT
"""Trajectories of noise."""

from __future__ import annotations

import numpy as np

from rfm_client import Trajectory


def random_trajectory(seed: int, num_frames: int, video_dim: int = 768, text_dim: int = 384) -> Trajectory:
    """Embeddings in the widths of the upstream checkpoints."""
    random = np.random.default_rng(seed)
    return Trajectory(
        video_embeddings=random.standard_normal((num_frames, video_dim), np.float32),
        text_embedding=random.standard_normal(text_dim, np.float32),
    )
