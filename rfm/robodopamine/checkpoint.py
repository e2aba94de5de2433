# SPDX-License-Identifier: MIT
"""Robo-Dopamine's checkpoints: folders of an ordinary Qwen-VL, which only their names tell from others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

from rfm.engine.pixels import Normalisation
from rfm.robodopamine.predictor import RoboDopaminePredictor
from rfm.robodopamine.prompts import RoboDopamineCollator, RoboDopamineConfig
from rfm.vlm.asked_images import ImagesCheckpoint
from rfm.vlm.images import BoundedImages
from rfm.vlm.language_folder import ANY_QWEN
from rfm_client.contract.description import Description


@dataclass(frozen=True)
class RoboDopamineCheckpoint(ImagesCheckpoint):
    """A Robo-Dopamine GRM in memory."""

    made_of = RoboDopamineConfig
    made_for = RoboDopaminePredictor
    backbones = ANY_QWEN
    of_user: ClassVar[dict[str, type]] = {"mode": str, "interval": int}
    is_bounded = True

    @property
    def description(self) -> Description:
        """The model's inputs and outputs."""
        kind, scores = f"Robo-Dopamine, {self.config.mode}", ("hop",)
        return replace(super().description, kind=kind, more_scores=scores, needs_whole_episode=True, reads_views=True)

    def make_collator(self, tokenizer: Any, patch_px: int, normalisation: Normalisation) -> RoboDopamineCollator:
        """Return the collator with this tokenizer and preprocessing."""
        limits = {"least_px": self.config.least_px, "most_px": self.config.most_px}
        return RoboDopamineCollator(self.config, tokenizer, BoundedImages(patch_px, normalisation, **limits))
