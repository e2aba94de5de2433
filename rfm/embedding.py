# SPDX-License-Identifier: MIT
"""Samples of raw frames -> samples of embeddings, where a network scores those."""

from __future__ import annotations

from collections.abc import Sequence

from rfm.execution import Execution
from rfm.family import FrameEncoders
from rfm_client.contract import RewardError, Sample
from rfm_client.contract.samples import Footage, with_trajectories


def embedded(samples: Sequence[Sample], encoders: FrameEncoders, execution: Execution) -> list[Sample | RewardError]:
    """The samples with embeddings in place of raw frames, which are encoded together; or why a sample has none.

    execution: what it took is added to it
    """
    outcomes: list[Sample | RewardError] = list(samples)
    raw = {i: Footage(s.trajectories) for i, s in enumerate(samples) if s.trajectories[0].frames is not None}
    encoded = encoders.encode(list(raw.values()), execution, None) if raw else []
    for index, outcome in zip(raw, encoded, strict=True):
        if isinstance(outcome, Footage):
            outcomes[index] = with_trajectories(samples[index], outcome.trajectories)
        else:
            outcomes[index] = outcome
    return outcomes
