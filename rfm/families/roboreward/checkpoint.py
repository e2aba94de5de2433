# SPDX-License-Identifier: MIT
"""RoboReward's checkpoints in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rfm.engine.layers import Normalisation
from rfm.families.roboreward.predictor import RoboRewardPredictor
from rfm.families.roboreward.prompts import SCORES, RoboRewardCollator, RoboRewardConfig
from rfm.files import CheckpointError
from rfm.qwen.images import QwenImages
from rfm.qwen.language import LanguageCheckpoint, LanguageNetwork
from rfm_client.contract.description import Description


@dataclass(frozen=True)
class RoboRewardCheckpoint(LanguageCheckpoint):
    """A RoboReward checkpoint in memory."""

    made_of = RoboRewardConfig
    predictor_of = RoboRewardPredictor

    @property
    def description(self) -> Description:
        """The model's inputs and outputs."""
        return Description(
            kind="RoboReward, expected value of the score" if self.config.is_expected else "RoboReward",
            network={"class": LanguageNetwork.__name__},
            progress_bins=len(SCORES),
            more_scores=() if self.config.is_expected else ("unclear",),
            scores_whole_prefixes=True,
            may_not_answer=not self.config.is_expected,
            asks_in_words=True,
            keeps_features=True,
            uses_graphs=self.config.is_expected,  # a written answer keeps keys and values, whose number grows
            is_large=True,
        )

    def make_collator(self, tokenizer: Any, patch_px: int, normalisation: Normalisation) -> RoboRewardCollator:
        """Return the collator with this tokenizer and preprocessing. Raises CheckpointError."""
        images = QwenImages(patch_px, normalisation, max_video_side_px=None)
        collator = RoboRewardCollator(self.config, tokenizer, images)
        for score, token in zip(SCORES, collator.digits, strict=True):
            if tokenizer.decode([token]) != str(score):
                raise CheckpointError.at(f"base model {self.processor}", f"a token for {score}", "none")
        return collator
