# SPDX-License-Identifier: MIT
"""TOPReward on a Qwen3-VL: there is no separate checkpoint, only a prompt and its settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rfm.engine.layers import Normalisation
from rfm.families.topreward.predictor import TopRewardPredictor
from rfm.families.topreward.prompts import TopRewardCollator, TopRewardConfig, TopRewardImages
from rfm.qwen.language import LanguageCheckpoint, LanguageNetwork
from rfm_client.contract.description import Description


@dataclass(frozen=True)
class TopRewardCheckpoint(LanguageCheckpoint):
    """A TOPReward model in memory."""

    made_of = TopRewardConfig
    predictor_of = TopRewardPredictor

    @property
    def description(self) -> Description:
        """The model's inputs and outputs."""
        return Description(
            kind=f"TOPReward, as {'LeRobot' if self.config.variant == 'lerobot' else 'Robometer'} computes it",
            network={"class": LanguageNetwork.__name__},
            network_frames=self.config.max_frames,
            more_scores=("log_prob",),
            needs_whole_episode=True,
            asks_in_words=True,
            keeps_features=True,
            is_large=True,
        )

    def make_collator(self, tokenizer: Any, patch_px: int, normalisation: Normalisation) -> TopRewardCollator:
        """Return the collator with this tokenizer and preprocessing."""
        images = TopRewardImages(patch_px, normalisation, config=self.config)
        return TopRewardCollator(self.config, tokenizer, images)
