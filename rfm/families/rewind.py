# SPDX-License-Identifier: MIT
"""ReWiND: embeddings, or raw frames through the encoders, into the ReWiND transformer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from rfm.collate.rewind import RewindCollator, Row
from rfm.family import RowScores, checked, frame_scores, part_of
from rfm.models.encoders import Encoders
from rfm.models.rewind import RewindBatch, RewindTransformer
from rfm_client import InvalidSampleError, ProgressSample, RewardError, Sample, Trajectory


class RewindFamily:
    """A ReWiND network on a device; encoders are needed only for samples of raw frames."""

    def __init__(self, network: RewindTransformer, *, encoders: Encoders | None, device: torch.device) -> None:
        self.network = network.to(device).eval()
        self.encoders = encoders.to(device) if encoders is not None else None
        self.device = device
        self.collator = RewindCollator(network.config)

    def rows(self, samples: Sequence[Sample]) -> list[list[Row] | RewardError]:
        """Each sample's rows, or its error; the frames of all samples are encoded together."""
        outcomes: list[list[Row] | RewardError] = []
        for sample in self._embedded(samples):
            try:
                outcomes.append(sample if isinstance(sample, RewardError) else self.collator.rows(sample))
            except InvalidSampleError as error:
                outcomes.append(error)
        return outcomes

    def lengths(self, row: Row) -> tuple[int, ...]:
        """Frames of each trajectory."""
        return (row.num_first,) if row.second is None else (row.num_first, row.num_second)

    def num_tokens(self, lengths: Sequence[int]) -> int:
        """Tokens of a row of these trajectories."""
        return self.network.config.num_tokens(lengths[0], lengths[1] if len(lengths) > 1 else 0)

    def collate(self, rows: Sequence[Row]) -> RewindBatch:
        """Rows that all have, or all lack, a second trajectory."""
        return self.collator.collate(rows)

    @torch.inference_mode()
    def score(self, rows: Sequence[Row], batch: RewindBatch) -> list[RowScores | RewardError]:
        """One forward pass."""
        output = self.network(batch.to(self.device))
        first = frame_scores(output.first_progress, output.first_success)
        firsts = [part_of(first, (index, slice(row.num_first))) for index, row in enumerate(rows)]
        if output.query is None:
            return checked([RowScores([scores]) for scores in firsts], RowScores([first]))
        second = frame_scores(output.second_progress, output.second_success)
        seconds = [part_of(second, (index, slice(row.num_second))) for index, row in enumerate(rows)]
        logits, probabilities = output.query.float().tolist(), output.query.sigmoid().float().tolist()
        queries = [logits[i] if row.is_similarity else probabilities[i] for i, row in enumerate(rows)]
        scored = [RowScores([*pair], query) for *pair, query in zip(firsts, seconds, queries, strict=True)]
        return checked(scored, RowScores([first, second], sum(logits)))

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
