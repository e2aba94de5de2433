# SPDX-License-Identifier: MIT
"""Which checkpoint a model serves, as parameters of its configuration: for those who ask the server."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tritonclient.grpc import model_config_pb2 as pb

from rfm.checkpoint import Checkpoint, RewindCheckpoint
from rfm.checkpoint.digest import weights_digest
from rfm.models.encoders import Encoders
from rfm.models.rewind import RewindTransformer
from rfm.models.vlm import VlmRewardModel
from rfm_client.model_info import DIGEST_PARAMETER, NETWORK_PARAMETER, REVISION_PARAMETER, SOURCE_PARAMETER

_TOLD_PARTS = 2  # of a path; all of it is nobody else's business


@dataclass(frozen=True)
class Origin:
    """Where a checkpoint came from.

    source: the end of its folder's path, or its Hub id
    revision: the Hub's commit; empty for a folder
    """

    source: str
    revision: str

    @classmethod
    def of(cls, source: str | Path, folder: Path) -> Origin:
        """source: as the user named it; folder: where its files lie, of the Hub's a snapshot named by its commit"""
        named = Path(source).expanduser()
        if str(source) and named.is_dir():
            return cls("/".join(named.resolve().parts[-_TOLD_PARTS:]), "")
        return cls(str(source), folder.name)

    @classmethod
    def told(cls, config: pb.ModelConfig) -> Origin:
        """As an exported configuration tells it."""
        return cls(*(str(config.parameters[name].string_value) for name in (SOURCE_PARAMETER, REVISION_PARAMETER)))

    @property
    def parameters(self) -> dict[str, str]:
        """By name."""
        return {SOURCE_PARAMETER: self.source, REVISION_PARAMETER: self.revision}


def about(checkpoint: Checkpoint, origin: Origin) -> dict[str, str]:
    """Parameters by name, but for what tells the weights, which are to be written yet."""
    return {**origin.parameters, NETWORK_PARAMETER: json.dumps(_network(checkpoint))}


def about_encoders(of_scorer: Mapping[str, str]) -> dict[str, str]:
    """Parameters of the encoders that were exported with a scorer of these parameters."""
    return {
        **{name: of_scorer[name] for name in (SOURCE_PARAMETER, REVISION_PARAMETER)},
        NETWORK_PARAMETER: json.dumps({"class": Encoders.__name__}),
    }


def tell_weights(config: pb.ModelConfig, version: int, repository: Path) -> None:
    """Sets the parameter that tells a version's weights in ``repository``: those of an ensemble's parts together."""
    parts = [step.model_name for step in config.ensemble_scheduling.step] or [config.name]
    digest = weights_digest(repository / part / str(version) for part in parts)
    config.parameters[DIGEST_PARAMETER].string_value = digest


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
