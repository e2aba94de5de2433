# SPDX-License-Identifier: MIT
"""The request of a health probe: the smallest one that a model can answer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rfm_client.contract import ProgressSample, Trajectory, wire

_BLANK_FRAMES = 2
_BLANK_PX = 64


def blank_question(config: Mapping[str, Any]) -> wire.Tensors:
    """The inputs of one short sample of zeros, for a model with this configuration."""
    dims = {tensor["name"]: [int(dim) for dim in tensor["dims"]] for tensor in config["input"]}
    if wire.VIDEO_EMBEDDINGS in dims:
        (_, video_dim), (text_dim,) = dims[wire.VIDEO_EMBEDDINGS], dims[wire.TEXT_EMBEDDING]
        trajectory = Trajectory(
            video_embeddings=np.zeros((_BLANK_FRAMES, video_dim), np.float32),
            text_embedding=np.zeros(text_dim, np.float32),
        )
    else:
        blank = np.zeros((_BLANK_FRAMES, _BLANK_PX, _BLANK_PX, 3), np.uint8)
        trajectory = Trajectory(frames=blank, task="canary")
    tensors = wire.encode_samples([ProgressSample(trajectory)])
    return {name: tensor for name, tensor in tensors.items() if name in dims}
