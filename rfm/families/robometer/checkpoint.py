# SPDX-License-Identifier: MIT
"""The predictor of RFM and Robometer, their checkpoints in memory, and their processors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rfm.engine.execution import Execution
from rfm.engine.family import NETWORK
from rfm.engine.layers import progress_from_logits
from rfm.engine.predictor import RowScores, no_success
from rfm.families.robometer.network import VlmConfig, VlmOutput, VlmRewardModel
from rfm.families.robometer.prompts import OLD_RUN_REMEDY, SPECIAL_TOKENS, VlmCollator
from rfm.files import NETWORK_CONFIG, CheckpointError, expecting
from rfm.qwen.batch import VlmBatch, VlmRow
from rfm.qwen.checkpoint import LORA, QwenCheckpoint
from rfm.qwen.images import FRAMES_PER_GROUP, MERGE, QwenImages, fitted_size
from rfm.qwen.lora import split
from rfm.qwen.predictor import QwenPredictor
from rfm.qwen.processor import SIZED_BEFORE, check_tokens, normalisation_of, patch_px, read_processor
from rfm.saved import Saved
from rfm_client.contract import FrameScores, FrameSize, RewardError
from rfm_client.contract.description import Description


class VlmPredictor(QwenPredictor):
    """RFM or Robometer on a device."""

    @torch.inference_mode()
    def score(self, rows: Sequence[VlmRow], batch: VlmBatch, execution: Execution) -> list[RowScores | RewardError]:
        """Run one forward pass; return each row's scores or error."""
        output = self._output(batch)
        scores, preference, similarity, may_keep = _read(output)
        of_rows, read, num_queries = [], 0, 0
        for row in rows:
            if row.packs:
                prefixes = slice(read, read + len(row.leaves) + 1)
                of_rows.append(RowScores([scores.at(prefixes)], is_of_prefixes=True))
                read = prefixes.stop
                continue
            frames = []
            for spans, video in zip(row.spans, row.videos, strict=True):
                frames.append(self._per_frame(scores.at(slice(read, read + len(spans))), video.num_shown))
                read += len(spans)
            query = None
            if row.query is not None:
                query = (similarity if row.is_similarity else preference)[num_queries]
                num_queries += 1
            of_rows.append(RowScores(frames, query))
        if may_keep:
            self._keep(rows, batch.layout, output.made)
        return list(of_rows)

    def _per_frame(self, scores: FrameScores, num_frames: int) -> FrameScores:
        """Return the scores by frame; in video mode both frames in a temporal patch share a score."""
        if self.network.config.multi_image:
            return scores
        return scores.at(np.arange(num_frames) // FRAMES_PER_GROUP)


def _read(output: VlmOutput) -> tuple[FrameScores, list[float], list[float], bool]:
    """Return all frames' scores, preferences, similarities, and True if this pass's new features are finite.

    A single copy from the device reads them all.
    """
    made = {
        "progress": progress_from_logits(output.progress),
        "success": None if output.success is None else output.success.sigmoid(),
        "preference": None if output.preference is None else output.preference.sigmoid(),
        "logits": output.progress if output.progress.shape[-1] > 1 else None,
        "similarity": output.similarity,
        "is_finite": None if output.made is None else output.made.isfinite().all(),
    }
    there = {name: tensor for name, tensor in made.items() if tensor is not None}
    parts = torch.cat([each.float().flatten() for each in there.values()]).cpu()
    split = parts.split([each.numel() for each in there.values()])
    read = {name: part.view(of.shape).numpy() for (name, of), part in zip(there.items(), split, strict=True)}
    progress = read["progress"]
    success = read["success"] if "success" in read else no_success(progress)
    scores = FrameScores(progress=progress, success=success, progress_logits=read.get("logits"))
    preference, similarity = (read[name].tolist() if name in read else [] for name in ("preference", "similarity"))
    return scores, preference, similarity, bool(read.get("is_finite", True))


@dataclass(frozen=True)
class VlmCheckpoint(QwenCheckpoint):
    """A vision-language checkpoint in memory.

    weights: for VlmRewardModel, without LoRA
    factors: LoRA factors, named as by ``rfm.qwen.lora.split``; empty without LoRA
    """

    network_of = VlmRewardModel
    predictor_of = VlmPredictor

    config: VlmConfig
    factors: dict[str, Tensor] = field(default_factory=dict)

    @property
    def description(self) -> Description:
        """The checkpoint's inputs and outputs."""
        return Description(
            kind="RFM or Robometer",
            network={"class": VlmRewardModel.__name__},
            progress_bins=self.config.progress_bins if self.config.progress_bins > 1 else None,
            trained_frames=self.config.trained_frames,
            frame_size=frame_size(self.config),
            frames_per_value=1 if self.config.multi_image else FRAMES_PER_GROUP,
            has_preference=self.config.has_preference,
            has_success=self.config.has_success,
            has_similarity=self.config.has_similarity,
            keeps_features=True,
            uses_graphs=True,
            is_large=True,
        )

    @property
    def parts(self) -> dict[str, dict[str, Tensor]]:
        """All weights: the network's, and the LoRA factors that change them."""
        return {NETWORK: self.weights, LORA: self.factors}

    def load_collator(self) -> VlmCollator:
        """Return the sample collator. Raises CheckpointError if the processor is missing or does not fit."""
        config, processor = self.config, self.processor
        num_tokens = next(len(each) for name, each in self.weights.items() if name.endswith("embed_tokens.weight"))
        tokenizer, preprocessor = read_processor(processor, videos=not config.multi_image)
        tokenizer.add_tokens(list(SPECIAL_TOKENS), special_tokens=True)
        if len(tokenizer) != num_tokens:  # upstream resizes the embedding to the tokenizer
            expected = f"a tokenizer of {num_tokens} tokens with the special ones, as the checkpoint's embedding"
            remedy = f"name the run's base model with --base-model; {OLD_RUN_REMEDY}"
            raise CheckpointError.at(f"base model {processor}", expected, len(tokenizer), remedy)
        first = len(tokenizer) - len(SPECIAL_TOKENS)
        check_tokens(config, tokenizer, processor, {token: first + index for index, token in enumerate(SPECIAL_TOKENS)})
        where = f"base model {processor}: preprocessing of {'images' if config.multi_image else 'videos'}"
        normalisation = normalisation_of(preprocessor, SIZED_BEFORE, where)
        patch = patch_px(preprocessor, config.backbone["vision_config"], where)
        return VlmCollator(config, tokenizer, QwenImages(patch, normalisation, config.size_px))


def restore(folder: Path) -> VlmCheckpoint:
    """Load what ``VlmCheckpoint.save`` wrote. Raises CheckpointError."""
    saved = Saved.read(folder)
    with expecting("the settings of an exported RFM or Robometer", folder / NETWORK_CONFIG):
        settings = {**saved.settings}
        size = settings.pop("size_px")
        config = VlmConfig(backbone=saved.backbone, size_px=tuple(size) if size else None, **settings)
    weights, factors = split(saved.weights)
    checkpoint = VlmCheckpoint(config, weights, saved.processor, factors)
    checkpoint.check()
    return checkpoint


def frame_size(config: VlmConfig) -> FrameSize | None:
    """Return the size to which a checkpoint first resizes each frame; None: it depends on the frame."""
    if config.size_px is None:
        return None
    factor = config.backbone["vision_config"]["patch_size"] * MERGE * (1 if config.multi_image else FRAMES_PER_GROUP)
    return FrameSize("exact", fitted_size(*config.size_px, factor))
