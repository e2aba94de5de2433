# SPDX-License-Identifier: MIT
"""Vision-language checkpoints, and copies of them to spoil."""

from __future__ import annotations

from collections.abc import Sequence
from inspect import signature
from pathlib import Path

import numpy as np
import torch

import goldens
from engines import load_engine
from goldens import assert_close as assert_close
from rfm import published
from rfm.families.robometer.checkpoint import VlmCheckpoint, VlmPredictor
from rfm.qwen.backbone import UNIT
from rfm.qwen.batch import VlmRow
from rfm_client import Trajectory

BFLOAT16 = "q3_tok_disc10_bf16"
PLAIN = "q3_tok_disc10"


def predictor_of(name: str) -> VlmPredictor:
    predictor = load_engine(name).predictor
    assert isinstance(predictor, VlmPredictor)
    return predictor


def video(seed: int, num_frames: int, height: int, width: int, task: str = "stack the blocks") -> Trajectory:
    frames = np.random.default_rng(seed).integers(0, 256, (num_frames, height, width, 3), np.uint8)
    return Trajectory(frames=frames, task=task)


def load(name: str, folder: Path | None = None, base: str | None = None) -> VlmCheckpoint:
    config = goldens.config(name)
    checkpoint = published.load(folder or config.checkpoint, base_model=base or str(config.base_model))
    assert isinstance(checkpoint, VlmCheckpoint)
    return checkpoint


def upstream_inputs(predictor: VlmPredictor, rows: Sequence[VlmRow]) -> dict[str, torch.Tensor]:
    """Return upstream's arguments for the backbone: every shot in order, with repetitions."""
    batch = predictor.collate(rows).to(torch.device("cpu"), torch.float32)
    mask = torch.zeros_like(batch.inputs["input_ids"])
    for index, row in enumerate(rows):
        mask[index, : row.num_tokens] = 1
    merged = batch.inputs["pixel_values"].unflatten(0, (-1, UNIT))
    pixels = merged[batch.inputs["visual_features"]].flatten(0, 1)
    inputs = {"input_ids": batch.inputs["input_ids"], "attention_mask": mask}
    backbone, kinds = predictor.network.model, "mm_token_type_ids"  # of tokens: text, picture, video
    if kinds in signature(backbone.forward).parameters:  # since transformers 5
        is_picture, is_video = (
            (inputs["input_ids"] == token).int()
            for token in (backbone.config.image_token_id, backbone.config.video_token_id)
        )
        inputs[kinds] = is_picture + 2 * is_video
    grids = [predictor.collator.grid(video) for row in rows for video in row.videos]
    if not predictor.network.config.multi_image:
        grid = torch.tensor([[each.groups, each.rows, each.columns] for each in grids])
        return inputs | {"pixel_values_videos": pixels, "video_grid_thw": grid}
    grid = torch.tensor([[1, each.rows, each.columns] for each in grids for _ in range(each.groups)])
    return inputs | {"pixel_values": pixels, "image_grid_thw": grid}
