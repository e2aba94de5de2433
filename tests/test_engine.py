# SPDX-License-Identifier: MIT
"""The engine with a made-up family, where the order of things is known."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
from conftest import random_trajectory

from rfm.engine import Engine
from rfm.execution import Execution
from rfm.family import RowScores
from rfm_client import FrameScores, ProgressResult, ProgressSample, RewardError, Sample

WAIT_S = 30


class Pipelined:
    """A family whose forward waits until the next batch has been collated."""

    def __init__(self, batches: int) -> None:
        self.collated = [threading.Event() for _ in range(batches)]
        self.scored = 0

    def rows(self, samples: Sequence[Sample], execution: Execution) -> list[list[int] | RewardError]:
        return [[index] for index in range(len(samples))]

    def lengths(self, row: int) -> tuple[int, ...]:
        return (row,)

    def num_tokens(self, lengths: Sequence[int]) -> int:
        return 1

    def collate(self, rows: Sequence[int]) -> Any:
        self.collated[rows[0]].set()

    def occupancy(self, batch: Any) -> tuple[int, int]:
        return 1, 1

    def score(self, rows: Sequence[int], batch: Any) -> list[RowScores | RewardError]:
        if rows[0] + 1 < len(self.collated):
            assert self.collated[rows[0] + 1].wait(WAIT_S)
        self.scored += 1
        score = np.full(1, rows[0], np.float32)
        return [RowScores([FrameScores(progress=score, success=score)])]


def test_the_next_batch_is_collated_while_the_current_one_runs() -> None:
    family = Pipelined(batches=4)
    samples = [ProgressSample(random_trajectory(0, 1))] * 4
    passes: list[int] = []
    execution = Execution(on_forward=lambda: passes.append(family.scored))
    outcomes = Engine(family, token_budget=1).evaluate(samples, execution)
    assert passes == [1, 2, 3, 4]
    results = [outcome for outcome in outcomes if isinstance(outcome, ProgressResult)]
    assert [result.progress[0] for result in results] == [0, 1, 2, 3]
