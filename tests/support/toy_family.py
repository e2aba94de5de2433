# SPDX-License-Identifier: MIT
"""A family that the product does not know: how red a frame is, is how far the task has come.

The encoders return each frame's mean colour and the number of letters of the task. The network is one line.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from rfm.config import CheckpointConfig
from rfm.engine import Execution
from rfm.engine.family import NETWORK, Family
from rfm.engine.feature_cache import FeatureCache
from rfm.engine.predictor import Predictor, RowScores, frame_scores, prefix_indices
from rfm.files import NETWORK_CONFIG, WEIGHTS
from rfm.published.reader import Loaded, Reader
from rfm_client import (
    InvalidSampleError,
    ProgressSample,
    RewardError,
    Sample,
    SimilaritySample,
    Trajectory,
)
from rfm_client.contract.description import Description
from rfm_client.contract.samples import EncoderSample

MODEL_TYPE = "redness"
PALETTE = "palette.safetensors"


@dataclass(frozen=True)
class ToyConfig:
    num_colours: int = 3


class Redness(nn.Module):
    """float32 [..., 3] colours -> logits [...]; NaN for pure green."""

    def __init__(self, config: ToyConfig) -> None:
        super().__init__()
        self.line = nn.Linear(config.num_colours, 1)

    def forward(self, colours: Tensor) -> Tensor:
        red, green, blue = colours.split(1, dim=-1)
        is_green = (green != 0) & (red == 0) & (blue == 0)
        return self.line(colours).masked_fill(is_green, torch.nan)


class Palette:
    """The encoders: ``scale`` times mean colours."""

    def __init__(self, scale: Tensor) -> None:
        self.scale = scale

    @classmethod
    def load(cls, folder: Path) -> Palette:
        return cls(load_file(folder / PALETTE)["scale"])

    @classmethod
    def describe(cls, folder: Path) -> Description:
        return Description(network={"class": cls.__name__})

    @property
    def description(self) -> Description:
        return Description(network={"class": type(self).__name__})

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        save_file({"scale": self.scale}, folder / PALETTE, {"format": "pt"})

    def to(self, device: torch.device) -> Palette:
        return Palette(self.scale.to(device))

    def encode(
        self,
        samples: Sequence[EncoderSample],
        execution: Execution,
        cache: FeatureCache | None = None,
    ) -> list[EncoderSample | RewardError]:
        return [self._encoded(sample) for sample in samples]

    def _encoded(self, sample: EncoderSample) -> EncoderSample:
        letters = np.full(1, len(sample.trajectories[0].task), np.float32)
        colours = [each.positions.mean(axis=(1, 2)).astype(np.float32) for each in sample.trajectories]
        videos = [self.scale.cpu().numpy() * colour for colour in colours]
        return EncoderSample(tuple(Trajectory(video_embeddings=video, text_embedding=letters) for video in videos))


@dataclass(frozen=True)
class ToyPredictor(Predictor[Any, Any]):
    """A row is the embeddings of a sample's trajectories."""

    network: Redness
    has_success: bool = True

    def rows(self, sample: Sample) -> list[list[np.ndarray]]:
        if isinstance(sample, SimilaritySample):
            raise InvalidSampleError.at("sample_type", "progress or preference", "similarity")
        videos = [trajectory.positions for trajectory in sample.trajectories]
        if isinstance(sample, ProgressSample) and sample.frame_steps:
            return [[videos[0][picked]] for picked in prefix_indices(len(videos[0]), sample.frame_steps)]
        return [videos]

    def num_tokens(self, row: list[np.ndarray]) -> int:
        return sum(map(len, row))

    def collate(self, rows: Sequence[list[np.ndarray]]) -> Tensor:
        return torch.from_numpy(np.concatenate([video for row in rows for video in row]))

    def count(self, batch: Tensor, execution: Execution) -> None:
        execution.add_tokens(len(batch), len(batch))

    @torch.inference_mode()
    def score(
        self, rows: Sequence[list[np.ndarray]], batch: Tensor, execution: Execution
    ) -> list[RowScores | RewardError]:
        logits = iter(self.network(batch).split([len(video) for row in rows for video in row]))
        scored: list[RowScores | RewardError] = []
        for row in rows:
            of_row = [next(logits) for _ in row]
            query = (of_row[0][-1] - of_row[1][-1]).sigmoid().item() if len(row) == 2 else None
            scored.append(RowScores([frame_scores(each, each[:, 0]) for each in of_row], query))
        return scored


@dataclass(frozen=True)
class ToyCheckpoint:
    config: ToyConfig
    weights: dict[str, Tensor]

    @property
    def description(self) -> Description:
        return Description(
            kind="redness",
            network={"class": Redness.__name__},
            video_dim=self.config.num_colours,
            text_dim=1,
            has_preference=True,
            has_success=True,
        )

    @property
    def parts(self) -> dict[str, dict[str, Tensor]]:
        return {NETWORK: self.weights}

    def skeleton(self) -> Redness:
        return Redness(self.config)

    def flop(self, sample: Sample) -> float:
        return 2.0 * sum(trajectory.num_frames for trajectory in sample.trajectories) * self.config.num_colours

    def predictor(
        self, device: torch.device, dtype: torch.dtype | None = None, cache: FeatureCache[Any] | None = None
    ) -> ToyPredictor:
        network = Redness(self.config)
        network.load_state_dict(self.weights)
        return ToyPredictor(network)

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        (folder / NETWORK_CONFIG).write_text(json.dumps({"model_type": MODEL_TYPE, **asdict(self.config)}))
        save_file(self.weights, folder / WEIGHTS, {"format": "pt"})


def reads(folder: Path) -> bool:
    file = folder / NETWORK_CONFIG
    return file.exists() and json.loads(file.read_text()).get("model_type") == MODEL_TYPE


def restore(folder: Path) -> ToyCheckpoint:
    content = json.loads((folder / NETWORK_CONFIG).read_text())
    return ToyCheckpoint(ToyConfig(content["num_colours"]), load_file(folder / WEIGHTS))


def load(folder: Path, options: CheckpointConfig) -> Loaded:
    checkpoint = restore(folder)
    scale = torch.full((checkpoint.config.num_colours,), 1 / 255)
    return Loaded(checkpoint, encoders=lambda: Palette(scale))


FAMILY = Family(name=__name__, restore=restore, reader=__name__, encoders=Palette)
READER = Reader(reads, load)
