# SPDX-License-Identifier: MIT
"""Which checkpoint a model serves, as parameters of its configuration: for those who ask the server."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rfm.checkpoint import Checkpoint, RewindCheckpoint
from rfm.models.rewind import RewindTransformer
from rfm.models.vlm import VlmRewardModel
from rfm_client.model_info import NETWORK_PARAMETER, SOURCE_PARAMETER

_TOLD_PARTS = 2  # of a path; all of it is nobody else's business


def about(checkpoint: Checkpoint, source: str | Path) -> dict[str, str]:
    """Parameters by name. source: a local folder, or Hub id"""
    folder = Path(source)
    told = "/".join(folder.resolve().parts[-_TOLD_PARTS:]) if folder.exists() else str(source)
    return {SOURCE_PARAMETER: told, NETWORK_PARAMETER: json.dumps(_network(checkpoint))}


def told_source(config: Any) -> str:
    """The source that an exported configuration names."""
    return str(config.parameters[SOURCE_PARAMETER].string_value)


def _network(checkpoint: Checkpoint) -> dict[str, Any]:
    is_rewind = isinstance(checkpoint, RewindCheckpoint)
    weights = checkpoint.network if isinstance(checkpoint, RewindCheckpoint) else checkpoint.weights
    parameters: Counter[str] = Counter()
    for name, tensor in weights.items():
        parameters[name.partition(".")[0]] += tensor.numel()
    return {
        "class": (RewindTransformer if is_rewind else VlmRewardModel).__name__,
        "config": asdict(checkpoint.config),
        "parameters": dict(parameters),
    }
