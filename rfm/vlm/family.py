# SPDX-License-Identifier: MIT
"""RFM and Robometer: raw frames and a task as a conversation, into a vision-language backbone with reward heads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rfm.checkpoint.content import CheckpointError, read_json
from rfm.checkpoint.preprocessor import PREPROCESSOR_CONFIG
from rfm.execution import Execution
from rfm.family import RowScores, checked, frame_scores, part_of
from rfm.layers.linear import speed_up
from rfm.vlm.checkpoint import VlmCheckpoint
from rfm.vlm.collator import QwenCollator, SmolCollator, VlmCollator, VlmRow
from rfm.vlm.images import FRAMES_PER_GROUP, Normalisation, QwenImages, SmolImages
from rfm.vlm.network import SMOL, VlmBatch, VlmConfig
from rfm.vlm.prompts import SPECIAL_TOKENS
from rfm_client.contract import FrameScores, InvalidSampleError, RewardError, Sample

SMOL_SIZE_PX = 512  # what upstream sets, whatever the base model says; so no image is split


class VlmFamily:
    """A vision-language reward model on a device."""

    def __init__(self, network: Any, collator: VlmCollator, device: torch.device) -> None:
        self.network = network.to(device).eval()
        speed_up(self.network)
        self.collator = collator
        self.device = device
        self._dtype = next(network.parameters()).dtype
        self._max_tokens = int(network.model.config.get_text_config().max_position_embeddings)

    @classmethod
    def of(
        cls, checkpoint: VlmCheckpoint, processor: str | Path, device: torch.device, dtype: torch.dtype | None = None
    ) -> VlmFamily:
        """With tokenizer and image preprocessing from ``processor``, the base model's folder or id."""
        collator = load_collator(checkpoint, processor)
        return cls(checkpoint.build(dtype), collator, device)

    def rows(self, samples: Sequence[Sample], execution: Execution) -> list[list[VlmRow] | RewardError]:
        """Each sample's conversations, or its error; that takes no forward pass."""
        outcomes: list[list[VlmRow] | RewardError] = []
        for sample in samples:
            try:
                outcomes.append(self._checked(self.collator.rows(sample)))
            except InvalidSampleError as error:
                outcomes.append(error)
        return outcomes

    def _checked(self, rows: list[VlmRow]) -> list[VlmRow]:
        """The backbone has learned no positions beyond its own; its scores of those would mean nothing."""
        longest = max(row.num_tokens for row in rows)
        if longest > self._max_tokens:
            expected = f"at most {self._max_tokens} tokens (max_position_embeddings of this checkpoint)"
            raise InvalidSampleError.at("num_frames", expected, f"{longest} tokens")
        return rows

    def lengths(self, row: VlmRow) -> tuple[int, ...]:
        """Tokens of the conversation."""
        return (row.num_tokens,)

    def num_tokens(self, lengths: Sequence[int]) -> int:
        """Tokens of the conversation."""
        return lengths[0]

    def collate(self, rows: Sequence[VlmRow]) -> VlmBatch:
        """Conversations of any kind; here their pixels are made."""
        return self.collator.collate(rows)

    def occupancy(self, batch: VlmBatch) -> tuple[int, int]:
        """Of conversations, padded to the longest."""
        mask = batch.inputs["attention_mask"]
        return int(mask.sum()), mask.numel()

    @torch.inference_mode()
    def score(self, rows: Sequence[VlmRow], batch: VlmBatch) -> list[RowScores | RewardError]:
        """One forward pass."""
        output = self.network(batch.to(self.device, self._dtype))
        scores = frame_scores(output.progress, output.success)
        preference = output.preference.sigmoid().float().tolist()
        similarity = [] if output.similarity is None else output.similarity.float().tolist()
        of_rows, read, asked = [], 0, 0
        for row in rows:
            frames = []
            for spans, num_frames in zip(row.spans, row.num_frames, strict=True):
                frames.append(self._per_frame(part_of(scores, slice(read, read + len(spans))), num_frames))
                read += len(spans)
            query = None
            if row.query is not None:
                query = (similarity if row.is_similarity else preference)[asked]
                asked += 1
            of_rows.append(RowScores(frames, query))
        return checked(of_rows)

    def _per_frame(self, scores: FrameScores, num_frames: int) -> FrameScores:
        """In video mode both frames of a temporal group carry its value."""
        if self.network.config.multi_image:
            return scores
        return part_of(scores, np.arange(num_frames) // FRAMES_PER_GROUP)


def load_collator(checkpoint: VlmCheckpoint, processor: str | Path) -> VlmCollator:
    """The collator of a checkpoint. Raises CheckpointError for a processor that cannot be had or does not fit."""
    from transformers import AutoTokenizer
    from transformers.utils.hub import cached_file

    try:
        tokenizer = AutoTokenizer.from_pretrained(str(processor), use_fast=True, trust_remote_code=False)
        preprocessor = read_json(Path(str(cached_file(str(processor), PREPROCESSOR_CONFIG))))
        tokenizer.chat_template = _chat_template(processor, tokenizer)
    except (LookupError, OSError, ValueError) as error:
        hint = "name its folder with --base-model"
        raise CheckpointError(f"base model {processor}: tokenizer and processor: {error} ({hint})") from error
    tokenizer.add_tokens(list(SPECIAL_TOKENS), special_tokens=True)
    rows = next(t for name, t in checkpoint.weights.items() if name.endswith("embed_tokens.weight")).shape[0]
    if len(tokenizer) != rows:  # upstream resizes the embedding to it
        expected = f"a tokenizer of {rows} tokens with the special ones, as the checkpoint's embedding"
        raise CheckpointError(f"base model {processor}: expected {expected}, got {len(tokenizer)}")
    return _collator(checkpoint.config, tokenizer, preprocessor, processor)


def _chat_template(processor: str | Path, tokenizer: Any) -> str:
    """The processor's, by which upstream prompts; the tokenizer's where the processor has none. Raises ValueError."""
    from transformers import ProcessorMixin

    of_processor = ProcessorMixin.get_processor_dict(str(processor))[0].get("chat_template")
    template = tokenizer.chat_template if of_processor is None else of_processor
    if isinstance(template, dict):  # several, by name
        template = template.get("default")
    if not isinstance(template, str):
        raise ValueError("expected a chat template, got none")
    return template


def save_processor(collator: VlmCollator, folder: Path) -> None:
    """Writes what ``load_collator`` reads, so that serving needs no network."""
    import json

    collator.tokenizer.save_pretrained(folder)
    (folder / PREPROCESSOR_CONFIG).write_text(json.dumps(collator.images.to_config(), indent=2) + "\n")


def _collator(config: VlmConfig, tokenizer: Any, preprocessor: dict[str, Any], where: str | Path) -> VlmCollator:
    if abs(preprocessor.get("rescale_factor", 1 / 255) - 1 / 255) > 1e-9:  # Qwen's own files leave the default out
        raise CheckpointError(f"{where}: rescale_factor: expected 1/255, got {preprocessor.get('rescale_factor')}")
    normalisation = Normalisation(tuple(preprocessor["image_mean"]), tuple(preprocessor["image_std"]))
    if config.family != SMOL:
        images = QwenImages(preprocessor["patch_size"], normalisation, config.size_px)
        return QwenCollator(config, tokenizer, images)
    vision = config.backbone["vision_config"]
    tokens = (vision["image_size"] // vision["patch_size"] // config.backbone["scale_factor"]) ** 2
    return SmolCollator(config, tokenizer, SmolImages(SMOL_SIZE_PX, preprocessor["resample"], tokens, normalisation))
