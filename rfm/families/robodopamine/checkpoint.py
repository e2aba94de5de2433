# SPDX-License-Identifier: MIT
"""Robo-Dopamine's checkpoints in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from rfm.engine.layers import Normalisation
from rfm.families.robodopamine.predictor import RoboDopaminePredictor
from rfm.families.robodopamine.prompts import RoboDopamineCollator, RoboDopamineConfig
from rfm.qwen.images import BoundedImages
from rfm.qwen.language import LanguageCheckpoint, LanguageNetwork
from rfm_client.contract.description import Description


@dataclass(frozen=True)
class RoboDopamineCheckpoint(LanguageCheckpoint):
    """A Robo-Dopamine GRM in memory."""

    made_of = RoboDopamineConfig
    predictor_of = RoboDopaminePredictor
    reads_videos: ClassVar[bool] = False

    @property
    def description(self) -> Description:
        """The model's inputs and outputs."""
        return Description(
            kind=f"Robo-Dopamine, {self.config.mode}",
            network={"class": LanguageNetwork.__name__},
            more_scores=("hop",),
            needs_whole_episode=True,
            reads_views=True,
            may_not_answer=True,
            asks_in_words=True,
            keeps_features=True,
            is_large=True,
        )

    def make_collator(self, tokenizer: Any, patch_px: int, normalisation: Normalisation) -> RoboDopamineCollator:
        """Return the collator with this tokenizer and preprocessing."""
        limits = {"least_px": self.config.least_px, "most_px": self.config.most_px}
        return RoboDopamineCollator(self.config, tokenizer, BoundedImages(patch_px, normalisation, **limits))
