# SPDX-License-Identifier: MIT
"""ReWiND's predictor for embedding samples, and its checkpoints in memory.

Samples become rows, rows packed batches, batches scores. A row is a token sequence in a forward pass. A sample has one
row, or one per frame in dense mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from rfm.engine.execution import Execution
from rfm.engine.family import NETWORK, config_fields
from rfm.engine.feature_cache import FeatureCache
from rfm.engine.layers import as_tensor, pack
from rfm.engine.predictor import Predictor, RowScores, check_type, frame_scores, prefix_indices
from rfm.families.rewind.network import RewindBatch, RewindConfig, RewindTransformer, rounded_up
from rfm.files import NETWORK_CONFIG, WEIGHTS, expecting, read_json, read_tensors
from rfm.saved import write_network
from rfm.weights import check_shapes
from rfm_client.contract import (
    InvalidSampleError,
    ProgressSample,
    RewardError,
    Sample,
    SimilaritySample,
    Trajectory,
)
from rfm_client.contract.description import Description
from rfm_client.contract.samples import Float32Array

MAX_EMBEDDING = 1e6  # thousands of times an encoder's values


@dataclass(frozen=True, eq=False)
class RewindRow:
    """A token sequence: text [Dt], first [T, Dv] and, for preference or similarity, second [T, Dv].

    picked: in dense mode int64 [frame_steps], the frames of ``first`` in the row; None: all
    """

    text: Float32Array
    first: Float32Array
    second: Float32Array | None = None
    is_similarity: bool = False
    picked: npt.NDArray[np.int64] | None = None

    @property
    def num_first(self) -> int:
        """How many frames the first trajectory has in the row."""
        return len(self.first if self.picked is None else self.picked)

    @property
    def num_second(self) -> int:
        """How many frames the second trajectory has in the row, or 0."""
        return 0 if self.second is None else len(self.second)

    @property
    def videos(self) -> tuple[Float32Array, ...]:
        """The embeddings by trajectory: first and, if it exists, second."""
        return (self.first,) if self.second is None else (self.first, self.second)

    def shown(self, video: Float32Array) -> npt.NDArray[np.int64]:
        """Return which frames of ``video``, one of ``videos``, the row shows, int64 [T]."""
        return np.arange(len(video)) if self.picked is None else self.picked


@dataclass(frozen=True)
class RewindCollator:
    """Turns samples into rows, and rows into batches, for a ReWiND configuration."""

    config: RewindConfig

    def rows(self, sample: Sample) -> list[RewindRow]:
        """Return a sample's rows. Raises InvalidSampleError if the checkpoint cannot score the sample."""
        check_type(sample, self.config)
        frame_steps = sample.frame_steps if isinstance(sample, ProgressSample) else 0
        if sample.trajectories[0].video_embeddings is None:
            remedy = "name the encoders with --image-encoder and --text-encoder"
            raise InvalidSampleError.at("frames", "video_embeddings (no encoders are loaded)", f"frames: {remedy}")
        text = self._text(sample.trajectories[0])
        videos = [self._video(trajectory, frame_steps) for trajectory in sample.trajectories]
        if frame_steps:
            return [RewindRow(text, videos[0], picked=picked) for picked in prefix_indices(len(videos[0]), frame_steps)]
        if len(videos) == 1:
            return [RewindRow(text, videos[0])]
        return [RewindRow(text, videos[0], videos[1], isinstance(sample, SimilaritySample))]

    def collate(self, rows: Sequence[RewindRow]) -> RewindBatch:
        """Return one batch with rows of any kind. The batch holds a frame once, even if several rows show it."""
        videos: dict[int, Float32Array] = {}
        starts: dict[int, int] = {}
        num_frames = 0
        for row in rows:
            for video in row.videos:
                if id(video) not in videos:
                    videos[id(video)], starts[id(video)] = video, num_frames
                    num_frames += len(video)
        frames = np.zeros((rounded_up(num_frames), self.config.video_feature_dim), np.float32)
        np.concatenate(list(videos.values()), out=frames[:num_frames])
        lengths = np.array([(row.num_first, row.num_second) for row in rows], np.int64)
        shown = None
        if lengths.sum() != num_frames or any(row.picked is not None for row in rows):
            of_rows = [starts[id(video)] + row.shown(video) for row in rows for video in row.videos]
            shown = as_tensor(np.concatenate(of_rows))
        questions = [row.is_similarity for row in rows if row.second is not None]
        return RewindBatch.of(
            self.config,
            as_tensor(np.stack([row.text for row in rows])),
            as_tensor(frames),
            lengths,
            shown=shown,
            is_similarity=torch.tensor(questions) if any(questions) else None,
        )

    def _text(self, trajectory: Trajectory) -> Float32Array:
        width = self.config.text_feature_dim
        text = trajectory.text_embedding
        if text is None or text.shape != (width,):
            got = "None" if text is None else str(list(text.shape))
            raise InvalidSampleError.at("text_embedding", f"float32 [{width}]", got)
        _check_range("text_embedding", text)
        return text

    def _video(self, trajectory: Trajectory, frame_steps: int) -> Float32Array:
        width, limit = self.config.video_feature_dim, self.config.max_frames
        video = trajectory.video_embeddings
        if video is None or video.shape[1] != width:
            got = "frames" if video is None else str(list(video.shape))
            raise InvalidSampleError.at("video_embeddings", f"float32 [T, {width}]", got)
        if limit is not None and (frame_steps or len(video)) > limit:
            where, count = ("frame_steps", frame_steps) if frame_steps else ("num_frames", len(video))
            expected = f"at most {limit} (max_len of this checkpoint, which has per-frame progress tokens)"
            raise InvalidSampleError.at(where, expected, str(count))
        _check_range("video_embeddings", video)
        return video


