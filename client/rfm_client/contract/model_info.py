# SPDX-License-Identifier: MIT
"""A server's description of a model: limits, input widths, origin."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from rfm_client.contract import wire
from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.frame_size import FrameSize
from rfm_client.contract.results import FRAME_SCORES

MAX_FRAMES_PARAMETER = "max_frames"  # parameters of config.pbtxt; empty: unknown
FRAME_SIZE_PARAMETER = "frame_size"
FRAMES_PER_VALUE_PARAMETER = "frames_per_value"
TRAINED_PADDING_PARAMETER = "trained_padding"  # "false"; any other value: true
SOURCE_PARAMETER = "source"
REVISION_PARAMETER = "revision"
DIGEST_PARAMETER = "weights_digest"
SETTINGS_DIGEST_PARAMETER = "settings_digest"
COMPUTATION_PARAMETER = "computation"
NETWORK_PARAMETER = "network"
RUN_CONFIG_PARAMETER = "run_config"
KIND_PARAMETER = "kind"
LICENSE_PARAMETER = "license"
LACKS_PARAMETER = "lacks"  # names of scores that the checkpoint does not give, with commas between
WEIGHTS_DIFFERENCE_PARAMETER = "weights_difference"  # largest difference of progress; empty: not measured
WHOLE_EPISODE_PARAMETER = "needs_whole_episode"  # "true"; any other value: false


@dataclass(frozen=True)
class ModelInfo:
    """A served model.

    versions: versions that its configuration demands; empty: the latest
    max_batch_size: most samples in a request
    by_digest: True if the model accepts frame references
    instances: number on a server; 0: an ensemble, whose parts have instances
    max_frames: most frames of a trajectory: the smaller limit of training and network; None: both unknown
    trained_padding: True if training padded shorter trajectories with their last frame, as upstream does, or if unknown
    frame_size: size to which the checkpoint resizes frames; None: it depends on the frame
    video_dim, text_dim: widths D and Dt of embeddings that the model reads, or writes as an encoder; None: neither
    progress_bins: number K of progress bins of a discrete checkpoint; None: continuous
    frames_per_value: consecutive frames that share a score; 2 if a vision-language model reads trajectories as videos
    source: Hub id of the exported checkpoint, or the end of its path; None: unknown
    revision: exported commit of the Hub; None: the checkpoint was a folder
    weights_digest: 16 hex digits, digest of the exported weights; None: unknown
    settings_digest: 16 hex digits, digest of all else that decides scores: files beside the weights (configuration,
        tokenizer, image processor), dtype, kind of device; None: unknown
    computation: number type, PyTorch version and attention kernel, as at the export; None: unknown
    network: ``class``, ``config``, and the number of weights of each part (``parameters``)
    run_config: config.yaml of the training run, without secrets; empty: the checkpoint has none
    kind: name of the reward model, such as TOPReward; None: unknown
    license: licence of the weights, by the checkpoint's model card or config.json; None: unknown
    lacks: which of success, preference and similarity the checkpoint does not give; None: unknown
    scores: names of the scores of frames that it gives, which are fields of ``FrameScores``
    needs_whole_episode: True if its scores are relative to the whole episode, so it cannot score while one runs
    weights_difference: largest difference of progress from the full checkpoint's, which the export measured on noise
        when it rounded weights; None: not measured
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
    computation: str | None = None
    network: Mapping[str, Any] = field(default_factory=dict)
    run_config: Mapping[str, Any] = field(default_factory=dict)
    kind: str | None = None
    license: str | None = None
    lacks: tuple[str, ...] | None = None
    scores: tuple[str, ...] = ()
    needs_whole_episode: bool = False
    weights_difference: float | None = None

    @property
    def weights(self) -> str | None:
        """Form of rounded weights (int8, nf4), whose scores are not the full checkpoint's; None: not rounded."""
        found = self.network.get("config", {}).get("weights")
        return found if isinstance(found, str) else None

    @property
    def widths(self) -> tuple[int, int] | None:
        """``video_dim`` and ``text_dim``; None: the model reads raw frames and writes scores."""
        return None if self.video_dim is None or self.text_dim is None else (self.video_dim, self.text_dim)

    def check_scores_prefixes(self) -> None:
        """Raise InvalidSampleError for a model that cannot score while an episode runs."""
        if self.needs_whole_episode:
            expected = "a model that scores an episode while it runs"
            got = f"{self.kind}, whose progress is relative to the whole episode: score it at its end"
            raise InvalidSampleError.at(f"model {self.name}", expected, got)

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> ModelInfo:
        """Read Triton's model configuration, in the form of its HTTP API.

        Raises ValueError, LookupError or TypeError for a model that this project did not export.
        """
        last_dims = {tensor["name"]: int(tensor["dims"][-1]) for tensor in (*config["input"], *config["output"])}
        parameters = {name: value.get("string_value", "") for name, value in config.get("parameters", {}).items()}
        max_frames = parameters.get(MAX_FRAMES_PARAMETER)
        frame_size = parameters.get(FRAME_SIZE_PARAMETER)
        lacks = parameters.get(LACKS_PARAMETER)
        difference = parameters.get(WEIGHTS_DIFFERENCE_PARAMETER)
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
            computation=parameters.get(COMPUTATION_PARAMETER) or None,
            network=json.loads(parameters.get(NETWORK_PARAMETER) or "{}"),
            run_config=json.loads(parameters.get(RUN_CONFIG_PARAMETER) or "{}"),
            kind=parameters.get(KIND_PARAMETER) or None,
            license=parameters.get(LICENSE_PARAMETER) or None,
            lacks=tuple(filter(None, lacks.split(","))) if lacks is not None else None,
            scores=tuple(name for name in FRAME_SCORES if name in last_dims),
            needs_whole_episode=parameters.get(WHOLE_EPISODE_PARAMETER) == "true",
            weights_difference=float(difference) if difference else None,
        )


def _num_instances(group: Mapping[str, Any]) -> int:
    """Instances of a group: ``count`` on each of its GPUs, or on the CPU."""
    return int(group.get("count", 1)) * max(len(group.get("gpus", [])), 1)
