# SPDX-License-Identifier: MIT
"""ReWiND: embeddings, or raw frames through the encoders, into the ReWiND transformer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from rfm.execution import Execution
from rfm.family import FrameEncoders
from rfm.predictor import RowScores, are_finite, checked, frame_scores, part_of
from rfm.rewind.collator import RewindCollator, Row
from rfm.rewind.network import RewindBatch, RewindTransformer
from rfm_client.contract import InvalidSampleError, ProgressSample, RewardError, Sample, Trajectory
from rfm_client.contract.samples import Footage


class RewindPredictor:
    """A ReWiND network on a device; encoders are needed only for samples of raw frames.

    dtype: of the network; its encoders keep theirs. Others than float32 move scores by more than 1e-5
    """

    def __init__(
        self,
        network: RewindTransformer,
        *,
        encoders: FrameEncoders | None,
        device: torch.device,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.network = network.to(device, dtype).eval()
        self.encoders = encoders.to(device) if encoders is not None else None
        self.device = device
        self.dtype = dtype
        self.collator = RewindCollator(network.config)

    def rows(self, samples: Sequence[Sample], execution: Execution) -> list[list[Row] | RewardError]:
        """Each sample's rows, or its error; the frames of all samples are encoded together."""
        outcomes: list[list[Row] | RewardError] = []
        for sample in self._embedded(samples, execution):
            try:
                outcomes.append(sample if isinstance(sample, RewardError) else self.collator.rows(sample))
            except InvalidSampleError as error:
                outcomes.append(error)
        return outcomes

    def num_tokens(self, row: Row) -> int:
        """Tokens of the row."""
        return self.network.config.num_tokens(row.num_first, row.num_second)

    def collate(self, rows: Sequence[Row]) -> RewindBatch:
        """Rows of any kinds."""
        return self.collator.collate(rows)

    def occupancy(self, batch: RewindBatch) -> tuple[int, int]:
        """Of packed tokens, which everything but attention is computed of; a few behind the last mean nothing."""
        return batch.packing.num_tokens, len(batch.packing.at)

    @torch.inference_mode()
    def score(self, rows: Sequence[Row], batch: RewindBatch) -> list[RowScores | RewardError]:
        """One forward pass."""
        output = self.network(batch.to(self.device, self.dtype))
        frames = frame_scores(output.progress, output.success)
        logits, probabilities = output.query.float().tolist(), output.query.sigmoid().float().tolist()
        questions = iter(zip(logits, probabilities, strict=True))
        scored: list[RowScores] = []
        start = 0
        for row in rows:
            middle, end = start + row.num_first, start + row.num_first + row.num_second
            of_trajectories = [part_of(frames, slice(start, middle))]
            query = None
            if row.second is not None:
                of_trajectories.append(part_of(frames, slice(middle, end)))
                query = next(questions)[0 if row.is_similarity else 1]
            scored.append(RowScores(of_trajectories, query))
            start = end
        if are_finite([frames], logits):  # of all rows at once, which is faster
            return list(scored)
        return checked(scored)

    def _embedded(self, samples: Sequence[Sample], execution: Execution) -> list[Sample | RewardError]:
        """The samples with embeddings in place of raw frames."""
        embedded: list[Sample | RewardError] = list(samples)
        of_frames = {i: s for i, s in enumerate(samples) if s.trajectories[0].frames is not None}
        raw = {index: Footage(sample.trajectories) for index, sample in of_frames.items()}
        if raw and self.encoders is None:
            missing = InvalidSampleError.at("frames", "video_embeddings (no encoders are loaded)", "frames")
            return [missing if index in raw else sample for index, sample in enumerate(samples)]
        if raw and self.encoders is not None:
            for index, encoded in zip(raw, self.encoders.encode(list(raw.values()), execution), strict=True):
                if isinstance(encoded, Trajectory):
                    embedded[index] = _with_embeddings(samples[index], encoded)
                else:
                    embedded[index] = encoded
        return embedded


def _with_embeddings(sample: Sample, encoded: Trajectory) -> Sample:
    bounds = np.cumsum([trajectory.num_frames for trajectory in sample.trajectories])[:-1]
    videos = np.split(encoded.positions, bounds)
    parts = [Trajectory(video_embeddings=video, text_embedding=encoded.text_embedding) for video in videos]
    if isinstance(sample, ProgressSample):
        return replace(sample, trajectory=parts[0])
    return type(sample)(parts[0], parts[1])