def _check_range(where: str, embeddings: Float32Array) -> None:
    """Raise InvalidSampleError for values so large that the network would overflow."""
    largest = max(float(embeddings.max()), -float(embeddings.min()))
    if largest > MAX_EMBEDDING:
        raise InvalidSampleError.at(where, f"values from {-MAX_EMBEDDING:g} to {MAX_EMBEDDING:g}", f"{largest:g}")


class RewindPredictor(Predictor[RewindRow, RewindBatch]):
    """A ReWiND network on a device.

    dtype: of the network; any but float32 changes scores by more than 1e-5
    """

    def __init__(self, network: RewindTransformer, device: torch.device, dtype: torch.dtype = torch.float32) -> None:
        self.network = network.to(device, dtype).eval()
        pack(self.network)
        self.device = device
        self.dtype = dtype
        self.collator = RewindCollator(network.config)

    @property
    def has_success(self) -> bool:
        """True if the network predicts success."""
        return self.network.config.has_success

    def rows(self, sample: Sample) -> list[RewindRow]:
        """Return the rows for an embedding sample. Raises InvalidSampleError."""
        return self.collator.rows(sample)

    def num_tokens(self, row: RewindRow) -> int:
        """Return how many tokens the row has."""
        return self.network.config.num_tokens(row.num_first, row.num_second)

    def collate(self, rows: Sequence[RewindRow]) -> RewindBatch:
        """Return one batch with rows of any kind."""
        return self.collator.collate(rows)

    def count(self, batch: RewindBatch, execution: Execution) -> None:
        """Count the batch's tokens, without and with the padding behind the last."""
        execution.add_tokens(batch.packing.num_tokens, len(batch.packing.at))

    @torch.inference_mode()
    def score(
        self, rows: Sequence[RewindRow], batch: RewindBatch, execution: Execution
    ) -> list[RowScores | RewardError]:
        """Run one forward pass; return each row's scores or error."""
        output = self.network(batch.to(self.device, self.dtype))
        frames = frame_scores(output.progress, output.success)
        logits, probabilities = output.query.float().tolist(), output.query.sigmoid().float().tolist()
        questions = iter(zip(logits, probabilities, strict=True))
        scored: list[RowScores] = []
        start = 0
        for row in rows:
            middle, end = start + row.num_first, start + row.num_first + row.num_second
            of_trajectories = [frames.at(slice(start, middle))]
            query = None
            if row.second is not None:
                of_trajectories.append(frames.at(slice(middle, end)))
                query = next(questions)[0 if row.is_similarity else 1]
            scored.append(RowScores(of_trajectories, query))
            start = end
        return list(scored)


