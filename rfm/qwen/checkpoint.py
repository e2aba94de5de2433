# SPDX-License-Identifier: MIT
"""The base class for checkpoints on a Qwen backbone: from weights in memory to a network, a predictor and files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from rfm.engine.family import NETWORK, config_fields
from rfm.engine.feature_cache import FeatureCache
from rfm.files import NETWORK_CONFIG, expecting
from rfm.qwen.collator import QwenCollator
from rfm.qwen.lora import merged
from rfm.qwen.network import build_backbone
from rfm.qwen.predictor import QwenPredictor
from rfm.qwen.processor import save_processor
from rfm.qwen.rounded import fit
from rfm.qwen.tree import trees
from rfm.saved import PROCESSOR_FOLDER, SETTINGS, write_network
from rfm.weights import check_shapes
from rfm_client.contract import Sample

_VISION = "visual."  # prefix of parameters that patches pass
_EMBEDDING = "embed_tokens."  # looked up, not multiplied


LORA = "lora"  # key in ``parts``: the factors that change the network's weights


@dataclass(frozen=True)
class QwenCheckpoint:
    """A checkpoint in memory.

    weights: for its network, without LoRA
    processor: folder or id with tokenizer and preprocessing
    network_of, predictor_of: the classes to build
    """

    network_of: ClassVar[Any]
    predictor_of: ClassVar[type[QwenPredictor]]

    config: Any
    weights: dict[str, Tensor]
    processor: str | Path

    @property
    def parts(self) -> dict[str, dict[str, Tensor]]:
        """All weights of the network."""
        return {NETWORK: self.weights}

    @cached_property
    def collator(self) -> Any:
        """The sample collator. Raises CheckpointError if the processor is missing or does not fit."""
        return self.load_collator()

    def load_collator(self) -> QwenCollator:
        raise NotImplementedError

    def network(self, dtype: torch.dtype) -> nn.Module:
        """Return the network, with uninitialised weights."""
        network: nn.Module = self.network_of(self.config, build_backbone(self.config, dtype))
        return network

    def skeleton(self) -> nn.Module:
        with torch.device("meta"):
            return self.network(self.config.torch_dtype)

    def loaded(self, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the weights under all names that the network loads."""
        return {**weights}

    def saved_settings(self) -> dict[str, Any]:
        """Return this project's fields for an exported config.json."""
        return {name: value for name, value in config_fields(self.config).items() if name != "backbone"}

    def flop(self, sample: Sample) -> float:
        """Return how many operations a sample's products with weights take: two per parameter and patch or token.

        Leaves out attention products, about a tenth, and the heads.
        Raises CheckpointError, InvalidSampleError.
        """
        collator, config = self.collator, self.config
        rows = collator.rows(sample)
        videos = dict.fromkeys(video for row in rows for video in row.videos)
        with torch.device("meta"):
            backbone = build_backbone(config, config.torch_dtype)
        counts = {name: weights.numel() for name, weights in backbone.named_parameters() if _EMBEDDING not in name}
        of_vision = sum(count for name, count in counts.items() if name.startswith(_VISION))
        num_patches = sum(collator.num_patches(video) for video in videos)
        if collator.makes_trees:
            rows = trees(rows, collator.visual_pad, are_images=config.multi_image)
        num_tokens = sum(row.cost for row in rows)
        return 2.0 * (of_vision * num_patches + (sum(counts.values()) - of_vision) * num_tokens)

    def predictor(
        self, device: torch.device, dtype: torch.dtype | None = None, cache: FeatureCache[Any] | None = None
    ) -> QwenPredictor:
        """Return a predictor with the network on ``device``. Raises CheckpointError.

        dtype: of the network; None: float32 on the CPU, otherwise the checkpoint's own
        cache: stores frame features; None: no cache
        """
        self.collator  # noqa: B018  first, so that a missing file is reported before the network is built
        if dtype is None and device.type == "cpu":
            dtype = torch.float32
        return self.predictor_of(self.build(dtype), self.collator, device, cache)

    def save(self, folder: Path) -> None:
        """Write all weights, a config.json with all settings, and the processor."""
        collator = self.collator  # first, so that a missing file is reported before the weights are written
        config = {**self.config.backbone, SETTINGS: self.saved_settings()}
        write_network(folder, config, {name: each for part in self.parts.values() for name, each in part.items()})
        save_processor(collator, folder / PROCESSOR_FOLDER)

    def build(self, dtype: torch.dtype | None = None) -> Any:
        """Return the network with these weights, on the CPU, ready to score, in ``dtype`` (None: its own).

        Raises CheckpointError.
        """
        wanted, factors = dtype or self.config.torch_dtype, self.parts.get(LORA, {})
        network = self.network(wanted)
        fit(network, self.weights, factors)
        # Parameters only: rotary frequencies stay float32, as upstream.
        network.load_state_dict(self.loaded(merged(self.weights, factors, wanted)), strict=True, assign=True)
        return network.eval().requires_grad_(False)

    def check(self) -> None:
        """Raise CheckpointError unless the weights fit the network, before memory is allocated for it."""
        with expecting("a backbone that transformers can make", NETWORK_CONFIG):
            network = self.skeleton()
        fit(network, self.weights)
        check_shapes(network.state_dict(), self.loaded(self.weights))
