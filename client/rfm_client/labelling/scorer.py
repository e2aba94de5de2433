# SPDX-License-Identifier: MIT
"""What scores: a server behind a client, or an engine in this process. T frames, H x W pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol, cast

from rfm_client.client import RewardClient
from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.frame_size import FrameSize
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.results import ProgressResult
from rfm_client.contract.samples import ProgressSample, Trajectory, UInt8Array
from rfm_client.data.datasets.protocol import digest_of


@dataclass(frozen=True)
class CheckpointFacts:
    """What decides a checkpoint's scores, and what it takes.

    source, revision: where it came from; None: not known
    weights_digest: of its weights
    settings_digest: of what else decides its scores: configuration, encoders, dtype, device
    max_frames: the most frames of a trajectory in training; if it does not say, the most that its network takes; None:
        neither is known
    frame_size: to what it brings each frame; None: that depends on the frame
    encodes: frames can be encoded by themselves, and prefixes scored from their embeddings
    is_causal: no frame's score depends on later frames
    trained_padding: training padded shorter trajectories; True also of a checkpoint that does not say
    """

    source: str | None
    revision: str | None
    weights_digest: str
    settings_digest: str
    max_frames: int | None
    frame_size: FrameSize | None
    encodes: bool
    is_causal: bool
    trained_padding: bool = True

    def document(self) -> dict[str, Any]:
        """What provenance says of it."""
        told = ("source", "revision", "weights_digest", "settings_digest")
        return {name: value for name, value in asdict(self).items() if name in told}


class Scorer(Protocol):
    """Scores samples of one checkpoint. Used by several threads at a time."""

    def checkpoint(self) -> CheckpointFacts:
        """The facts of the checkpoint that answers now. Raises RewardError."""

    def encode(self, frames: UInt8Array, task: str) -> Trajectory:
        """The embeddings of frames, uint8 [T, H, W, 3], and task, if the checkpoint ``encodes``. Raises RewardError."""

    def evaluate(self, samples: Sequence[ProgressSample]) -> list[ProgressResult]:
        """The result of each sample. Raises RewardError for the first that fails."""


class ClientScorer:
    """Scores by asking the servers of a client, which stays open."""

    def __init__(self, client: RewardClient) -> None:
        self._client = client

    def checkpoint(self) -> CheckpointFacts:
        """The facts that the servers tell. Raises RewardError, and so where they serve different checkpoints."""
        infos = self._client.model_infos()
        digests = [_digests(told) for told in infos.values()]
        info = infos["frames"][0] if "frames" in infos else self._client.model_info(frames=True)
        if info.weights_digest is None:
            raise InvalidSampleError.at(
                f"model {info.name}", "a weights_digest, as exports have since version 0.1.0", "none: export it again"
            )
        embedded = infos["embeddings"][0] if "embeddings" in infos else None
        network = info.network if embedded is None else embedded.network
        return CheckpointFacts(
            source=info.source,
            revision=info.revision,
            weights_digest=info.weights_digest,
            settings_digest=digest_of(str(each).encode() for each in digests),
            max_frames=info.max_frames,
            frame_size=info.frame_size,
            encodes=embedded is not None,
            is_causal=network.get("config", {}).get("causal_mask") is True,
            trained_padding=info.trained_padding,
        )

    def encode(self, frames: UInt8Array, task: str) -> Trajectory:
        """The embeddings of frames and task. Raises RewardError."""
        return self._client.encode(Trajectory(frames=frames, task=task))

    def evaluate(self, samples: Sequence[ProgressSample]) -> list[ProgressResult]:
        """The result of each sample. Raises RewardError for the first that fails."""
        return cast("list[ProgressResult]", self._client.evaluate(samples))


def _digests(infos: Sequence[ModelInfo]) -> tuple[str, str | None, str | None]:
    """A model's name and digests. Raises InvalidSampleError if the servers serve different ones."""
    digests = {(info.name, info.weights_digest, info.settings_digest) for info in infos}
    if len(digests) > 1:
        told = " and ".join(sorted(f"{weights}, {settings}" for _, weights, settings in digests))
        raise InvalidSampleError.at(
            f"model {infos[0].name}", "the same weights_digest, settings_digest at every server", told
        )
    return digests.pop()
