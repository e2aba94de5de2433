# SPDX-License-Identifier: MIT
"""Robo-Dopamine's checkpoints: folders of an ordinary Qwen-VL, which only their names tell from others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch

from rfm.checkpoint.content import NETWORK_CONFIG, CheckpointError, is_there, read_json
from rfm.checkpoint.provenance import Assumption
from rfm.checkpoint.run_config import find_run_config
from rfm.engine.feature_cache import FeatureCache
from rfm.engine.pixels import Normalisation
from rfm.family import Loaded, Options, Reader
from rfm.robodopamine.predictor import RoboDopaminePredictor
from rfm.robodopamine.prompts import RoboDopamineCollator, RoboDopamineConfig
from rfm.saved import is_saved, reward_model_of
from rfm.vlm.images import BoundedImages
from rfm.vlm.language import LanguageCheckpoint, LanguageNetwork
from rfm.vlm.language_folder import ANY_QWEN, LanguageFolder, reopened
from rfm.vlm.preprocessor import pixel_limits
from rfm.vlm.processor import read_processor
from rfm.vlm.written import is_named, stops_of
from rfm_client.contract.description import Description

_NAME = RoboDopamineConfig.reward_model
_OF_USER: dict[str, type] = {"mode": str, "interval": int}  # settings that ``--as`` takes


@dataclass(frozen=True)
class RoboDopamineCheckpoint(LanguageCheckpoint):
    """A Robo-Dopamine GRM in memory."""

    made_of = RoboDopamineConfig
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

    def make_predictor(
        self, network: LanguageNetwork, device: torch.device, cache: FeatureCache[Any] | None
    ) -> RoboDopaminePredictor:
        """Return the predictor with this network."""
        return RoboDopaminePredictor(network, self.collator, device, cache)


def reads(folder: Path) -> bool:
    """True if a folder holds an export of this model, or a Qwen-VL of its name without a run's config.yaml."""
    if reward_model_of(folder) is not None:
        return reward_model_of(folder) == _NAME
    content = read_json(folder / NETWORK_CONFIG) if is_there(folder / NETWORK_CONFIG) else {}
    return is_named(folder, _NAME) and content.get("model_type") in ANY_QWEN and find_run_config(folder) is None


def load(folder: Path, options: Options) -> Loaded:
    """Load the model of a local folder: a Qwen-VL's, or an export. Raises CheckpointError."""
    if options.video_prompt is not None:
        expected = "none: the prompt of this checkpoint has images"
        raise CheckpointError.at("--video-prompt", expected, options.video_prompt)
    given = options.settings(_OF_USER)
    assumptions: tuple[Assumption, ...] = ()
    if is_saved(folder):
        checkpoint = reopened(RoboDopamineCheckpoint, folder, options)
    else:
        files = LanguageFolder.read(folder, options, ANY_QWEN)
        _, preprocessor = read_processor(files.processor)
        limits = pixel_limits(preprocessor, f"base model {files.processor}")
        config = RoboDopamineConfig(**files.made_of, **limits, stops=stops_of(folder))
        assumptions = files.assumptions(config)
        checkpoint = RoboDopamineCheckpoint(config, files.weights, files.processor)
    config = replace(checkpoint.config, **given)
    config.check()
    checkpoint = replace(checkpoint, config=config)
    checkpoint.check()
    return Loaded(checkpoint, assumptions)


READER = Reader(reads, load, (_NAME,))
