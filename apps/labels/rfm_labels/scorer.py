# SPDX-License-Identifier: MIT
"""Scorers for a labelling run: a server behind a client, or an in-process engine. T frames, H x W pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Protocol, cast, runtime_checkable

from rfm_client import (
    FRAME_SCORES,
    FrameSize,
    InvalidSampleError,
    ModelInfo,
    ProgressResult,
    ProgressSample,
    RewardClient,
    Trajectory,
    UInt8Array,
)
from rfm_client.frames import Sampling
from rfm_labels.datasets.stored_files import digest_of

DECISIVE = ("weights_digest", "settings_digest", "computation")  # equal if the scores are


@dataclass(frozen=True)
class CheckpointFacts:
    """A checkpoint's origin, limits, and what decides its scores. Other fields: as in ``rfm_client.ModelInfo``.

    weights_digest: over the weights
    settings_digest: over everything else that decides the scores: configuration, encoders, dtype, device
    encodes: True if the checkpoint can encode frames alone, and score prefixes from their embeddings
    is_causal: True if a frame's score never depends on later frames
    has_progress: False if it predicts remaining seconds instead of progress
    reads_views: True if it reads additional camera views and a goal
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
    needs_whole_episode: bool = False
    computation: str | None = None
    weights: str | None = None
    has_progress: bool = True
    reads_views: bool = False

    @classmethod
    def of(cls, described: object, **own: Any) -> CheckpointFacts:
        """Copy the facts from a description, such as a ModelInfo. own: fields that differ from it, or that it lacks."""
        names = [each.name for each in fields(cls) if each.name not in own]
        return cls(**own, **{name: getattr(described, name) for name in names})

    def document(self) -> dict[str, Any]:
        """Return the facts for the provenance."""
        names, newer = ("source", "revision", *DECISIVE, "weights"), ("computation", "weights")
        there = {name: value for name, value in asdict(self).items() if name in names}
        # Older labels lack the newer fields, and episode digests depend on the provenance.
        return {name: value for name, value in there.items() if value is not None or name not in newer}


class Scorer(Protocol):
    """Scores samples with one checkpoint. Must be thread-safe. May be a ``CurveScorer``, too."""

    def checkpoint(self) -> CheckpointFacts:
        """Return facts about the checkpoint that answers now. Raises RewardError."""

    def encode(self, frames: UInt8Array, task: str) -> Trajectory:
        """Return embeddings for frames, uint8 [T, H, W, 3], and task; needs ``encodes``. Raises RewardError."""

    def evaluate(self, samples: Sequence[ProgressSample]) -> list[ProgressResult]:
        """Return one result per sample. Raises RewardError for the first failure."""


@runtime_checkable
class CurveScorer(Protocol):
    """A scorer with this method scores prefixes by it instead of by ``evaluate``, which gets each frame many times."""

    def curve(self, trajectory: Trajectory, sampling: Sampling, go_on: Callable[[], None]) -> ProgressResult:
        """Return each frame's scores, as if it were the newest. Raises RewardError.

        sampling: the frames to show then
        go_on: to be called now and then; may raise to end the episode
        """


class ClientScorer:
    """A scorer that asks a client's servers. Leaves the client open."""

    def __init__(self, client: RewardClient) -> None:
        self._client = client

    def checkpoint(self) -> CheckpointFacts:
        """Ask the servers for the facts. Raises RewardError, also if the servers have different checkpoints."""
        infos = self._client.model_infos()
        digests: list[object] = [_digests(reported) for reported in infos.values()]
        info = infos["frames"][0] if "frames" in infos else self._client.model_info(frames=True)
        # Labels with and without a newer score's column cannot be joined. The first such score was a mark.
        digests += [f"marks_{name}" for name in info.scores if FRAME_SCORES[name].is_newer]
        if info.weights_digest is None:
            raise InvalidSampleError.at(
                f"model {info.name}", "a weights_digest, as exports have since version 0.1.0", "none: export it again"
            )
        embedded = infos["embeddings"][0] if "embeddings" in infos else None
        network = info.network if embedded is None else embedded.network
        return CheckpointFacts.of(
            info,
            settings_digest=digest_of(str(each).encode() for each in digests),
            encodes=embedded is not None,
            is_causal=network.get("config", {}).get("causal_mask") is True,
        )

    def encode(self, frames: UInt8Array, task: str) -> Trajectory:
        """Return embeddings for frames, uint8 [T, H, W, 3], and task. Raises RewardError."""
        return self._client.encode(Trajectory(frames=frames, task=task))

    def evaluate(self, samples: Sequence[ProgressSample]) -> list[ProgressResult]:
        """Return one result per sample. Raises RewardError for the first failure."""
        return cast("list[ProgressResult]", self._client.evaluate(samples))

    def curve(self, trajectory: Trajectory, sampling: Sampling, go_on: Callable[[], None]) -> ProgressResult:
        """Return each frame's scores, as if it were the newest. Raises RewardError."""
        return self._client.curve(trajectory, sampling, go_on=go_on)


def _digests(infos: Sequence[ModelInfo]) -> tuple[str, str | None, str | None]:
    """Return a model's name and digests. Raises InvalidSampleError if servers differ in DECISIVE fields."""
    digests = {(info.name, *(getattr(info, name) for name in DECISIVE)) for info in infos}
    if len(digests) > 1:
        got = " and ".join(sorted(", ".join(map(str, values)) for _, *values in digests))
        expected = f"the same {', '.join(DECISIVE[:-1])} and {DECISIVE[-1]} at every server"
        raise InvalidSampleError.at(f"model {infos[0].name}", expected, got)
    return digests.pop()[:3]
