# SPDX-License-Identifier: MIT
"""The interface between the engine and a network: samples become rows, rows a batch, a batch scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt
from torch import Tensor

from rfm.engine.execution import Execution
from rfm.engine.layers import progress_from_logits
from rfm_client.contract import (
    FrameScores,
    InvalidSampleError,
    PreferenceSample,
    RewardError,
    Sample,
    SimilaritySample,
)
from rfm_client.contract.samples import Float32Array

Row = TypeVar("Row")
Batch = TypeVar("Batch")


class Predictor(Protocol[Row, Batch]):
    """A network on a device, with batch collation. A subclass gets what most families have in common.

    A row is one token sequence, or several that begin alike.

    has_progress: False if the network does not predict progress, which is then NaN
    reads_views: True if the network reads a goal and views from further cameras
    works_ahead: True if ``work_ahead`` takes enough time to be worth a thread
    """

    has_progress: bool = True
    reads_views: bool = False
    works_ahead: bool = False

    @property
    def has_success(self) -> bool:
        """False if the network does not predict success, which is then NaN."""

    def rows(self, sample: Sample) -> list[Row]:
        """Return the sample's rows, without a forward pass: one, or one per prefix to score.

        Raises InvalidSampleError if this checkpoint cannot score the sample.
        """

    def num_tokens(self, row: Row) -> int:
        """Return how many tokens are computed. Rows with similar counts share a batch."""

    def sequences(self, row: Row) -> Sequence[Row]:
        """Return the row's token sequences, each as a row. Most rows have one."""
        return (row,)

    def work_ahead(self, rows: Sequence[Row]) -> None:
        """Do the slow, independent work on these rows, if any; thread-safe. ``collate`` does the rest."""
        return

    def collate(self, rows: Sequence[Row]) -> Batch:
        """Return one batch; may run while the device computes."""

    def count(self, batch: Batch, execution: Execution) -> None:
        """Add the batch's tokens, with and without padding, and its encoded frames to ``execution``."""

    def score(self, rows: Sequence[Row], batch: Batch, execution: Execution) -> list[RowScores | RewardError]:
        """Run one forward pass; return the scores of each row on the CPU, or its error.

        execution: with several passes, call ``on_forward`` after each
        """

    def joined(self, sample: Sample, rows: Sequence[RowScores]) -> FrameScores:
        """Return frame scores for a progress sample: the only row's; in dense mode, each prefix's last frame."""
        return of_prefixes(rows) if getattr(sample, "frame_steps", 0) else rows[0].frames[0]


@dataclass(frozen=True, eq=False)
class RowScores:
    """Scores for one row.

    frames: scores for each trajectory
    query: the preference or similarity between two trajectories; None: the row asks for neither
    is_of_prefixes: the row has several prefixes (dense mode), with one value for each prefix's last frame
    """

    frames: list[FrameScores]
    query: float | None = None
    is_of_prefixes: bool = False


def check_type(sample: Sample, config: Any) -> None:
    """Raise InvalidSampleError for a preference or similarity sample if the network lacks that head.

    config: the network's configuration
    """
    heads = {"preference": config.has_preference, "similarity": config.has_similarity}
    kinds: dict[type, str] = {PreferenceSample: "preference", SimilaritySample: "similarity"}
    asked = kinds.get(type(sample))
    if asked is not None and not heads[asked]:
        supported = " or ".join(["progress", *(name for name, is_there in heads.items() if is_there)])
        raise InvalidSampleError.at("sample_type", f"{supported} (this checkpoint has no {asked} head)", asked)


def no_success(progress: Float32Array) -> Float32Array:
    """Return NaN in the shape of ``progress``: success without a success head."""
    return np.full_like(progress, np.nan)


def frame_scores(progress_logits: Tensor, success_logits: Tensor | None) -> FrameScores:
    """Return scores on the CPU from progress logits [..., C] and success logits [...]; logits included if C > 1."""
    discrete = progress_logits.shape[-1] > 1
    progress = progress_from_logits(progress_logits).cpu().numpy()
    return FrameScores(
        progress=progress,
        success=no_success(progress) if success_logits is None else success_logits.sigmoid().float().cpu().numpy(),
        progress_logits=progress_logits.float().cpu().numpy() if discrete else None,
    )


def of_prefixes(rows: Sequence[RowScores]) -> FrameScores:
    """Return scores for the last frame in each prefix."""
    newest = slice(-1, None)
    return FrameScores.joined([row.frames[0] if row.is_of_prefixes else row.frames[0].at(newest) for row in rows])


def prefix_indices(num_frames: int, frame_steps: int) -> npt.NDArray[np.int64]:
    """Return the frames that represent each prefix 0..t in dense mode, int64 [T, frame_steps].

    The positions are evenly spaced from 0 to t and truncated to whole frames, as upstream's server samples them.
    """
    return np.stack([np.linspace(0, t, frame_steps).astype(np.int64) for t in range(num_frames)])
