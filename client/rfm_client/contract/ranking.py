# SPDX-License-Identifier: MIT
"""Rank trajectories by how well they do a task, from the preferences of a model.

A model's preference may depend on the order of the two trajectories, so every pair is compared in both orders. If the
orders disagree, the pair has no verdict.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean
from typing import TypeAlias, cast

from rfm_client.contract.results import PreferenceResult, one_version

Order: TypeAlias = tuple[int, int]  # indices of the first and second trajectory in a question


@dataclass(frozen=True, eq=False, kw_only=True)
class Ranking:
    """N trajectories, and their preferences from one model version.

    results: for both orders of every pair, N * (N - 1)
    """

    results: Mapping[Order, PreferenceResult]

    @cached_property
    def numbers(self) -> range:
        """Indices of the trajectories, from 0."""
        return range(1 + max(first for first, _ in self.results))

    @property
    def model_version(self) -> str | None:
        """The checkpoint version that answered. Raises InferenceFailedError for several."""
        return one_version(self.results.values(), "all pairs")

    def pair(self, first: int, second: int) -> PreferenceResult:
        """Return both orders for two trajectories as one result."""
        return PreferenceResult.of_both_orders(self.results[first, second], self.results[second, first])

    def couples(self) -> Iterator[Order]:
        """Yield every pair of trajectories once, in the given order."""
        return itertools.combinations(self.numbers, 2)

    def document(self, names: Sequence[object]) -> dict[str, list[dict[str, object]]]:
        """Return the answers for JSON, in both ``orders`` and of the ``pairs``. names: of the trajectories

        ``preference`` is the probability that the first one wins, of a pair averaged over both orders.
        """

        def of(first: int, second: int, **answer: object) -> dict[str, object]:
            return {"first": names[first], "second": names[second], **answer}

        pairs = [(couple, self.pair(*couple)) for couple in self.couples()]
        return {
            "orders": [of(*order, preference=result.preference) for order, result in sorted(self.results.items())],
            "pairs": [
                of(*couple, preference=pair.preference, verdict=pair.verdict, orders_agree=pair.orders_agree)
                for couple, pair in pairs
            ],
        }

    @cached_property
    def wins(self) -> list[float]:
        """Each trajectory's mean probability of winning, averaged over opponents and orders."""
        return [
            fmean(self.pair(index, other).preference for other in self.numbers if other != index)
            for index in self.numbers
        ]

    @cached_property
    def ranks(self) -> list[int | None]:
        """Each trajectory's rank by ``wins``, from 1; None if one of its pairs has no verdict, or wins tie."""
        best_first = sorted(self.wins, reverse=True)
        unranked = {index for couple in self.couples() if self.pair(*couple).verdict is None for index in couple}
        unranked |= {index for index in self.numbers if self.wins.count(self.wins[index]) > 1}
        return [None if index in unranked else best_first.index(self.wins[index]) + 1 for index in self.numbers]

    @property
    def ranking(self) -> list[int] | None:
        """The trajectories' indices, best first; None if one has no rank."""
        if None in self.ranks:
            return None
        return sorted(self.numbers, key=lambda index: cast(int, self.ranks[index]))
