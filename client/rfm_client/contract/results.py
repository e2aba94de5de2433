# SPDX-License-Identifier: MIT
"""Results from a reward model. T frames, K progress bins."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, get_args, get_type_hints

import numpy as np
import numpy.typing as npt

from rfm_client.contract.checks import checked_count, checked_share, require
from rfm_client.contract.errors import InferenceFailedError
from rfm_client.contract.samples import Float32Array

if TYPE_CHECKING:
    from typing_extensions import Self

SUCCESS_THRESHOLD = 0.5
PAIR_SCORES = ("preference", "similarity")  # for two trajectories
EVEN = 0.5  # prefers neither trajectory
ProgressRule: TypeAlias = Literal["remaining_over_first"]


@dataclass(frozen=True)
class BatchTiming:
    """Milliseconds that the server spent on the sample's batch."""

    collate_ms: float
    forward_ms: float


@dataclass(frozen=True)
class Score:
    """One ``FrameScores`` array: how it travels, and how files and labels show it.

    Output tensor, JSON key and label column share the field's name. The tensor is FP32.

    meaning: a phrase for label files
    is_always_asked: True: a client requests it from every model; False: whenever the model gives it, and scores per bin
        with the option ``logits``
    may_be_unknown: NaN at all frames if the checkpoint does not predict it
    replaced_by: score that some models predict instead; this one is then NaN at all frames; empty: none
    is_per_bin: [T, K], and neither in JSON nor in labels; else [T]
    mark: what True says about a frame, as a clause; empty: numbers, not marks
    bounds: smallest and largest value; None: no bound
    unit: of the values, such as ``s``; empty: none
    higher_is_better: False: lower values are better
    skips_frames: its models answer about some frames only: this score and progress are NaN at the others
    is_newer: exports without it exist in the same family, so a served model may gain it
    """

    meaning: str
    is_always_asked: bool = False
    may_be_unknown: bool = False
    replaced_by: str = ""
    is_per_bin: bool = False
    mark: str = ""
    bounds: tuple[float | None, float | None] = (0.0, 1.0)
    unit: str = ""
    higher_is_better: bool = True
    skips_frames: bool = False
    is_newer: bool = False

    def short(self, name: str) -> str:
        """Return the name without the unit: ``remaining``."""
        return name.removesuffix(f"_{self.unit}")

    def title(self, name: str) -> str:
        """Return the name for an axis, with the unit: ``remaining (s)``."""
        return f"{self.short(name)} ({self.unit})" if self.unit else name

    def mark_note(self, values: npt.NDArray[Any]) -> str:
        """Return a line about the marked frames among ``values``, [T]; empty: none is marked."""
        count = np.count_nonzero(values) if self.mark else 0
        return f"{count} of {len(values)} frames: {self.mark}" if count else ""


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameScores:
    """Scores for every frame in one trajectory. All other code that knows a score derives it from its ``Score``.

    progress: float32 [T], share of the task done, 0..1; NaN throughout: the checkpoint does not predict it; NaN where
        ``is_answered`` is False. Robo-Dopamine's is not clipped and may leave 0..1
    success: float32 [T], probability that the task is done; NaN throughout: the checkpoint does not predict it
    progress_logits: float32 [T, K], raw scores for the progress bins, on request, from discrete checkpoints only
    log_prob: float32 [T], TOPReward's log-probability that the frames so far complete the task
    unclear: bool [T], True where RoboReward's written answer states no single whole score, so progress may be misread;
        None: the model writes no answers
    remaining_s: float32 [T], RynnValue's seconds from each frame until the task is done
    relative_s: float32 [T], RynnValue's seconds from the previous frame, negative where the task went backwards; 0 at
        the first frame
    entropy: float32 [T], entropy in nats of the probabilities behind ``remaining_s``; larger: less sure
    hop: float32 [T], Robo-Dopamine's change at each compared frame; NaN: not compared. Modes incremental and benchmark:
        the closed share of what remained or, negative, the lost share of what was reached. Other modes: the difference
        in progress
    frame_indices: int64 [T], indices of the scored frames in the trajectory; None: all frames
    """

    progress: Annotated[
        Float32Array, Score("Share of the task that is done", is_always_asked=True, replaced_by="remaining_s")
    ]
    success: Annotated[
        Float32Array, Score("Probability that the task is done", is_always_asked=True, may_be_unknown=True)
    ]
    progress_logits: Annotated[
        Float32Array | None, Score("Raw scores of the progress bins", is_per_bin=True, bounds=(None, None))
    ] = None
    log_prob: Annotated[
        Float32Array | None,
        Score("Logarithm of the probability that the frames so far complete the task", bounds=(None, 0.0)),
    ] = None
    unclear: Annotated[
        npt.NDArray[np.bool_] | None,
        Score(
            "1 where the model's written answer states no single whole score",
            mark="the model's written answer states no single whole score (as 1.5, 3/5, or two scores), so progress may"
            " be misread; --strict-answers refuses these",
            higher_is_better=False,
            is_newer=True,
        ),
    ] = None
    remaining_s: Annotated[
        Float32Array | None,
        Score(
            "Seconds that remain until the task is done",
            bounds=(None, None),
            unit="s",
            higher_is_better=False,
        ),
    ] = None
    relative_s: Annotated[
        Float32Array | None,
        Score("Seconds since the frame before, by the model", bounds=(None, None), unit="s"),
    ] = None
    entropy: Annotated[
        Float32Array | None,
        Score(
            "Entropy of the remaining seconds in nats: how unsure the model is",
            bounds=(0.0, None),
            unit="nats",
            higher_is_better=False,
        ),
    ] = None
    hop: Annotated[
        Float32Array | None,
        Score(
            "Change at each frame that the model compared with another",
            bounds=(None, None),
            skips_frames=True,
        ),
    ] = None
    frame_indices: npt.NDArray[np.int64] | None = None

    @property
    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """The scores that exist, by name."""
        return {name: scores for name in FRAME_SCORES if (scores := getattr(self, name)) is not None}

    @property
    def is_answered(self) -> npt.NDArray[np.bool_]:
        """bool [T], True at the frames that the model answered about; progress is NaN at the others."""
        skipping = [scores for name, scores in self.arrays.items() if FRAME_SCORES[name].skips_frames]
        return ~np.isnan(skipping[0]) if skipping else np.ones(len(self.progress), bool)

    @property
    def leading(self) -> str:
        """The score that tells how far the task is: ``progress``, or what replaces it."""
        instead = FRAME_SCORES["progress"].replaced_by
        return instead if instead in self.arrays and np.isnan(self.progress).all() else "progress"

    @property
    def scored_frames(self) -> npt.NDArray[np.int64]:
        """int64 [T], indices of the scored frames in the trajectory, even if all are scored."""
        return np.arange(len(self.progress)) if self.frame_indices is None else self.frame_indices

    def at(self, index: slice | npt.NDArray[np.integer[Any]]) -> Self:
        """Return the scores at the frames in ``index``."""
        kept = {} if self.frame_indices is None else {"frame_indices": self.frame_indices}
        return replace(self, **{name: each[index] for name, each in {**self.arrays, **kept}.items()})

    @staticmethod
    def joined(parts: Sequence[FrameScores]) -> FrameScores:
        """Return the scores for all parts' frames, in order.

        Raises InferenceFailedError if some parts have a score that others lack.
        """
        of_parts = [part.arrays for part in parts]
        for name in FRAME_SCORES:
            count = sum(name in arrays for arrays in of_parts)
            if count not in (0, len(parts)):
                expected = f"it for all {len(parts)} parts of the answer, or for none"
                raise InferenceFailedError(f"{name}: expected {expected}, got it for {count}: ask again")
        return FrameScores(**{name: np.concatenate([arrays[name] for arrays in of_parts]) for name in of_parts[0]})

    @property
    def last_progress(self) -> float:
        """Progress at the last frame. Raises ValueError if the checkpoint does not predict it."""
        return float(_known("progress", self.progress[-1:])[-1])

    @property
    def progress_deltas(self) -> Float32Array:
        """float32 [T], change in progress since the previous scored frame; 0 for the first.

        Raises ValueError if the checkpoint does not predict progress at each frame.
        """
        progress = _known("progress", self.progress)
        return np.diff(progress, prepend=progress[:1])

    def progress_by(self, rule: ProgressRule) -> Float32Array:
        """Derive progress, float32 [T], 0..1, from the seconds that RynnValue predicts instead.

        rule: ``remaining_over_first``: 1 - remaining_s / remaining_s at the first frame, within 0..1. So the scores
            must cover one whole episode, whose first frame has progress 0

        Raises ValueError for another rule, without remaining seconds, or if they are not above 0 at the first frame.
        """
        require("rule", rule in get_args(ProgressRule), f"one of {', '.join(get_args(ProgressRule))}", repr(rule))
        require("remaining_s", self.remaining_s is not None, "seconds", "none: this checkpoint does not predict them")
        seconds = np.asarray(self.remaining_s)
        require("remaining_s", bool(seconds[0] > 0), "more than 0 at the first frame", float(seconds[0]))
        progress: Float32Array = np.clip(1 - seconds / seconds[0], 0, 1).astype(np.float32)
        return progress

    def succeeded(self, *, last: int = 1, threshold: float = SUCCESS_THRESHOLD) -> bool:
        """True if success reaches ``threshold`` at more than half of the ``last`` frames (or all, if there are fewer).

        Raises ValueError if the checkpoint does not predict success, for a ``threshold`` outside 0..1 or ``last`` < 1.
        """
        newest = _known("success", self.success)[-checked_count("last", last) :]
        votes = newest >= checked_share("threshold", threshold)
        return bool(2 * np.count_nonzero(votes) > len(votes))


