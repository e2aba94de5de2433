# SPDX-License-Identifier: MIT
"""RoboReward's checkpoints: ordinary folders of a Qwen3-VL, which only their names tell from others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from rfm.checkpoint.content import NETWORK_CONFIG, CheckpointError, is_there, read_json
from rfm.checkpoint.run_config import find_run_config
from rfm.engine.feature_cache import FeatureCache
from rfm.engine.pixels import Normalisation
from rfm.family import Loaded, Options, Reader
from rfm.checkpoint.provenance import Assumption
from rfm.saved import is_saved, reward_model_of
from rfm.roboreward.predictor import RoboRewardPredictor
from rfm.roboreward.prompts import SCORES, RoboRewardCollator, RoboRewardConfig
from rfm.vlm.collator import QWEN3
from rfm.vlm.images import QwenImages
from rfm.vlm.language import LanguageCheckpoint, LanguageNetwork
from rfm.vlm.language_folder import LanguageFolder, reopened
from rfm.vlm.written import is_named, stops_of
from rfm_client.contract.description import Description

WRITTEN, EXPECTED = "roboreward", "roboreward-expected"  # of ``--as``
REWARD_MODELS = (WRITTEN, EXPECTED)


@dataclass(frozen=True)
class RoboRewardCheckpoint(LanguageCheckpoint):
    """A checkpoint of RoboReward in memory."""

    made_of = RoboRewardConfig

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

    def make_predictor(
        self, network: LanguageNetwork, device: torch.device, cache: FeatureCache[Any] | None
    ) -> RoboRewardPredictor:
        """Return the predictor with this network."""
        return RoboRewardPredictor(network, self.collator, device, cache)


def reads(folder: Path) -> bool:
    """True if the folder holds an export of RoboReward, or a Qwen3-VL of its name without a run's config.yaml."""
    if reward_model_of(folder) is not None:
        return reward_model_of(folder) == RoboRewardConfig.reward_model
    content = read_json(folder / NETWORK_CONFIG) if is_there(folder / NETWORK_CONFIG) else {}
    has_name = is_named(folder, "roboreward")
    return has_name and content.get("model_type") == QWEN3 and find_run_config(folder) is None


def load(folder: Path, options: Options) -> Loaded:
    """Load the model of a local folder: a Qwen3-VL's, or an export. Raises CheckpointError."""
    name, _ = options.named()
    options.settings({})
    assumptions: tuple[Assumption, ...] = ()
    if is_saved(folder):
        checkpoint = reopened(RoboRewardCheckpoint, folder, options)
        if name is not None and checkpoint.config.is_expected != (name == EXPECTED):
            remedy = "export the checkpoint again"
            raise CheckpointError.at("--as", "the reward model of this export", name, remedy)
    else:
        files = LanguageFolder.read(folder, options)
        made_of = {**files.made_of, "dtype": "bfloat16"}  # as the original loads it, whatever config.json says
        config = RoboRewardConfig(**made_of, stops=stops_of(folder), is_expected=name == EXPECTED)
        assumptions = tuple(each for each in files.assumptions(config) if each.name != "dtype")
        checkpoint = RoboRewardCheckpoint(config, files.weights, files.processor)
    if options.strict_answers and not checkpoint.config.is_expected:
        checkpoint = replace(checkpoint, config=replace(checkpoint.config, strict_answers=True))
    checkpoint.check()
    return Loaded(checkpoint, assumptions)


READER = Reader(reads, load, REWARD_MODELS)
