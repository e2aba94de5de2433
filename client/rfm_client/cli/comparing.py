# SPDX-License-Identifier: MIT
"""``rfm-client compare``: which of several videos does a task best. N videos.

A model's verdict on a pair depends on which of the two it is shown first, so it is asked in both orders.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import TYPE_CHECKING, cast

from rfm_client.cli.options import Server
from rfm_client.cli.scoring import Question, Source, fitted_to
from rfm_client.cli.show import Panel, number, table
from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.results import FrameScores, PreferenceResult
from rfm_client.contract.samples import PreferenceSample, ProgressSample, Trajectory
from rfm_client.data.fitting import with_frame_indices

if TYPE_CHECKING:
    from rich.table import Table

EVEN = 0.5  # neither is preferred

Order = tuple[int, int]  # numbers of two videos, as they are asked


@dataclass(frozen=True, eq=False)
class Comparison:
    """N sources, and what the model says of them.

    scores: of each source, as the model tells them when it compares the source with the first one, in the order given
    preferences: probability that the first of two does the task better, for every order of every two
    model_version: that answered all; None: several did, or it is not known
    """

    sources: Sequence[Source]
    scores: Sequence[FrameScores]
    preferences: Mapping[Order, float]
    model_version: str | None

    def wins(self, index: int) -> float:
        """The mean probability that a source wins, over both orders against all others."""
        others = [other for other in self._numbers if other != index]
        return sum(self.mean(index, other) for other in others) / len(others)

    def mean(self, first: int, second: int) -> float:
        """The probability that ``first`` wins against ``second``, as the mean of both orders."""
        return (self.preferences[first, second] + 1 - self.preferences[second, first]) / 2

    @property
    def ranking(self) -> list[int]:
        """The numbers of the sources, the best one first; of equals the one that was named first."""
        return sorted(self._numbers, key=self.wins, reverse=True)

    def tables(self) -> list[Table]:
        """The sources, the best one first, and both answers about every two."""
        couples = itertools.combinations(self._numbers, 2)
        columns = ("video", "rank", "P(wins)", "its last progress", "its last success", "frames")
        ranked = [(*self._row(index, rank), str(len(self.scores[index].progress))) for rank, index in self._ranked()]
        pairs = ("first", "second", "P(first wins)", "asked second first", "mean", "orders")
        return [
            table("", columns, ranked),
            table("", pairs, [self._pair(*couple) for couple in couples], names=2),
        ]

    def panels(self) -> list[Panel]:
        """What a plot shows of it, the best one first."""
        return [
            self.sources[index].panel(
                f"{rank}. {PurePath(self.sources[index].name).name}: wins with P = {self.wins(index):.3f}",
                self.scores[index],
            )
            for rank, index in self._ranked()
        ]

    @property
    def _numbers(self) -> range:
        return range(len(self.sources))

    def _ranked(self) -> list[tuple[int, int]]:
        return list(enumerate(self.ranking, 1))

    def _row(self, index: int, rank: int) -> tuple[str, ...]:
        scores = self.scores[index]
        figures = (self.wins(index), scores.progress[-1], scores.success[-1])
        return (self.sources[index].name, str(rank), *map(number, figures))

    def _pair(self, first: int, second: int) -> tuple[str, ...]:
        answers = self.preferences[first, second], 1 - self.preferences[second, first]
        agree = (answers[0] > EVEN) == (answers[1] > EVEN)
        names = (self.sources[index].name for index in (first, second))
        return (*names, *map(number, (*answers, self.mean(first, second))), "agree" if agree else "disagree")


def compare(server: Server, names: Sequence[str], question: Question) -> Comparison:
    """Which source does the task of the first best. Raises RewardError."""
    with server.connected() as client:
        sources = [Source.read(name, question) for name in names]
        trajectories = [_of_one_task(sources[0], source) for source in sources]
        fits = [fitted_to(client, ProgressSample(trajectory), question) for trajectory in trajectories]
        sent = [fit.sample.trajectories[0] for fit in fits]
        orders = list(itertools.permutations(range(len(sources)), 2))
        answers = client.evaluate([PreferenceSample(sent[first], sent[second]) for first, second in orders])
    kept = [fit.frame_indices[0] for fit in fits]
    results = {
        order: cast(PreferenceResult, with_frame_indices(answer, [kept[index] for index in order]))
        for order, answer in zip(orders, answers, strict=True)
    }
    scores = [results[0, 1].first, *(results[0, other].second for other in range(1, len(sources)))]
    preferences = {order: result.preference for order, result in results.items()}
    versions = {result.model_version for result in results.values()}
    return Comparison(sources, scores, preferences, versions.pop() if len(versions) == 1 else None)


def _of_one_task(first: Source, other: Source) -> Trajectory:
    """The other's trajectory with the task of the first, so that both orders ask the same."""
    if other is first:
        return first.trajectory
    try:
        PreferenceSample(first.trajectory, other.trajectory)
    except InvalidSampleError as error:
        raise InvalidSampleError(f"{first.name} and {other.name}: {error}") from error
    asked = first.trajectory
    return replace(other.trajectory, task=asked.task, text_embedding=asked.text_embedding)
