# SPDX-License-Identifier: MIT
"""RynnValue's checkpoints: as they were published, or exported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from rfm.checkpoint.content import NETWORK_CONFIG, CheckpointError, is_there, read_json, shown
from rfm.checkpoint.provenance import source_name
from rfm.engine.feature_cache import FeatureCache
from rfm.engine.pixels import Normalisation
from rfm.family import Loaded, Options, Reader
from rfm.saved import is_saved, reward_model_of
from rfm.rynnvalue.network import RynnConfig, RynnNetwork
from rfm.rynnvalue.predictor import RynnPredictor
from rfm.rynnvalue.prompts import META, RELATIVE_TOKEN, VALUE_TOKEN, RynnCollator
from rfm.rynnvalue.settings import PUBLISHED, Settings
from rfm.vlm.backbone import QWEN_NAMES, UNUSED, backbone_config, renamed
from rfm.vlm.collator import QWEN3
from rfm.vlm.images import BoundedImages
from rfm.vlm.language import EMBEDDING, LanguageCheckpoint
from rfm.vlm.language_folder import dtype_of
from rfm.vlm.network import build_backbone
from rfm.vlm.preprocessor import pixel_limits
from rfm.vlm.processor import read_processor
from rfm.vlm.qwen_checkpoint import QwenCheckpoint
from rfm.vlm.rounding import read_published, read_unrounded_config, round_layers
from rfm_client.contract.description import Description

MODEL_TYPE = "rynn_value_lang"
TRAINED_FRAMES = 8
_EXAMPLE = '--robot-description "a Franka single-arm robot" --camera-description "the main right camera"'
_OF_BACKBONE = "model."  # begins the names of the backbone's weights


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


def reads(folder: Path) -> bool:
    """True if the folder holds a RynnValue as it was published, or an export of it."""
    content = read_json(folder / NETWORK_CONFIG) if is_there(folder / NETWORK_CONFIG) else {}
    return content.get("model_type") == MODEL_TYPE or reward_model_of(folder) == RynnConfig.reward_model


def load(folder: Path, options: Options) -> Loaded:
    """Load the checkpoint of a local folder. Raises CheckpointError."""
    if is_saved(folder):
        return _exported(folder, options)
    content = read_json(folder / NETWORK_CONFIG)
    if content.get("model_type") != MODEL_TYPE:
        got = shown(content.get("model_type"))
        raise CheckpointError.at(f"{folder / NETWORK_CONFIG}: model_type", f"{MODEL_TYPE}, of a RynnValue", got)
    return _published(folder, content, options)


def _published(folder: Path, content: dict[str, Any], options: Options) -> Loaded:
    """Load a checkpoint as it was published."""
    file = folder / NETWORK_CONFIG
    read = Settings.read(folder, content)
    fields = read.fields()
    told = {name: value for name, value in content.items() if name not in PUBLISHED and "value_token_id" not in name}
    backbone = backbone_config({**told, "model_type": QWEN3}, file)
    tensors, _ = read_published(folder, read_unrounded_config(backbone, file), MODEL_TYPE)
    weights = {name: each for name, each in renamed(tensors, QWEN_NAMES).items() if not UNUSED.fullmatch(name)}
    _set_rows(backbone, weights, file)
    processor = options.base_model or folder
    tokenizer, preprocessor = read_processor(processor)
    fields["value_token"] = read.token("value_token_id", VALUE_TOKEN, tokenizer)
    fields["relative_token"] = read.token("relative_value_token_id", RELATIVE_TOKEN, tokenizer)
    meta = _descriptions(options)
    if fields["use_meta"] and not meta:
        expected = "robot_description, camera_description or both, which the prompt of this checkpoint names"
        raise CheckpointError.at(folder, expected, "neither", f"for example {_EXAMPLE}")
    fields["dtype"], of_dtype = dtype_of(backbone, file)
    limits = pixel_limits(preprocessor, f"base model {processor}")
    config = RynnConfig(
        backbone=backbone,
        base_model_id=source_name(processor),
        **{**fields, **limits, **(meta if fields["use_meta"] else {})},
    )
    notes = [f"{name}: not expected, and not used: scores may differ from the original's" for name in read.unexpected]
    checkpoint = _rounded(RynnCheckpoint(config, weights, processor), options)
    return Loaded(checkpoint, (*of_dtype, *read.assumptions), lambda: notes)


def _exported(folder: Path, options: Options) -> Loaded:
    """Load an export, with the processor, descriptions and form of weights that the user asks for."""
    checkpoint = RynnCheckpoint.restore(folder)
    changed = _descriptions(options) if checkpoint.config.use_meta else {}
    config, processor = replace(checkpoint.config, **changed), options.base_model or checkpoint.processor
    return Loaded(_rounded(replace(checkpoint, config=config, processor=processor), options))


def _rounded(checkpoint: RynnCheckpoint, options: Options) -> RynnCheckpoint:
    """Return the checkpoint, with the backbone's layers rounded if the user asks for it, and checked."""
    config = checkpoint.config
    if options.weights is not None and config.weights is None:
        ours = {name: each for name, each in checkpoint.weights.items() if name.startswith(_OF_BACKBONE)}
        rounded, _ = round_layers(ours, {}, options.weights, config.torch_dtype)
        heads = {name: each for name, each in checkpoint.weights.items() if name not in ours}
        config = replace(config, weights=options.weights)
        checkpoint = replace(checkpoint, config=config, weights={**rounded, **heads})
    checkpoint.check()
    return checkpoint


def _set_rows(backbone: dict[str, Any], weights: Mapping[str, Tensor], file: Path) -> None:
    """Take the rows of the embedding from the weights: its padding may have been kept or cut."""
    if EMBEDDING not in weights:
        raise CheckpointError.at(file.parent, f"a weight {EMBEDDING}", "none")
    backbone["text_config"]["vocab_size"] = len(weights[EMBEDDING])


def _descriptions(options: Options) -> dict[str, str]:
    """Return the user's descriptions of robot and camera, by setting."""
    return {name: words for name in META if (words := getattr(options, name))}


READER = Reader(reads, load)
