# SPDX-License-Identifier: MIT
"""RynnValue's checkpoints in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from rfm.engine.layers import Normalisation
from rfm.families.rynnvalue.network import RynnConfig, RynnNetwork
from rfm.families.rynnvalue.predictor import RynnPredictor
from rfm.families.rynnvalue.prompts import RELATIVE_TOKEN, VALUE_TOKEN, RynnCollator
from rfm.qwen.images import BoundedImages
from rfm.qwen.language import LanguageCheckpoint
from rfm_client.contract.description import Description

TRAINED_FRAMES = 8


@dataclass(frozen=True)
class RynnCheckpoint(LanguageCheckpoint):
    """A RynnValue model in memory."""

    made_of = RynnConfig
    network_of = RynnNetwork
    predictor_of = RynnPredictor
    has_language_head: ClassVar[bool] = False
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
            uses_graphs=self.config.attention == "causal",  # otherwise the groups need a mask
            is_large=True,
        )

    @property
    def own_tokens(self) -> dict[str, int]:
        """The value tokens and their ids."""
        return {VALUE_TOKEN: self.config.value_token, RELATIVE_TOKEN: self.config.relative_token}

    def make_collator(  # type: ignore[override]  # the prompts of the others have one video
        self, tokenizer: Any, patch_px: int, normalisation: Normalisation
    ) -> RynnCollator:
        """Return the collator with this tokenizer and preprocessing."""
        limits = {"least_px": self.config.least_px, "most_px": self.config.most_px}
        return RynnCollator(self.config, tokenizer, BoundedImages(patch_px, normalisation, **limits))
