# SPDX-License-Identifier: MIT
"""Engines of the reference checkpoints, and how they are exported."""

from __future__ import annotations

import functools
import importlib.metadata
from pathlib import Path
from typing import Any

import torch

import goldens
from rfm import published
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm.files import read_run_config

TRANSFORMERS = int(importlib.metadata.version("transformers").partition(".")[0])


def serve_config(config: goldens.Config, name: str = "rfm") -> ExportConfig:
    """How the tests export a reference checkpoint."""
    return ExportConfig(name=name, num_gpus=0, torch_threads=1, **config.sources)


def scorer(checkpoint: str, **options: str) -> Any:
    """Return a scorer for labels that needs no server, as ``rfm label`` has it."""
    from rfm_commands.engine_scorer import EngineScorer

    return EngineScorer(checkpoint, **options)


@functools.cache
def load_engine(name: str) -> Engine:
    """Return the engine of a reference checkpoint, with encoders if there are any."""
    config = goldens.config(name)
    loaded = published.read(config.checkpoint, **config.sources)
    return Engine.of(loaded.checkpoint, encoders=loaded.encoders())


@functools.cache
def asked_engine(folder: Path, reward_model: str, dtype: torch.dtype | None = None) -> Engine:
    """Return the engine of a model that is asked in words. reward_model: as ``--as`` takes it"""
    return Engine.of(published.load(folder, reward_model=reward_model), dtype=dtype)


def training_run(file: Path) -> dict[str, Any]:
    """Return the configuration of a training run, whose file names Python classes."""
    return read_run_config(file)
