# SPDX-License-Identifier: MIT
"""The engine: samples in, results out, in as few forward passes as the token budget allows. No Triton in it."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from rfm import checkpoint as checkpoints
from rfm.collate import RewindCollator, Row
from rfm.config import DEFAULT_TOKEN_BUDGET
from rfm.models.encoders import Encoders
from rfm.models.heads import progress_from_logits
from rfm.models.rewind import RewindBatch, RewindTransformer
from rfm_client import (
    BatchTiming,
    FrameScores,
    InferenceFailedError,
    InvalidSampleError,
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Result,
    RewardError,
    Sample,
    SimilarityResult,
    Trajectory,
)

Outcome: TypeAlias = Result | RewardError


@dataclass(frozen=True, eq=False)
class _RowScores:
    """Scores of one row: of the frames of its trajectories, and of its question about two of them."""

    frames: list[FrameScores]
    query: float | None = None

    def is_finite(self) -> bool:
        arrays = [array for scores in self.frames for array in (scores.progress, scores.success)]
        return all(np.isfinite(array).all() for array in arrays) and (self.query is None or np.isfinite(self.query))


class Engine:
    """Scores samples with one network on one device.

    network: the ReWiND transformer
    encoders: needed only for samples of raw frames
    token_budget: the most tokens, padding included, of one forward pass
    """

    def __init__(
        self,
        network: RewindTransformer,
        *,
        encoders: Encoders | None = None,
        device: str | torch.device = "cpu",
        token_budget: int = DEFAULT_TOKEN_BUDGET,
    ) -> None:
        self.device = torch.device(device)
        self.network = network.to(self.device).eval()
        self.encoders = encoders.to(self.device) if encoders is not None else None
        self.token_budget = token_budget
        self.collator = RewindCollator(network.config)

    @classmethod
    def from_checkpoint(
        cls, source: str | Path, *, device: str | torch.device = "cpu", token_budget: int = DEFAULT_TOKEN_BUDGET
    ) -> Engine:
        """The engine of a checkpoint folder or Hugging Face id, for embeddings. Raises CheckpointError."""
        return cls(checkpoints.load(source).build(), device=device, token_budget=token_budget)

    def evaluate(self, samples: Sequence[Sample]) -> list[Outcome]:
        """The result of each sample, or the error of one that has none; neighbours make no difference.

        InvalidSampleError: this checkpoint cannot score the sample.
        InferenceFailedError: the network gave something that is no number.
        """
        started_s = time.perf_counter()
        outcomes: dict[int, Outcome] = {}
        rows: list[Row] = []
        rows_of: dict[int, slice] = {}
        for index, sample in enumerate(self._embedded(samples)):
            try:
                sample_rows = self._rows(sample)
            except RewardError as error:
                outcomes[index] = error
                continue
            rows_of[index] = slice(len(rows), len(rows) + len(sample_rows))
            rows += sample_rows

        forward_s = 0.0
        scores: dict[int, _RowScores] = {}
        for part in self._micro_batches(rows):
            batch = self.collator.collate([rows[index] for index in part])
            forward_started_s = time.perf_counter()
            scores.update(zip(part, self._score([rows[index] for index in part], batch), strict=True))
            forward_s += time.perf_counter() - forward_started_s

        in_order = [scores[index] for index in range(len(rows))]
        timing = BatchTiming((time.perf_counter() - started_s - forward_s) * 1e3, forward_s * 1e3)
        for index, part_of_rows in rows_of.items():
            outcomes[index] = _outcome(samples[index], in_order[part_of_rows], timing)
        return [outcomes[index] for index in range(len(samples))]

    def _embedded(self, samples: Sequence[Sample]) -> list[Sample | RewardError]:
        """The samples with embeddings in place of raw frames."""
        embedded: list[Sample | RewardError] = list(samples)
        raw = {i: _joined(sample) for i, sample in enumerate(samples) if sample.trajectories[0].frames is not None}
        if raw and self.encoders is None:
            missing = InvalidSampleError.at("frames", "video_embeddings (no encoders are loaded)", "frames")
            return [missing if index in raw else sample for index, sample in enumerate(samples)]
        if raw and self.encoders is not None:
            for index, encoded in zip(raw, self.encoders.encode(list(raw.values())), strict=True):
                if isinstance(encoded, Trajectory):
                    embedded[index] = _with_embeddings(samples[index], encoded)
                else:
                    embedded[index] = encoded
        return embedded

    def _rows(self, sample: Sample | RewardError) -> list[Row]:
        if isinstance(sample, RewardError):
            raise sample
        rows = self.collator.rows(sample)
        longest = max(map(self.collator.num_tokens, rows))
        if longest > self.token_budget:
            expected = f"at most {self.token_budget} tokens (token_budget of this server)"
            raise InvalidSampleError.at("num_frames", expected, f"{longest} tokens")
        return rows

    def _micro_batches(self, rows: Sequence[Row]) -> Iterator[list[int]]:
        """Indices of the rows of each forward: one kind, similar lengths, within the token budget."""

        def lengths(index: int) -> tuple[bool, int, int]:
            return rows[index].second is not None, rows[index].num_first, rows[index].num_second

        for _, kind in groupby(sorted(range(len(rows)), key=lengths), key=lambda index: lengths(index)[0]):
            part: list[int] = []
            padded = (0, 0)
            for index in kind:
                _, *own = lengths(index)
                grown = (max(padded[0], own[0]), max(padded[1], own[1]))
                if part and (len(part) + 1) * self.network.config.num_tokens(*grown) > self.token_budget:
                    yield part
                    part, grown = [], (own[0], own[1])
                part.append(index)
                padded = grown
            yield part

    @torch.inference_mode()
    def _score(self, rows: Sequence[Row], batch: RewindBatch) -> list[_RowScores]:
        output = self.network(batch.to(self.device))
        firsts = _frame_scores(output.first_progress, output.first_success, [row.num_first for row in rows])
        if output.query is None:
            return [_RowScores([first]) for first in firsts]
        seconds = _frame_scores(output.second_progress, output.second_success, [row.num_second for row in rows])
        logits, probabilities = output.query.float().tolist(), output.query.sigmoid().float().tolist()
        queries = [logits[i] if row.is_similarity else probabilities[i] for i, row in enumerate(rows)]
        return [_RowScores([*pair], query) for *pair, query in zip(firsts, seconds, queries, strict=True)]


def _frame_scores(progress_logits: Tensor, success_logits: Tensor, lengths: Sequence[int]) -> list[FrameScores]:
    """Per row its frames' scores without padding, on the CPU; logits [B, T, K] and [B, T]."""
    progress = progress_from_logits(progress_logits).cpu().numpy()
    success = success_logits.sigmoid().float().cpu().numpy()
    discrete = progress_logits.shape[-1] > 1
    logits = progress_logits.float().cpu().numpy() if discrete else None
    return [
        FrameScores(
            progress=progress[row, :length],
            success=success[row, :length],
            progress_logits=None if logits is None else logits[row, :length],
        )
        for row, length in enumerate(lengths)
    ]


