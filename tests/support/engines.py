# SPDX-License-Identifier: MIT
"""Engines of the reference checkpoints, and how they are exported."""

from __future__ import annotations

import functools
import importlib.metadata

import pytest

import goldens
from rfm import families
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm.rewind.predictor import RewindPredictor

TRANSFORMERS = int(importlib.metadata.version("transformers").partition(".")[0])


def serve_config(config: goldens.Config, name: str = "rfm") -> ExportConfig:
    """How the tests export a reference checkpoint."""
    return ExportConfig(
        name=name,
        num_gpus=0,
        torch_threads=1,
        image_encoder=str(config.image_encoder) if config.image_encoder else None,
        text_encoder=str(config.text_encoder) if config.text_encoder else None,
        base_model=str(config.base_model) if config.base_model else None,
    )


@functools.cache
def load_engine(name: str) -> Engine:
    """The engine of a reference checkpoint, with its encoders if it has some."""
    if name.startswith("smol") and TRANSFORMERS >= 5:
        pytest.skip("SmolVLM is refused with transformers 5")
    config = goldens.config(name)
    sources = {
        option: str(source)
        for option in ("base_model", "image_encoder", "text_encoder")
        if (source := getattr(config, option)) is not None
    }
    checkpoint = families.load(config.checkpoint, **sources)
    return Engine.of(checkpoint, encoders=checkpoint.encoders())


def rewind_of(name: str) -> RewindPredictor:
    """What of a reference checkpoint's engine is ReWiND's own."""
    predictor = load_engine(name).predictor
    assert isinstance(predictor, RewindPredictor)
    return predictor
