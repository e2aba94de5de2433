# SPDX-License-Identifier: MIT
"""Figures of answers, and their bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from demo_evaluation.questions import Case, HeldOut
from rfm_client import PreferenceResult, ProgressResult, Result, SimilarityResult
from toy_world import Clip

_FALL = 0.1  # progress must fall by so much, in all, in the part that is rewound
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Figure:
    """A figure, and what it must reach; None: it is only told."""

    name: str
    value: float
    bound: float | None = None

    @property
    def holds(self) -> bool:
        """Whether it reaches its bound."""
        return self.bound is None or self.value >= self.bound


@dataclass(frozen=True, eq=False)
class _Answers:
    """The answers about one case."""

    case: Case
    progress: list[ProgressResult]
    preferences: list[float]
    similarities: list[float]

    @classmethod
    def of(cls, case: Case, results: Sequence[Result]) -> _Answers:
        return cls(
            case,
            [result for result in results if isinstance(result, ProgressResult)],
            [result.preference for result in results if isinstance(result, PreferenceResult)],
            [result.similarity for result in results if isinstance(result, SimilarityResult)],
        )


def figures(held_out: HeldOut, results: Sequence[Result], of_noise: Sequence[Result]) -> list[Figure]:
    """All figures, from the results of ``held_out.samples()`` and of ``noise_samples()``."""
    count = len(results) // len(held_out.cases)
    answers = [_Answers.of(case, results[i * count : (i + 1) * count]) for i, case in enumerate(held_out.cases)]
    scored = [pair for each in answers for pair in zip(each.case.clips, each.progress, strict=True)]
    successes = [progress for each in answers for progress in each.progress[:2]]
    preferences, noise = ([r.preference for r in rs if isinstance(r, PreferenceResult)] for rs in (results, of_noise))
    return [
        Figure("Spearman(progress, time), successes, median", float(np.median(_rises(successes))), 0.95),
        Figure(
            "progress falls in the rewound part", _mean(_falls(a.case.rewound, a.progress[3]) for a in answers), 0.95
        ),
        Figure("success preferred to failure", _preferred(answers, slice(0, 2)), 0.97),
        Figure("right preferred to wrong sentence", _preferred(answers, slice(2, 4)), 0.95),
        Figure("AUROC of success at the last frame", _success_auroc(scored), 0.97),
        Figure(
            "same task more similar than another", _mean(a.similarities[0] > a.similarities[1] for a in answers), 0.95
        ),
        Figure("agreement of both orders, held-out pairs", order_agreement(preferences), 0.95),
        Figure("agreement of both orders, random pixels", order_agreement(noise), 0.8),
        Figure("final progress: right above wrong sentence", _mean(_right_higher(a) for a in answers)),
        Figure("final progress: successes, mean", _mean(p.last_progress for p in successes)),
        Figure("final progress: wrong sentence, mean", _mean(a.progress[4].last_progress for a in answers)),
        Figure("final success: wrong sentence, mean", _mean(float(a.progress[4].success[-1]) for a in answers)),
        Figure("mean absolute error of progress", _mean(np.abs(p.progress - c.progress).mean() for c, p in scored)),
        Figure("similarity above 0: two successes of a task", _mean(a.similarities[0] > 0 for a in answers)),
        Figure("similarity below 0: another task", _mean(a.similarities[1] < 0 for a in answers)),
    ]


def spearman(values: npt.ArrayLike, others: npt.ArrayLike) -> float:
    """Rank correlation; equal values share their mean rank; NaN if either is constant."""
    ranks, other_ranks = _ranks(np.asarray(values)), _ranks(np.asarray(others))
    if np.ptp(ranks) == 0 or np.ptp(other_ranks) == 0:
        return float("nan")
    return float(np.corrcoef(ranks, other_ranks)[0, 1])


def auroc(scores: npt.ArrayLike, labels: npt.ArrayLike) -> float:
    """Probability that a positive's score is above a negative's; equal ones count half."""
    is_positive = np.asarray(labels, dtype=bool)
    positives, negatives = int(is_positive.sum()), int((~is_positive).sum())
    rank_sum = (_ranks(np.asarray(scores))[is_positive] + 1).sum()
    return float((rank_sum - positives * (positives + 1) / 2) / (positives * negatives))


def order_agreement(preferences: npt.ArrayLike) -> float:
    """1 less the mean |P(a,b) + P(b,a) - 1| of pairs, each asked in two orders one after the other."""
    return 1 - float(np.abs(np.reshape(preferences, (-1, 2)).sum(axis=1) - 1).mean())


def _ranks(values: npt.NDArray[np.generic]) -> Values:
    """float64, from 0; equal values share their mean rank."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks: Values = (np.cumsum(counts) - (counts + 1) / 2)[inverse]
    return ranks


def _rises(results: Sequence[ProgressResult]) -> list[float]:
    return [spearman(result.progress, np.arange(len(result.progress))) for result in results]


def _falls(clip: Clip, result: ProgressResult) -> bool:
    """Progress goes down from the turn on: against time, and in all."""
    part = result.progress[clip.turn :]
    return spearman(part, np.arange(len(part))) < 0 and float(part[0] - part[-1]) >= _FALL


def _preferred(answers: Sequence[_Answers], pairs: slice) -> float:
    """Share of the questions, asked either way round, in which the better one is preferred."""
    forth_and_back = np.array([each.preferences[pairs] for each in answers])
    return float(((forth_and_back > 0.5) == (True, False)).mean())


def _success_auroc(scored: Sequence[tuple[Clip, ProgressResult]]) -> float:
    return auroc([result.success[-1] for _, result in scored], [clip.success[-1] for clip, _ in scored])


def _right_higher(answers: _Answers) -> bool:
    return answers.progress[0].last_progress > answers.progress[4].last_progress


def _mean(values: object) -> float:
    return float(np.mean(list(values)))  # type: ignore[call-overload]
