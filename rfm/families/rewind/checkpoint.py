# SPDX-License-Identifier: MIT
"""ReWiND checkpoints in memory: the network's weights, and optionally the encoders'."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rfm.engine.family import NETWORK, config_fields
from rfm.engine.feature_cache import FeatureCache
from rfm.families.rewind.network import RewindConfig, RewindTransformer
from rfm.families.rewind.predictor import RewindPredictor
from rfm.files import NETWORK_CONFIG, WEIGHTS, expecting, read_json, read_tensors
from rfm.saved import write_network
from rfm.weights import check_shapes
from rfm_client.contract import Sample
from rfm_client.contract.description import Description

MODEL_TYPE = "rewind_transformer"


@dataclass(frozen=True)
class RewindCheckpoint:
    """A ReWiND checkpoint in memory.

    network: weights for RewindTransformer
    image_encoder, text_encoder: encoder weights without their prefix; empty if the checkpoint has none
    """

    config: RewindConfig
    network: dict[str, Tensor]
    image_encoder: dict[str, Tensor] = field(default_factory=dict)
    text_encoder: dict[str, Tensor] = field(default_factory=dict)

    @property
    def description(self) -> Description:
        """The checkpoint's inputs and outputs."""
        return Description(
            kind="ReWiND",
            network={"class": RewindTransformer.__name__},
            video_dim=self.config.video_feature_dim,
            text_dim=self.config.text_feature_dim,
            progress_bins=self.config.progress_bins if self.config.progress_bins > 1 else None,
            trained_frames=self.config.trained_frames,
            trained_padding=self.config.trained_padding is not False,
            network_frames=self.config.max_frames,
            has_preference=self.config.has_preference,
            has_success=self.config.has_success,
            has_similarity=self.config.has_similarity,
        )

    @property
    def parts(self) -> dict[str, dict[str, Tensor]]:
        """All weights by part and name."""
        return {NETWORK: self.network, "image_encoder": self.image_encoder, "text_encoder": self.text_encoder}

    def flop(self, sample: Sample) -> float:
        """Return how many operations a sample's products take: two per parameter and token."""
        counts = [trajectory.num_frames for trajectory in sample.trajectories]
        num_tokens = self.config.num_tokens(counts[0], sum(counts[1:]))
        return 2.0 * num_tokens * sum(tensor.numel() for tensor in self.network.values())

    def predictor(
        self, device: torch.device, dtype: torch.dtype | None = None, cache: FeatureCache[Any] | None = None
    ) -> RewindPredictor:
        """Return a predictor on ``device``, in ``dtype`` (None: float32). Raises CheckpointError.

        cache: not used, since the network reads embeddings
        """
        return RewindPredictor(self.build(), device, dtype or torch.float32)

    def save(self, folder: Path) -> None:
        """Write network and configuration for ``load``, without encoders."""
        write_network(folder, {"model_type": MODEL_TYPE, **config_fields(self.config)}, self.network)

    def build(self) -> RewindTransformer:
        """Return the network with these weights, on the CPU, ready to score. Raises CheckpointError."""
        self.check()
        network = RewindTransformer(self.config)
        network.load_state_dict(self.network, strict=True)
        return network.eval().requires_grad_(False)

    def check(self) -> None:
        """Raise CheckpointError unless the weights fit the network, before memory is allocated for it."""
        check_shapes(self.skeleton().state_dict(), self.network)

    def skeleton(self) -> RewindTransformer:
        """Return the network without weights."""
        with torch.device("meta"):
            return RewindTransformer(self.config)


def restore(folder: Path) -> RewindCheckpoint:
    """Load what ``RewindCheckpoint.save`` wrote. Raises CheckpointError."""
    file = folder / NETWORK_CONFIG
    with expecting("the settings of an exported ReWiND network", file):
        settings = {name: value for name, value in read_json(file).items() if name != "model_type"}
        config = RewindConfig(**settings)
    checkpoint = RewindCheckpoint(config, read_tensors(folder / WEIGHTS))
    checkpoint.check()
    return checkpoint