FRAME_SCORES: Mapping[str, Score] = {
    name: about
    for name, hint in get_type_hints(FrameScores, include_extras=True).items()
    for about in getattr(hint, "__metadata__", ())
}


@dataclass(frozen=True, eq=False, kw_only=True)
class ProgressResult(FrameScores):
    """Answer to a ProgressSample: scores for its trajectory's frames.

    model_version: checkpoint version that answered
    """

    timing: BatchTiming | None = None
    model_version: str | None = None

    @classmethod
    def of_parts(cls, parts: Sequence[ProgressResult]) -> ProgressResult:
        """Return one result for all parts' frames, as ``FrameScores.joined`` does, without ``timing``.

        Raises InferenceFailedError if several checkpoint versions answered.
        """
        return cls(**vars(cls.joined(parts)), model_version=one_version(parts, "all frames"))


@dataclass(frozen=True, eq=False, kw_only=True)
class PreferenceResult:
    """Answer to a PreferenceSample: the probability that ``first`` is preferred, and scores for all frames.

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

        Raises InferenceFailedError if two checkpoint versions answered.
        """
        one_version((asked, swapped), "both orders")
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
    """Answer to a SimilaritySample: the raw, unbounded similarity score, and scores for all frames."""

    similarity: float
    reference: FrameScores
    other: FrameScores
    timing: BatchTiming | None = None
    model_version: str | None = None


