# SPDX-License-Identifier: MIT
"""Stand-in servers that replace the checkpoint while callers ask."""

from __future__ import annotations

import sys
from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from rfm_client import FrameSize, ModelInfo, ModelNotFoundError
from transports import Answer, Tensors


@dataclass(frozen=True)
class Kept:
    """A checkpoint: every frame's progress is ``score``. max_frames, frame_size: that it was trained on"""

    score: float
    version: str = "1"
    weights: str = "weights-of-v1"
    settings: str = "settings-of-v1"
    max_frames: int = 16
    frame_size: FrameSize | None = None


V1 = Kept(0.1)
V2 = Kept(0.9, "2", "weights-of-v2")


@dataclass
class Shelf:
    """A server that changes the checkpoint after ``after`` requests about samples.

    parts: models that then belong to the other checkpoint
    """

    kept: Kept = V1
    other: Kept = V2
    after: int = sys.maxsize
    parts: Collection[str] = ("rfm", "rfm_encoder", "rfm_frames")
    has_encoder: bool = True
    has_preference: bool = True
    url: str = "grpc://shelf:1"
    count: int = 0
    shapes: list[tuple[int, ...]] = field(default_factory=list)  # of the arrays in requests

    def of(self, model: str) -> Kept:
        return self.other if self.count >= self.after and model in self.parts else self.kept

    async def infer(
        self, model: str, inputs: Tensors, outputs: Collection[str], timeout_s: float, *, request_id: str = ""
    ) -> Answer:
        now = self.of(model)
        if model == "rfm_encoder":
            num_frames = int(inputs["num_frames"][0, 0])
            tensors = {"video_embeddings": np.ones((1, num_frames, 4)), "text_embedding": np.ones((1, 2))}
            return Answer({name: array.astype(np.float32) for name, array in tensors.items()}, now.version)
        self.count += 1
        self.shapes.append(inputs["frames" if model == "rfm_frames" else "video_embeddings"].shape)
        num_frames = inputs["num_frames"].sum(axis=1)  # of both trajectories, perhaps in two arrays
        scores = np.full((len(num_frames), num_frames.max()), now.score)
        return Answer(dict.fromkeys(outputs, scores.astype(np.float32)), now.version)

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        if model != "rfm_frames" and not self.has_encoder:
            raise ModelNotFoundError(model)
        now, (video_dim, text_dim) = self.of(model), (None, None) if model == "rfm_frames" else (4, 2)
        return ModelInfo(
            name=model,
            versions=(now.version,),
            max_batch_size=64,
            video_dim=video_dim,
            text_dim=text_dim,
            trained_frames=now.max_frames,
            has_preference=self.has_preference,
            frame_size=now.frame_size,
            weights_digest=now.weights,
            settings_digest=now.settings,
        )

    async def is_ready(self, model: str, timeout_s: float) -> bool:
        return True

    async def close(self) -> None:
        pass
