# SPDX-License-Identifier: MIT
"""A served model: the description of its checkpoint, and the settings that Triton serves it with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rfm_client.contract import wire
from rfm_client.contract.description import DESCRIPTION_PARAMETER, Description
from rfm_client.contract.errors import InferenceFailedError, InvalidSampleError


@dataclass(frozen=True, kw_only=True)
class ModelInfo(Description):
    """A served model. Facts of its checkpoint: as in ``Description`` and ``Origin``.

    versions: versions that its configuration demands; empty: the latest
    max_batch_size: most samples in a request
    by_digest: True if the model accepts frame references
    instances: number on a server; 0: an ensemble, whose parts have instances
    """

    name: str
    versions: tuple[str, ...]
    max_batch_size: int
    by_digest: bool = False
    instances: int = 1

    @property
    def scores_whole_prefixes(self) -> bool:
        """True if the FastAPI evaluation server shows the model all frames of a prefix (RoboReward), else four."""
        return (self.kind or "").startswith("RoboReward")

    def check_scores_prefixes(self) -> None:
        """Raise InvalidSampleError for a model that cannot score while an episode runs."""
        if self.needs_whole_episode:
            expected = "a model that scores an episode while it runs"
            got = f"{self.kind}, whose progress is relative to the whole episode: score it at its end"
            raise InvalidSampleError.at(f"model {self.name}", expected, got)

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> ModelInfo:
        """Read Triton's model configuration, in the form of its HTTP API.

        Raises InferenceFailedError for a model without the description of an export, ValueError, LookupError or
        TypeError for an answer that is no configuration.
        """
        stored = config.get("parameters", {}).get(DESCRIPTION_PARAMETER, {})
        try:
            description = Description.parse(stored.get("string_value", ""))
        except ValueError as error:
            remedy = "export the checkpoint again with the version of rfm that serves it"
            raise InferenceFailedError(f"model {config['name']}: config.pbtxt: {error}; {remedy}") from error
        versions = config.get("version_policy", {}).get("specific", {}).get("versions", [])
        return cls(
            **vars(description),
            name=config["name"],
            versions=tuple(str(version) for version in versions),
            max_batch_size=int(config["max_batch_size"]),
            by_digest=any(tensor["name"] == wire.FRAME_DIGESTS for tensor in config["input"]),
            instances=sum(map(_num_instances, config.get("instance_group", []))),
        )


def _num_instances(group: Mapping[str, Any]) -> int:
    """Instances of a group: ``count`` on each of its GPUs, or on the CPU."""
    return int(group.get("count", 1)) * max(len(group.get("gpus", [])), 1)