MODEL_TYPE = "rewind_transformer"


@dataclass(frozen=True)
class RewindCheckpoint:
    """A ReWiND checkpoint in memory.

    network: weights for RewindTransformer
    image_encoder, text_encoder: encoder weights without their prefix; empty if the checkpoint has none
    """

    config: RewindConfig
    network: dict[str, Tensor]
    image_encoder: dict[str, Tensor] = field(default_factory=dict)
    text_encoder: dict[str, Tensor] = field(default_factory=dict)

    @property
    def description(self) -> Description:
        """The checkpoint's inputs and outputs."""
        return Description(
            kind="ReWiND",
            network={"class": RewindTransformer.__name__},
            video_dim=self.config.video_feature_dim,
            text_dim=self.config.text_feature_dim,
            progress_bins=self.config.progress_bins if self.config.progress_bins > 1 else None,
            trained_frames=self.config.trained_frames,
            trained_padding=self.config.trained_padding is not False,
            network_frames=self.config.max_frames,
            has_preference=self.config.has_preference,
            has_success=self.config.has_success,
            has_similarity=self.config.has_similarity,
        )

    @property
    def parts(self) -> dict[str, dict[str, Tensor]]:
        """All weights by part and name."""
        return {NETWORK: self.network, "image_encoder": self.image_encoder, "text_encoder": self.text_encoder}

    def flop(self, sample: Sample) -> float:
        """Return how many operations a sample's products take: two per parameter and token."""
        counts = [trajectory.num_frames for trajectory in sample.trajectories]
        num_tokens = self.config.num_tokens(counts[0], sum(counts[1:]))
        return 2.0 * num_tokens * sum(tensor.numel() for tensor in self.network.values())

    def predictor(
        self, device: torch.device, dtype: torch.dtype | None = None, cache: FeatureCache[Any] | None = None
    ) -> RewindPredictor:
        """Return a predictor on ``device``, in ``dtype`` (None: float32). Raises CheckpointError.

        cache: not used, since the network reads embeddings
        """
        return RewindPredictor(self.build(), device, dtype or torch.float32)

    def save(self, folder: Path) -> None:
        """Write network and configuration for ``load``, without encoders."""
        write_network(folder, {"model_type": MODEL_TYPE, **config_fields(self.config)}, self.network)

    def build(self) -> RewindTransformer:
        """Return the network with these weights, on the CPU, ready to score. Raises CheckpointError."""
        self.check()
        network = RewindTransformer(self.config)
        network.load_state_dict(self.network, strict=True)
        return network.eval().requires_grad_(False)

    def check(self) -> None:
        """Raise CheckpointError unless the weights fit the network, before memory is allocated for it."""
        check_shapes(self.skeleton().state_dict(), self.network)

    def skeleton(self) -> RewindTransformer:
        """Return the network without weights."""
        with torch.device("meta"):
            return RewindTransformer(self.config)


def restore(folder: Path) -> RewindCheckpoint:
    """Load what ``RewindCheckpoint.save`` wrote. Raises CheckpointError."""
    file = folder / NETWORK_CONFIG
    with expecting("the settings of an exported ReWiND network", file):
        settings = {name: value for name, value in read_json(file).items() if name != "model_type"}
        config = RewindConfig(**settings)
    checkpoint = RewindCheckpoint(config, read_tensors(folder / WEIGHTS))
    checkpoint.check()
    return checkpoint
