# SPDX-License-Identifier: MIT
"""The ReWiND transformer as a predictor: samples of embeddings in, scores of rows out."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from rfm.execution import Execution
from rfm.predictor import RowScores, are_finite, checked, frame_scores, part_of
from rfm.rewind.collator import RewindCollator, Row
from rfm.rewind.network import RewindBatch, RewindTransformer
from rfm_client.contract import InvalidSampleError, RewardError, Sample
from rfm_client.contract.named_frames import NamedProgressSample


class RewindPredictor:
    """A ReWiND network on a device.

    dtype: of the network. Others than float32 move scores by more than 1e-5
    """

    works_ahead = False

    def __init__(self, network: RewindTransformer, device: torch.device, dtype: torch.dtype = torch.float32) -> None:
        self.network = network.to(device, dtype).eval()
        self.device = device
        self.dtype = dtype
        self.collator = RewindCollator(network.config)

    def rows(self, sample: Sample | NamedProgressSample) -> list[Row]:
        """The rows of a sample of embeddings. Raises InvalidSampleError."""
        if isinstance(sample, NamedProgressSample):
            raise InvalidSampleError.at("frames", "video_embeddings (this checkpoint reads embeddings)", "named frames")
        return self.collator.rows(sample)

    def num_tokens(self, row: Row) -> int:
        """Number of tokens that the row takes in the transformer."""
        return self.network.config.num_tokens(row.num_first, row.num_second)

    def work_ahead(self, rows: Sequence[Row]) -> None:
        """Nothing: collation is cheap."""

    def collate(self, rows: Sequence[Row]) -> RewindBatch:
        """One batch of rows, which may be of different kinds."""
        return self.collator.collate(rows)

    def count(self, batch: RewindBatch, execution: Execution) -> None:
        """Counts tokens, and slots that the network computes, the last few of which hold no token."""
        execution.add_tokens(batch.packing.num_tokens, len(batch.packing.at))

    @torch.inference_mode()
    def score(self, rows: Sequence[Row], batch: RewindBatch) -> list[RowScores | RewardError]:
        """The scores of each row of the batch, or why it has none, from one forward pass."""
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
        has_success = output.success is not None
        if are_finite([frames], logits, has_success=has_success):  # of all rows at once, which is faster
            return list(scored)
        return checked(scored, has_success=has_success)
