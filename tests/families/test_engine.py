# SPDX-License-Identifier: MIT
"""The engine with a synthetic predictor, where the order of things is known."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from paths import ROOT
from rfm.engine import Engine, Execution
from rfm.engine.predictor import RowScores
from rfm_client import (
    FrameScores,
    InferenceFailedError,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    RewardError,
    Sample,
    SimilaritySample,
)
from trajectories import random_trajectory

WAIT_S = 30


class Fixed:
    """A predictor of given rows, each of a sample, which are their own scores."""

    has_progress = True
    reads_views = False

    def __init__(self, rows: Sequence[Any], *, has_success: bool = True) -> None:
        self.left, self.has_success = iter(rows), has_success

    def rows(self, sample: Sample) -> list[Any]:
        return [next(self.left)]

    def num_tokens(self, row: Any) -> int:
        return 1

    def sequences(self, row: Any) -> Sequence[Any]:
        return (row,)

    def collate(self, rows: Sequence[Any]) -> None:
        pass

    def count(self, batch: None, execution: Execution) -> None:
        pass

    def score(self, rows: Sequence[Any], batch: None, execution: Execution) -> list[RowScores | RewardError]:
        return list(rows)

    def joined(self, sample: Sample, rows: Sequence[RowScores]) -> FrameScores:
        return rows[0].frames[0]


class Pipelined(Fixed):
    """Its forward waits until the next batch has been collated."""

    def __init__(self, batches: int) -> None:
        super().__init__(range(batches))
        self.collated = [threading.Event() for _ in range(batches)]
        self.num_scored = 0

    def collate(self, rows: Sequence[int]) -> None:
        self.collated[rows[0]].set()

    def score(self, rows: Sequence[int], batch: None, execution: Execution) -> list[RowScores | RewardError]:
        if rows[0] + 1 < len(self.collated):
            assert self.collated[rows[0] + 1].wait(WAIT_S)
        self.num_scored += 1
        score = np.full(1, rows[0], np.float32)
        return [RowScores([FrameScores(progress=score, success=score)])]


def test_the_next_batch_is_collated_while_the_current_one_runs() -> None:
    predictor = Pipelined(batches=4)
    samples = [ProgressSample(random_trajectory(0, 1))] * 4
    passes: list[int] = []
    execution = Execution(on_forward=lambda: passes.append(predictor.num_scored))
    outcomes = Engine(predictor, token_budget=1).evaluate(samples, execution)
    assert passes == [1, 2, 3, 4]
    results = [outcome for outcome in outcomes if isinstance(outcome, ProgressResult)]
    assert [result.progress[0] for result in results] == [0, 1, 2, 3]


def test_collating_inside_a_forward_pass_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    times_s, execution = iter([0, 1, 4, 10]), Execution()
    with monkeypatch.context() as clock:
        clock.setattr(time, "perf_counter", lambda: next(times_s))
        with execution.forwarding(), execution.collating():
            pass
    assert (execution.collate_s, execution.forward_s) == (3, 7)


def scores_of(**changed: float | None) -> FrameScores:
    """Return the scores of a frame."""
    values = {"progress": 0.5, "success": 0.5, **changed}
    return FrameScores(**{name: np.full(1, value, np.float32) for name, value in values.items() if value is not None})


GOOD = scores_of()
PAIR = (random_trajectory(1, 1), random_trajectory(2, 1))
NOT_FINITE = {
    "progress": (ProgressSample(PAIR[0]), RowScores([scores_of(progress=np.nan)])),
    "success": (ProgressSample(PAIR[0]), RowScores([scores_of(success=np.nan)])),
    "log_prob": (ProgressSample(PAIR[0]), RowScores([scores_of(log_prob=-np.inf)])),
    "preference": (PreferenceSample(*PAIR), RowScores([GOOD, GOOD], np.nan)),
    "similarity": (SimilaritySample(*PAIR), RowScores([GOOD, GOOD], np.inf)),
    "the second trajectory": (PreferenceSample(*PAIR), RowScores([GOOD, scores_of(progress=np.nan)], 0.5)),
}


@pytest.mark.parametrize(("sample", "row"), NOT_FINITE.values(), ids=NOT_FINITE)
def test_a_score_that_is_not_finite_fails_its_sample_alone(sample: Sample, row: RowScores) -> None:
    """The engine checks the scores of every family."""
    neighbour = ProgressSample(PAIR[0])
    first, bad, last = Engine(Fixed([RowScores([GOOD]), row, RowScores([GOOD])])).evaluate(
        [neighbour, sample, neighbour]
    )
    assert isinstance(bad, InferenceFailedError)
    assert str(bad) == "the network gave a score that is not finite"
    assert isinstance(first, ProgressResult)
    assert isinstance(last, ProgressResult)


def test_a_network_without_success_may_give_nan_for_it() -> None:
    engine = Engine(Fixed([RowScores([scores_of(success=np.nan)])], has_success=False))
    (result,) = engine.evaluate([ProgressSample(PAIR[0])])
    assert isinstance(result, ProgressResult)


IN_LITTLE_MEMORY = """
import resource, sys
from dataclasses import replace
import numpy as np, torch
from small_network import SMALL
from trajectories import random_trajectory
from rfm.engine import Engine
from rfm.engine import Execution
from rfm.families.rewind.checkpoint import RewindPredictor
from rfm.families.rewind.network import RewindTransformer
from rfm_client import InferenceFailedError, ProgressResult, ProgressSample

MIB = 2**20
torch.manual_seed(0)
config = replace(
    SMALL, video_feature_dim=8, text_feature_dim=8, hidden_dim=512, num_layers=1, num_attention_heads=8,
    use_per_frame_progress_token=False, progress_bins=1, has_similarity=False,
)
engine = Engine(RewindPredictor(RewindTransformer(config), torch.device("cpu")))
samples = [ProgressSample(random_trajectory(seed, 1000, 8, 8)) for seed in range(16)]
expected = engine.evaluate(samples)  # each layer's widest activations take 128 MiB, of one sample 8
pages = int(open("/proc/self/statm").read().split()[0])
limit = pages * resource.getpagesize() + 100 * MIB
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
execution = Execution()
huge = ProgressSample(random_trajectory(16, 50_000, 8, 8))
*outcomes, failed = engine.evaluate([*samples, huge], execution)
assert execution.out_of_memory_count >= 2, execution
assert isinstance(failed, InferenceFailedError), failed
assert str(failed) == "the sample does not fit in the device's memory", failed
for outcome, other in zip(outcomes, expected, strict=True):
    assert isinstance(outcome, ProgressResult), outcome
    np.testing.assert_allclose(outcome.progress, other.progress, rtol=0, atol=1e-5)
"""


@pytest.mark.slow
def test_a_cpu_out_of_memory_halves_the_batch_and_fails_a_lone_sample() -> None:
    """Runs in a separate process, since a memory limit is real and permanent."""
    environment = {**os.environ, "MALLOC_MMAP_THRESHOLD_": str(2**16), "MALLOC_ARENA_MAX": "1"}
    subprocess.run(
        [sys.executable, "-c", IN_LITTLE_MEMORY], cwd=ROOT / "tests" / "support", env=environment, check=True
    )
