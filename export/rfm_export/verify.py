# SPDX-License-Identifier: MIT
"""Does an exported model give the numbers of the checkpoint that it was made from?"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from rfm.engine import Engine, Outcome
from rfm.family import Description
from rfm_client.contract import (
    FrameScores,
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    RewardError,
    Sample,
    SimilaritySample,
    Trajectory,
)
from rfm_client.contract.made_up import Widths, random_trajectory
from rfm_export.errors import ExportDiffersError

TOLERANCE = 1e-6  # same weights, same machine, same code: the numbers are the same but for rounding
PROBE_FRAMES = (1, 3, 8)
PROBE_SIZE_PX = (48, 80)
PROBE_FRAME_STEPS = 2
PROBE_SEED = 0


def probes(description: Description, *, with_encoders: bool) -> list[Sample]:
    """Random samples of each type that the checkpoint can score, of several lengths.

    with_encoders: there are encoders, so that a checkpoint that scores embeddings is compared on raw frames, too
    """
    random = np.random.default_rng(PROBE_SEED)

    def make(num_frames: int, widths: Widths) -> Trajectory:
        task = f"pick up {num_frames} red cups"
        return random_trajectory(random, num_frames, widths, task=task, size_px=PROBE_SIZE_PX)

    samples: list[Sample] = []
    for widths in (description.widths, None) if with_encoders else (description.widths,):
        for num_frames in PROBE_FRAMES:
            length = min(num_frames, description.max_frames or num_frames)
            samples.append(ProgressSample(make(length, widths)))
            samples.append(ProgressSample(make(length, widths), frame_steps=PROBE_FRAME_STEPS))
            if description.has_preference:
                samples.append(PreferenceSample(make(length, widths), make(1, widths)))
            if description.has_similarity:
                samples.append(SimilaritySample(make(1, widths), make(length, widths)))
    return samples


def verify(original: Callable[[], Engine], exported: Callable[[], Engine], samples: Sequence[Sample]) -> None:
    """Raises ExportDiffersError unless both engines give the same numbers for every sample; one is made at a time."""
    scores = [make().evaluate(samples) for make in (original, exported)]
    for index, (before, after) in enumerate(zip(*scores, strict=True)):
        expected, got = _numbers(index, "the checkpoint", before), _numbers(index, "the export", after)
        if not np.allclose(got, expected, rtol=0, atol=TOLERANCE, equal_nan=True):
            largest = np.nanmax(np.abs(got - expected))  # NaN: success that is not predicted
            raise ExportDiffersError(
                f"probe {index}: expected the checkpoint's scores, got a difference of {largest:g}"
            )


def _numbers(index: int, whose: str, outcome: Outcome) -> npt.NDArray[np.float64]:
    if isinstance(outcome, RewardError):
        raise ExportDiffersError(f"probe {index}: expected scores of {whose}, got: {outcome}") from outcome
    if isinstance(outcome, ProgressResult):
        return _frame_numbers(outcome)
    if isinstance(outcome, PreferenceResult):
        return np.concatenate([[outcome.preference], _frame_numbers(outcome.first), _frame_numbers(outcome.second)])
    return np.concatenate([[outcome.similarity], _frame_numbers(outcome.reference), _frame_numbers(outcome.other)])


def _frame_numbers(scores: FrameScores) -> npt.NDArray[np.float64]:
    logits = [] if scores.progress_logits is None else [scores.progress_logits.ravel()]
    numbers: npt.NDArray[np.float64] = np.concatenate([scores.progress, scores.success, *logits]).astype(np.float64)
    return numbers
