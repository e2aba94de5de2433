# SPDX-License-Identifier: MIT
"""The engine with a synthetic predictor, where the order of things is known."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from paths import ROOT
from rfm.engine import Engine
from rfm.engine.execution import Execution
from rfm.engine.predictor import RowScores
from rfm_client import FrameScores, ProgressResult, ProgressSample, RewardError, Sample
from trajectories import random_trajectory

WAIT_S = 30


class Pipelined:
    """A predictor whose forward waits until the next batch has been collated."""

    def __init__(self, batches: int) -> None:
        self.collated = [threading.Event() for _ in range(batches)]
        self.num_rows = 0
        self.scored = 0

    def rows(self, sample: Sample) -> list[int]:
        self.num_rows += 1
        return [self.num_rows - 1]

    def num_tokens(self, row: int) -> int:
        return 1

    def collate(self, rows: Sequence[int]) -> Any:
        self.collated[rows[0]].set()

    def count(self, batch: Any, execution: Execution) -> None:
        execution.add_tokens(1, 1)

    def score(self, rows: Sequence[int], batch: Any, execution: Execution) -> list[RowScores | RewardError]:
        if rows[0] + 1 < len(self.collated):
            assert self.collated[rows[0] + 1].wait(WAIT_S)
        self.scored += 1
        score = np.full(1, rows[0], np.float32)
        return [RowScores([FrameScores(progress=score, success=score)])]

    def joined(self, sample: Sample, rows: Sequence[RowScores]) -> FrameScores:
        return rows[0].frames[0]


def test_the_next_batch_is_collated_while_the_current_one_runs() -> None:
    predictor = Pipelined(batches=4)
    samples = [ProgressSample(random_trajectory(0, 1))] * 4
    passes: list[int] = []
    execution = Execution(on_forward=lambda: passes.append(predictor.scored))
    outcomes = Engine(predictor, token_budget=1).evaluate(samples, execution)
    assert passes == [1, 2, 3, 4]
    results = [outcome for outcome in outcomes if isinstance(outcome, ProgressResult)]
    assert [result.progress[0] for result in results] == [0, 1, 2, 3]


IN_LITTLE_MEMORY = """
import resource, sys
from dataclasses import replace
import numpy as np, torch
from small_network import SMALL
from trajectories import random_trajectory
from rfm.engine import Engine
from rfm.engine.execution import Execution
from rfm.rewind.predictor import RewindPredictor
from rfm.rewind.network import RewindTransformer
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
    """A process of its own, since the limit on its memory is real and lasts; what is freed there is free at once."""
    environment = {**os.environ, "MALLOC_MMAP_THRESHOLD_": str(2**16), "MALLOC_ARENA_MAX": "1"}
    subprocess.run(
        [sys.executable, "-c", IN_LITTLE_MEMORY], cwd=ROOT / "tests" / "support", env=environment, check=True
    )
