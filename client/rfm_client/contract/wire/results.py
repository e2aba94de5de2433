# SPDX-License-Identifier: MIT
"""Convert results to tensors and back."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract.errors import InferenceFailedError
from rfm_client.contract.results import (
    FRAME_SCORES,
    PAIR_SCORES,
    BatchTiming,
    FrameScores,
    PreferenceResult,
    ProgressResult,
    Result,
    SimilarityResult,
    trajectory_scores,
)
from rfm_client.contract.samples import Float32Array, PreferenceSample, ProgressSample, Sample, SimilaritySample
from rfm_client.contract.wire.specs import PREFERENCE, SIMILARITY, TIMING_MS, Tensors, pad_stack


def outputs_for(samples: Sequence[Sample], given: Collection[str] = ()) -> tuple[str, ...]:
    """Return the scores that these samples ask for. Others would be NaN and waste bandwidth.

    given: frame scores that the model gives, according to its description
    """
    kinds = set(map(type, samples))
    asked_by = {PREFERENCE: PreferenceSample, SIMILARITY: SimilaritySample}
    return (*_frame_outputs(tuple(given)), *(name for name, kind in asked_by.items() if kind in kinds))


@lru_cache
def _frame_outputs(given: tuple[str, ...]) -> tuple[str, ...]:
    scores = FRAME_SCORES.items()
    return tuple(name for name, score in scores if score.is_always_asked or (name in given and not score.is_per_bin))


def encode_results(results: Sequence[Result], num_positions: int, outputs: Collection[str]) -> Tensors:
    """Return the requested outputs, float32 [B, ...]; P = ``num_positions``. A missing score is NaN, never 0."""
    return {name: _encoded(name, results, num_positions) for name in outputs}


def decode_results(
    tensors: Mapping[str, npt.NDArray[Any]], samples: Sequence[Sample], model_version: str | None = None
) -> list[Result]:
    """Return results for the samples in one request, which ``model_version`` answered.

    Raises InferenceFailedError if the answer lacks a score: a missing reward is not 0 or NaN. Only scores that a
    checkpoint need not predict (success, and progress where remaining seconds are present) may be NaN, at all frames.
    Progress and ``hop`` may be NaN at the same frames, for which the model gave no answer.
    """
    return [_decode_result(tensors, row, sample, model_version) for row, sample in enumerate(samples)]


def decode_progress(
    tensors: Mapping[str, npt.NDArray[Any]], row: int, num_frames: int, model_version: str | None = None
) -> ProgressResult:
    """Return the result for the progress sample in ``row``, with ``num_frames``. Raises InferenceFailedError."""
    scores = _scores_between(tensors, row, slice(0, num_frames))
    return ProgressResult(**scores, timing=_timing(tensors, row), model_version=model_version)


def _encoded(name: str, results: Sequence[Result], num_positions: int) -> Float32Array:
    if name in FRAME_SCORES:
        trajectories = [trajectory_scores(result).values() for result in results]
        rows = [[np.asarray(getattr(each, name), np.float32) for each in of_result] for of_result in trajectories]
        return pad_stack(rows, num_positions, fill=np.nan)
    if name in PAIR_SCORES:
        return np.array([[getattr(result, name, np.nan)] for result in results], np.float32)
    if name == TIMING_MS:
        timings = [result.timing or BatchTiming(np.nan, np.nan) for result in results]
        return np.array([[timing.collate_ms, timing.forward_ms] for timing in timings], np.float32)
    raise KeyError(name)


def _decode_result(
    tensors: Mapping[str, npt.NDArray[Any]], row: int, sample: Sample, model_version: str | None
) -> Result:
    num_first, *num_second = (trajectory.num_frames for trajectory in sample.trajectories)
    if isinstance(sample, ProgressSample):
        return decode_progress(tensors, row, num_first, model_version)
    first = FrameScores(**_scores_between(tensors, row, slice(0, num_first)))
    second = FrameScores(**_scores_between(tensors, row, slice(num_first, num_first + sum(num_second))))
    of_request: dict[str, Any] = {"timing": _timing(tensors, row), "model_version": model_version}
    if isinstance(sample, PreferenceSample):
        preference = float(_present(tensors, PREFERENCE, row, slice(0, 1))[0])
        return PreferenceResult(preference=preference, first=first, second=second, **of_request)
    similarity = float(_present(tensors, SIMILARITY, row, slice(0, 1))[0])
    return SimilarityResult(similarity=similarity, reference=first, other=second, **of_request)


def _timing(tensors: Mapping[str, npt.NDArray[Any]], row: int) -> BatchTiming | None:
    return BatchTiming(*tensors[TIMING_MS][row].tolist()) if TIMING_MS in tensors else None


def _scores_between(tensors: Mapping[str, npt.NDArray[Any]], row: int, positions: slice) -> dict[str, Any]:
    """Return the fields of a FrameScores. Raises InferenceFailedError."""
    skipping = next((name for name, score in FRAME_SCORES.items() if score.skips_frames and name in tensors), None)
    given: dict[str, Any] = {
        name: _present(
            tensors,
            name,
            row,
            positions,
            may_lack=score.may_be_unknown or score.replaced_by in tensors,
            answered_as=skipping if name in ("progress", skipping) else None,
        )
        for name, score in FRAME_SCORES.items()
        if name in tensors or score.is_always_asked
    }
    return {name: part > 0 if FRAME_SCORES[name].mark else part for name, part in given.items()}


def _present(
    tensors: Mapping[str, npt.NDArray[Any]],
    name: str,
    row: int,
    positions: slice,
    *,
    may_lack: bool = False,
    answered_as: str | None = None,
) -> Float32Array:
    """Return one row's scores at some positions. Raises InferenceFailedError unless all are present and finite.

    may_lack: True: all may be NaN, if the checkpoint does not predict them
    answered_as: score that is NaN at the same frames, for which the model gives no answer; the last frame always has an
        answer
    """
    scores, count = tensors[name], positions.stop - positions.start
    if scores.ndim < 2 or row >= len(scores):
        raise InferenceFailedError(f"{name}: expected scores of sample {row}, got an array {list(scores.shape)}")
    part: Float32Array = scores[row, positions]
    is_good = bool(np.isfinite(part).all()) or (may_lack and bool(np.isnan(part).all()))
    if answered_as is not None and len(part) == count and np.isfinite(part[-1]):
        is_good = np.array_equal(np.isfinite(part), ~np.isnan(tensors[answered_as][row, positions]))
    if len(part) != count or not is_good:
        raise InferenceFailedError(f"{name}: expected {count} finite scores, got {part.tolist()}")
    return part