def _joined(sample: Sample) -> Trajectory:
    """All frames of a sample and its task, as one trajectory."""
    frames = np.concatenate([trajectory.positions for trajectory in sample.trajectories])
    return Trajectory(frames=frames, task=sample.trajectories[0].task)


def _with_embeddings(sample: Sample, joined: Trajectory) -> Sample:
    bounds = np.cumsum([trajectory.num_frames for trajectory in sample.trajectories])[:-1]
    videos = np.split(joined.positions, bounds)
    parts = [Trajectory(video_embeddings=video, text_embedding=joined.text_embedding) for video in videos]
    if isinstance(sample, ProgressSample):
        return replace(sample, trajectory=parts[0])
    return type(sample)(parts[0], parts[1])


def _outcome(sample: Sample, scores: Sequence[_RowScores], timing: BatchTiming) -> Outcome:
    if not all(row.is_finite() for row in scores):
        return InferenceFailedError("the network gave a score that is not finite")
    if isinstance(sample, ProgressSample):
        frames = _last_of_each(scores) if sample.frame_steps else scores[0].frames[0]
        logits = frames.progress_logits
        return ProgressResult(progress=frames.progress, success=frames.success, progress_logits=logits, timing=timing)
    first, second = scores[0].frames
    query = scores[0].query
    assert query is not None  # every row of two trajectories carries a question
    if isinstance(sample, PreferenceSample):
        return PreferenceResult(preference=query, first=first, second=second, timing=timing)
    return SimilarityResult(similarity=query, reference=first, other=second, timing=timing)


def _last_of_each(rows: Sequence[_RowScores]) -> FrameScores:
    """Dense mode: frame t's score is the last one of the row of its prefix."""
    frames = [row.frames[0] for row in rows]
    logits = [scores.progress_logits[-1] for scores in frames if scores.progress_logits is not None]
    return FrameScores(
        progress=np.stack([scores.progress[-1] for scores in frames]),
        success=np.stack([scores.success[-1] for scores in frames]),
        progress_logits=np.stack(logits) if logits else None,
    )
