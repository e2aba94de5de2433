# SPDX-License-Identifier: MIT
"""RynnValue's checkpoints in memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from rfm.engine.feature_cache import FeatureCache
from rfm.engine.pixels import Normalisation
from rfm.families.rynnvalue.network import RynnConfig, RynnNetwork
from rfm.families.rynnvalue.predictor import RynnPredictor
from rfm.families.rynnvalue.prompts import RELATIVE_TOKEN, VALUE_TOKEN, RynnCollator
from rfm.qwen.checkpoint import QwenCheckpoint
from rfm.qwen.images import BoundedImages
from rfm.qwen.language import LanguageCheckpoint
from rfm.qwen.network import build_backbone
from rfm_client.contract.description import Description

TRAINED_FRAMES = 8


@dataclass(frozen=True)
class RynnCheckpoint(LanguageCheckpoint):
    """A RynnValue in memory."""

    made_of = RynnConfig
    reads_videos: ClassVar[bool] = False

    @property
    def description(self) -> Description:
        """The model's inputs and outputs."""
        return Description(
            kind="RynnValue",
            network={"class": RynnNetwork.__name__},
            trained_frames=TRAINED_FRAMES,
            trained_padding=False,
            has_progress=False,
            more_scores=("remaining_s", "relative_s", "entropy"),
            asks_in_words=True,
            keeps_features=True,
            uses_graphs=self.config.attention == "causal",  # else the groups need a mask
            is_large=True,
        )

    @property
    def own_tokens(self) -> dict[str, int]:
        """The ids of the value tokens."""
        return {VALUE_TOKEN: self.config.value_token, RELATIVE_TOKEN: self.config.relative_token}

    def make_collator(  # type: ignore[override]  # the prompts of the others have one video
        self, tokenizer: Any, patch_px: int, normalisation: Normalisation
    ) -> RynnCollator:
        """Return the collator with this tokenizer and preprocessing."""
        limits = {"least_px": self.config.least_px, "most_px": self.config.most_px}
        return RynnCollator(self.config, tokenizer, BoundedImages(patch_px, normalisation, **limits))

    def network(self, dtype: torch.dtype) -> RynnNetwork:  # type: ignore[override]  # a network with other heads
        """Return the network, with weights of no use."""
        return RynnNetwork(self.config, build_backbone(self.config, dtype))

    def make_predictor(
        self, network: RynnNetwork, device: torch.device, cache: FeatureCache[Any] | None
    ) -> RynnPredictor:
        """Return the predictor with this network."""
        return RynnPredictor(network, self.collator, device, cache)

    def loaded(self, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the weights: no language head is tied to the embedding."""
        return {**weights}

    def build(self, dtype: torch.dtype | None = None) -> Any:
        """Return the network with these weights, as ``QwenCheckpoint.build``. Raises CheckpointError."""
        return QwenCheckpoint.build(self, dtype)
