# SPDX-License-Identifier: MIT
"""What the engine needs of a kind of checkpoint. One module in ``rfm.families`` for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from torch import Tensor

from rfm.execution import Execution
from rfm.layers.heads import progress_from_logits
from rfm_client.contract import FrameScores, InferenceFailedError, RewardError, Sample

Row = TypeVar("Row")
Batch = TypeVar("Batch")


@dataclass(frozen=True, eq=False)
class RowScores:
    """Scores of one row: of the frames of its trajectories, and of its question about two of them."""

    frames: list[FrameScores]
    query: float | None = None


def has_numbers(row: RowScores) -> bool:
    """Whether the network gave a number for every score."""
    arrays = [array for scores in row.frames for array in (scores.progress, scores.success)]
    return all(np.isfinite(array).all() for array in arrays) and (row.query is None or bool(np.isfinite(row.query)))


def checked(rows: Sequence[RowScores], batch: RowScores | None = None) -> list[RowScores | RewardError]:
    """The rows, with an error in place of one that has a score that is no number.

    batch: all scores that the rows are parts of, padding included; if it has numbers alone, so has every row
    """
    if batch is not None and has_numbers(batch):
        return list(rows)
    failed = InferenceFailedError("the network gave a score that is not finite")
    return [row if has_numbers(row) else failed for row in rows]


class Family(Protocol[Row, Batch]):
    """A network on a device, and how samples become its batches. A row is one token sequence of a forward."""

    def rows(self, samples: Sequence[Sample], execution: Execution) -> list[list[Row] | RewardError]:
        """Each sample's rows (in dense mode one a frame), or why this checkpoint cannot score it.

        execution: what forward passes for it took is added to it
        """

    def lengths(self, row: Row) -> tuple[int, ...]:
        """What decides which rows share a batch: similar lengths do. Rows of unlike counts share none."""

    def num_tokens(self, lengths: Sequence[int]) -> int:
        """Tokens of a row of these lengths."""

    def collate(self, rows: Sequence[Row]) -> Batch:
        """One batch, on the CPU; may run while the device computes."""

    def occupancy(self, batch: Batch) -> tuple[int, int]:
        """Tokens of the batch's rows, and of its forward pass, padding included."""

    def score(self, rows: Sequence[Row], batch: Batch) -> list[RowScores | RewardError]:
        """One forward pass, read back to the CPU; an error for a row that has no scores."""


def frame_scores(progress_logits: Tensor, success_logits: Tensor) -> FrameScores:
    """On the CPU, from logits [..., K] and [...]: progress and success, and of discrete progress its logits."""
    discrete = progress_logits.shape[-1] > 1
    return FrameScores(
        progress=progress_from_logits(progress_logits).cpu().numpy(),
        success=success_logits.sigmoid().float().cpu().numpy(),
        progress_logits=progress_logits.float().cpu().numpy() if discrete else None,
    )


def part_of(scores: FrameScores, index: object) -> FrameScores:
    """The scores at ``index`` of each array."""
    logits = scores.progress_logits
    return FrameScores(
        progress=scores.progress[index],  # type: ignore[call-overload]
        success=scores.success[index],  # type: ignore[call-overload]
        progress_logits=None if logits is None else logits[index],  # type: ignore[call-overload]
    )
