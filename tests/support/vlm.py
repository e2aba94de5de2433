# SPDX-License-Identifier: MIT
"""Vision-language checkpoints, and copies of them to spoil."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import goldens
from engines import load_engine
from rfm import families
from rfm.vlm.checkpoint import VlmCheckpoint
from rfm.vlm.predictor import VlmPredictor
from rfm_client import (
    Trajectory,
)

BFLOAT16 = "q3_tok_disc10_bf16"


PLAIN = "q3_tok_disc10"


def predictor_of(name: str) -> VlmPredictor:
    predictor = load_engine(name).predictor
    assert isinstance(predictor, VlmPredictor)
    return predictor


def film(seed: int, num_frames: int, height: int, width: int, task: str = "stack the blocks") -> Trajectory:
    frames = np.random.default_rng(seed).integers(0, 256, (num_frames, height, width, 3), np.uint8)
    return Trajectory(frames=frames, task=task)


def assert_close(left: object, right: object, tolerance: float) -> None:
    assert not isinstance(left, Exception), left
    assert not isinstance(right, Exception), right
    for a, b in zip(goldens.frame_scores(left), goldens.frame_scores(right), strict=True):  # type: ignore[arg-type]
        np.testing.assert_allclose(a.progress, b.progress, rtol=0, atol=tolerance)
        np.testing.assert_allclose(a.success, b.success, rtol=0, atol=tolerance)
    for name in ("preference", "similarity"):
        if hasattr(left, name):
            assert abs(getattr(left, name) - getattr(right, name)) <= tolerance


def load(name: str, folder: Path | None = None, base: str | None = None) -> VlmCheckpoint:
    config = goldens.config(name)
    checkpoint = families.load(folder or config.checkpoint, base_model=base or str(config.base_model))
    assert isinstance(checkpoint, VlmCheckpoint)
    return checkpoint