Result: TypeAlias = ProgressResult | PreferenceResult | SimilarityResult


def one_version(results: Iterable[Result], what: str) -> str | None:
    """Return the checkpoint version that answered. Raises InferenceFailedError for several.

    what: what it answered, for the message
    """
    versions = {result.model_version for result in results}
    if len(versions) > 1:
        got = ", ".join(sorted(map(str, versions)))
        raise InferenceFailedError(f"model_version: expected one for {what}, got {got}: ask again")
    return next(iter(versions), None)


def trajectory_scores(result: Result) -> dict[str, FrameScores]:
    """Return each trajectory's scores by its name in the result; a single trajectory has an empty name."""
    if isinstance(result, ProgressResult):
        return {"": result}
    return {name: value for name, value in vars(result).items() if isinstance(value, FrameScores)}


def answer(result: Result) -> dict[str, float]:
    """Return the preference or similarity by name; empty for a ProgressResult."""
    return {name: value for name, value in vars(result).items() if name in PAIR_SCORES}


def _preferred(preference: float) -> Literal["first", "second"] | None:
    if preference > EVEN:
        return "first"
    return "second" if preference < EVEN else None


def _known(name: str, scores: Float32Array) -> Float32Array:
    missing = np.isnan(scores)
    why = "this checkpoint does not predict it" if missing.all() else "the model answered about the others only (hop)"
    require(name, not missing.any(), "a score of each frame", f"NaN: {why}")
    return scores
