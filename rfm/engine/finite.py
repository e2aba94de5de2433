# SPDX-License-Identifier: MIT
"""Turn results with NaN or infinite scores into errors."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract import FRAME_SCORES, InferenceFailedError, Result, RewardError
from rfm_client.contract.results import answer, trajectory_scores


def finite(outcomes: Sequence[Result | RewardError], *, lacks: Collection[str]) -> list[Result | RewardError]:
    """Return the outcomes, with an error in place of each result with a NaN or infinite score.

    lacks: scores the network does not predict, which are NaN

    Frames that the model does not answer about are not checked. Neither are logits of progress: RoboReward has none for
    an answer without a digit, and progress shows the others' faults.
    """
    scores = [[] if isinstance(each, RewardError) else list(_scores(each, lacks)) for each in outcomes]
    of_all = [array for of_one in scores for array in of_one]
    if not of_all or np.isfinite(np.concatenate(of_all)).all():  # all at once, which is faster
        return list(outcomes)
    failed = InferenceFailedError("the network gave a score that is not finite")
    return [
        outcome if all(np.isfinite(array).all() for array in of_one) else failed
        for outcome, of_one in zip(outcomes, scores, strict=True)
    ]


def _scores(result: Result, lacks: Collection[str]) -> Iterator[npt.NDArray[Any]]:
    """Yield the result's scores, [N] each."""
    if of_pair := answer(result):
        yield np.array([*of_pair.values()], np.float32)
    for scores in trajectory_scores(result).values():
        known = scores.is_answered
        if not known[-1]:  # a model that skips frames answers about the last
            yield np.array([np.nan])
        for name, array in scores.arrays.items():
            if not FRAME_SCORES[name].is_per_bin and name not in lacks:
                yield array[known]
