# SPDX-License-Identifier: MIT
"""What a server says of a model before the first sample: its limits, and the widths that it reads."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rfm_client.contract import wire
from rfm_client.contract.frame_size import FrameSize

MAX_FRAMES_PARAMETER = "max_frames"  # parameters of config.pbtxt; empty: no limit
FRAME_SIZE_PARAMETER = "frame_size"
FRAMES_PER_VALUE_PARAMETER = "frames_per_value"
TRAINED_PADDING_PARAMETER = "trained_padding"  # "false", or anything else for true
SOURCE_PARAMETER = "source"
REVISION_PARAMETER = "revision"
DIGEST_PARAMETER = "weights_digest"
SETTINGS_DIGEST_PARAMETER = "settings_digest"
NETWORK_PARAMETER = "network"
RUN_CONFIG_PARAMETER = "run_config"


@dataclass(frozen=True)
class ModelInfo:
    """A served model.

    versions: those that its configuration asks the server to serve; empty: the latest
    max_batch_size: most samples of one request
    by_digest: whether it keeps what it made of frames, and takes their digests in place of pixels
    instances: of the model that one server runs; 0: of an ensemble, whose parts have them
    max_frames: the most frames of a trajectory in training; if the checkpoint does not say, the most that its network
        takes; None: neither is known
    trained_padding: training padded shorter trajectories with their last frame, as upstream's does; True also of a
        checkpoint that does not say
    frame_size: to what the checkpoint brings each frame; None: that depends on the frame
    video_dim, text_dim: widths D and Dt of the embeddings; None: it reads raw frames
    progress_bins: K of a discrete checkpoint; None: continuous
    frames_per_value: frames that share their scores; 2 where a vision-language model sees a trajectory as a video
    source: which checkpoint was exported: its Hub id, or the end of its path; None: it does not say
    revision: the commit of the Hub that was exported; None: it was a folder
    weights_digest: 16 hex digits, a digest of the exported weights; None: the server does not say
    settings_digest: 16 hex digits, a digest of what else decides scores: the files beside the weights (configuration,
        tokenizer, image processor), the dtype and the kind of device; None: the server does not say
    network: its class, its configuration (config), and how many numbers each part of it has (parameters)
    run_config: config.yaml of the training run, without secrets; empty: the checkpoint had none
    """

    name: str
    versions: tuple[str, ...]
    max_batch_size: int
    max_frames: int | None
    frame_size: FrameSize | None
    video_dim: int | None
    text_dim: int | None
    progress_bins: int | None
    frames_per_value: int = 1
    trained_padding: bool = True
    by_digest: bool = False
    instances: int = 1
    source: str | None = None
    revision: str | None = None
    weights_digest: str | None = None
    settings_digest: str | None = None
    network: Mapping[str, Any] = field(default_factory=dict)
    run_config: Mapping[str, Any] = field(default_factory=dict)

    @property
    def widths(self) -> tuple[int, int] | None:
        """D and Dt of the embeddings that it reads; None: it reads raw frames."""
        return None if self.video_dim is None or self.text_dim is None else (self.video_dim, self.text_dim)

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> ModelInfo:
        """What Triton's model configuration, as its HTTP API writes it, says of the model.

        Raises ValueError, LookupError or TypeError for a configuration that is not one of ours.
        """
        last_dims = {tensor["name"]: int(tensor["dims"][-1]) for tensor in (*config["input"], *config["output"])}
        parameters = {name: value.get("string_value", "") for name, value in config.get("parameters", {}).items()}
        max_frames = parameters.get(MAX_FRAMES_PARAMETER)
        frame_size = parameters.get(FRAME_SIZE_PARAMETER)
        versions = config.get("version_policy", {}).get("specific", {}).get("versions", [])
        return cls(
            name=config["name"],
            versions=tuple(str(version) for version in versions),
            max_batch_size=int(config["max_batch_size"]),
            max_frames=int(max_frames) if max_frames else None,
            frame_size=FrameSize.parse(frame_size) if frame_size else None,
            video_dim=last_dims.get(wire.VIDEO_EMBEDDINGS),
            text_dim=last_dims.get(wire.TEXT_EMBEDDING),
            progress_bins=last_dims.get(wire.PROGRESS_LOGITS),
            frames_per_value=int(parameters.get(FRAMES_PER_VALUE_PARAMETER) or 1),
            trained_padding=parameters.get(TRAINED_PADDING_PARAMETER) != "false",
            by_digest=wire.FRAME_DIGESTS in last_dims,
            instances=sum(map(_num_instances, config.get("instance_group", []))),
            source=parameters.get(SOURCE_PARAMETER) or None,
            revision=parameters.get(REVISION_PARAMETER) or None,
            weights_digest=parameters.get(DIGEST_PARAMETER) or None,
            settings_digest=parameters.get(SETTINGS_DIGEST_PARAMETER) or None,
            network=json.loads(parameters.get(NETWORK_PARAMETER) or "{}"),
            run_config=json.loads(parameters.get(RUN_CONFIG_PARAMETER) or "{}"),
        )


def _num_instances(group: Mapping[str, Any]) -> int:
    """Instances of one group of a configuration: so many on each of its GPUs, or on the CPU."""
    return int(group.get("count", 1)) * max(len(group.get("gpus", [])), 1)
