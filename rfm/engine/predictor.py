# SPDX-License-Identifier: MIT
"""What the engine needs of a network: how samples become its batches, and batches scores."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt
from torch import Tensor

from rfm.engine.execution import Execution
from rfm.engine.layers import progress_from_logits
from rfm_client.contract import (
    FrameScores,
    InferenceFailedError,
    InvalidSampleError,
    PreferenceSample,
    RewardError,
    Sample,
    SimilaritySample,
)
from rfm_client.contract.frame_refs import ProgressSampleRefs
from rfm_client.contract.samples import Float32Array

Row = TypeVar("Row")
Batch = TypeVar("Batch")


class Predictor(Protocol[Row, Batch]):
    """A network on a device, and how samples become its batches. A row is one token sequence of a forward."""

    @property
    def works_ahead(self) -> bool:
        """Whether ``work_ahead`` is worth a thread."""

    def rows(self, sample: Sample | ProgressSampleRefs) -> list[Row]:
        """The sample's rows, in dense mode one a frame; takes no forward pass.

        sample: has named frames only where the checkpoint's description says that it keeps features
        Raises InvalidSampleError if this checkpoint cannot score it.
        """

    def num_tokens(self, row: Row) -> int:
        """Tokens of the row. Rows of similar numbers share a batch."""

    def work_ahead(self, rows: Sequence[Row]) -> None:
        """What takes long of collation and can be done rows alone, in any thread; ``collate`` does what is left."""

    def collate(self, rows: Sequence[Row]) -> Batch:
        """One batch, on the CPU; may run while the device computes."""

    def count(self, batch: Batch, execution: Execution) -> None:
        """Adds what the batch's forward pass works on: tokens, with and without padding, and frames that it encodes."""

    def score(self, rows: Sequence[Row], batch: Batch) -> list[RowScores | RewardError]:
        """One forward pass, read back to the CPU; an error for a row that has no scores."""


@dataclass(frozen=True, eq=False)
class RowScores:
    """Scores of one row: of the frames of its trajectories, and of its question about two of them."""

    frames: list[FrameScores]
    query: float | None = None


def are_finite(frames: Iterable[FrameScores], queries: Iterable[float], *, has_success: bool = True) -> bool:
    """Whether all scores of frames and all answers to questions are numbers.

    has_success: the network predicts success
    """
    names = ("progress", "success") if has_success else ("progress",)
    arrays = (getattr(scores, name) for scores in frames for name in names)
    return all(np.isfinite(array).all() for array in arrays) and bool(np.isfinite(list(queries)).all())


def checked(rows: Iterable[RowScores], *, has_success: bool = True) -> list[RowScores | RewardError]:
    """The rows, with an error in place of one that has a score that is not finite."""
    failed = InferenceFailedError("the network gave a score that is not finite")

    def is_good(row: RowScores) -> bool:
        return are_finite(row.frames, [] if row.query is None else [row.query], has_success=has_success)

    return [row if is_good(row) else failed for row in rows]


def check_type(sample: Sample | ProgressSampleRefs, config: Any) -> None:
    """Raises InvalidSampleError for a question about two trajectories that the network has no head for.

    config: its configuration
    """
    heads = {"preference": config.has_preference, "similarity": config.has_similarity}
    asked = {PreferenceSample: "preference", SimilaritySample: "similarity"}.get(type(sample))
    if asked is not None and not heads[asked]:
        supported = " or ".join(["progress", *(name for name, is_there in heads.items() if is_there)])
        raise InvalidSampleError.at("sample_type", f"{supported} (this checkpoint has no {asked} head)", asked)


def no_success(progress: Float32Array) -> Float32Array:
    """What stands for success beside this progress, where the network does not predict it: NaN."""
    return np.full_like(progress, np.nan)


def frame_scores(progress_logits: Tensor, success_logits: Tensor | None) -> FrameScores:
    """Scores on the CPU, from progress logits [..., K] and success logits [...]; with the logits where K > 1."""
    discrete = progress_logits.shape[-1] > 1
    progress = progress_from_logits(progress_logits).cpu().numpy()
    return FrameScores(
        progress=progress,
        success=no_success(progress) if success_logits is None else success_logits.sigmoid().float().cpu().numpy(),
        progress_logits=progress_logits.float().cpu().numpy() if discrete else None,
    )


def part_of(scores: FrameScores, index: slice | npt.NDArray[np.intp]) -> FrameScores:
    """The scores at ``index`` of each array."""
    logits = scores.progress_logits
    return FrameScores(
        progress=scores.progress[index],
        success=scores.success[index],
        progress_logits=None if logits is None else logits[index],
    )


def prefix_indices(num_frames: int, frame_steps: int) -> npt.NDArray[np.int64]:
    """int64 [T, K], the frames that stand for each prefix 0..t.

    K positions evenly from 0 to t, truncated to whole frames, as the original server samples them.
    """
    return np.stack([np.linspace(0, t, frame_steps).astype(np.int64) for t in range(num_frames)])
