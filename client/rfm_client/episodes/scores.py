# SPDX-License-Identifier: MIT
"""What a step is told. N episodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfm_client.contract.samples import Float32Array


@dataclass(frozen=True)
class StepScore:
    """The score of one episode at its newest frame.

    progress: share of the task done, 0..1
    success: probability that the task is done; NaN: the checkpoint does not predict it
    succeeded: what the success rule says; never true without success
    step: number of the frame, from 0
    ms: how long the answer took, milliseconds
    """

    progress: float
    success: float
    succeeded: bool
    step: int
    ms: float


@dataclass(frozen=True, eq=False)
class StepScores:
    """The scores of N episodes, each at its newest frame.

    progress, success: float32 [N], as of StepScore; NaN where ``mask`` left an episode out
    succeeded: bool [N]; False there
    step: int64 [N], number of each newest frame, from 0; -1: the episode has none yet
    ms: how long the answer took, milliseconds
    """

    progress: Float32Array
    success: Float32Array
    succeeded: npt.NDArray[np.bool_]
    step: npt.NDArray[np.int64]
    ms: float

    def of(self, index: int) -> StepScore:
        """The score of one episode."""
        numbers = float(self.progress[index]), float(self.success[index])
        return StepScore(*numbers, bool(self.succeeded[index]), int(self.step[index]), self.ms)
