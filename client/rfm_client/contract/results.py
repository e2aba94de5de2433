# SPDX-License-Identifier: MIT
"""Results of a reward model. T frames, K progress bins."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from rfm_client.contract.checks import require
from rfm_client.contract.errors import InferenceFailedError
from rfm_client.contract.numbers import checked_count, checked_share
from rfm_client.contract.samples import Float32Array

SUCCESS_THRESHOLD = 0.5
EVEN = 0.5  # preference for neither trajectory


@dataclass(frozen=True)
class BatchTiming:
    """Milliseconds that the server spent on the batch of a sample."""

    collate_ms: float
    forward_ms: float


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameScores:
    """Scores of each frame of one trajectory.

    progress: float32 [T], share of the task done, 0..1
    success: float32 [T], probability that the task is done; NaN throughout: the checkpoint does not predict it
    progress_logits: float32 [T, K], raw scores of the progress bins, on request, from discrete checkpoints only
    log_prob: float32 [T], logarithm of TOPReward's probability that the frames so far complete the task, on request
    unclear: bool [T], True where RoboReward's written answer states no single whole score, so that progress may be
        misread; None: the model writes no answers
    frame_indices: int64 [T], indices of the scored frames in the trajectory; None: all frames
    """

    progress: Float32Array
    success: Float32Array
    progress_logits: Float32Array | None = None
    log_prob: Float32Array | None = None
    unclear: npt.NDArray[np.bool_] | None = None
    frame_indices: npt.NDArray[np.int64] | None = None

    @property
    def last_progress(self) -> float:
        """Progress at the last frame. Raises ValueError if the checkpoint does not predict it."""
        return float(_known("progress", self.progress)[-1])

    @property
    def progress_deltas(self) -> Float32Array:
        """float32 [T], change of progress since the previous scored frame; 0 for the first.

        Raises ValueError if the checkpoint does not predict progress.
        """
        progress = _known("progress", self.progress)
        return np.diff(progress, prepend=progress[:1])

    def succeeded(self, *, last: int = 1, threshold: float = SUCCESS_THRESHOLD) -> bool:
        """True if success reaches ``threshold`` at more than half of the ``last`` frames (all, if there are fewer).

        Raises ValueError if the checkpoint does not predict success, for a ``threshold`` outside 0..1 or ``last`` < 1.
        """
        newest = _known("success", self.success)[-checked_count("last", last) :]
        votes = newest >= checked_share("threshold", threshold)
        return bool(2 * np.count_nonzero(votes) > len(votes))


@dataclass(frozen=True, eq=False, kw_only=True)
class ProgressResult(FrameScores):
    """Answer to a ProgressSample: the scores of its trajectory's frames.

    model_version: version of the checkpoint that answered
    """

    timing: BatchTiming | None = None
    model_version: str | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class PreferenceResult:
    """Answer to a PreferenceSample: the probability that ``first`` is preferred, and each frame's scores.

    preference: if both orders were asked, their mean
    first, second, timing: from the order (first, second)
    both_orders: probability that ``first`` is preferred, from the order (first, second) and from (second, first);
        None: only the order (first, second) was asked
    """

    preference: float
    first: FrameScores
    second: FrameScores
    timing: BatchTiming | None = None
    model_version: str | None = None
    both_orders: tuple[float, float] | None = None

    @classmethod
    def of_both_orders(cls, asked: PreferenceResult, swapped: PreferenceResult) -> PreferenceResult:
        """Return one result from the answers to a sample and to its ``swapped``.

        Raises InferenceFailedError if two versions of the checkpoint answered.
        """
        if asked.model_version != swapped.model_version:
            got = f"{asked.model_version}, {swapped.model_version}"
            raise InferenceFailedError(f"model_version: expected one for both orders, got {got}: ask again")
        both = (asked.preference, 1 - swapped.preference)
        return replace(asked, preference=sum(both) / len(both), both_orders=both)

    @property
    def orders_agree(self) -> bool | None:
        """True if both orders prefer the same trajectory, or both neither (exactly 0.5); None: one order was asked."""
        return None if self.both_orders is None else len(set(map(_preferred, self.both_orders))) == 1

    @property
    def verdict(self) -> Literal["first", "second"] | None:
        """The preferred trajectory; None: the orders disagree, or the preference is exactly 0.5."""
        return None if self.orders_agree is False else _preferred(self.preference)


@dataclass(frozen=True, eq=False, kw_only=True)
class SimilarityResult:
    """Answer to a SimilaritySample: the raw, unbounded similarity score, and each frame's scores."""

    similarity: float
    reference: FrameScores
    other: FrameScores
    timing: BatchTiming | None = None
    model_version: str | None = None


def unclear_answers(unclear: npt.NDArray[Any]) -> str:
    """Return a line about marks of unclear answers, [T]."""
    count = f"{np.count_nonzero(unclear)} of {len(unclear)} frames"
    why = "states no single whole score (as 1.5, 3/5, or two scores)"
    return f"{count}: the model's written answer {why}, so progress may be misread; --strict-answers refuses these"


Result: TypeAlias = ProgressResult | PreferenceResult | SimilarityResult


def _preferred(preference: float) -> Literal["first", "second"] | None:
    if preference > EVEN:
        return "first"
    return "second" if preference < EVEN else None


def _known(name: str, scores: Float32Array) -> Float32Array:
    is_known = not np.isnan(scores).any()
    require(name, is_known, "a score of each frame", "NaN: this checkpoint does not predict it")
    return scores
