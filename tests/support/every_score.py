# SPDX-License-Identifier: MIT
"""Scores of frames with every array that ``FrameScores`` has."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client import FRAME_SCORES, FrameScores

NUM_BINS = 4


def every_score(seed: int, num_frames: int) -> FrameScores:
    """Return random scores; no two frames are equal in an array of numbers."""
    random = np.random.default_rng(seed)
    arrays: dict[str, npt.NDArray[Any]] = {}
    for name, score in FRAME_SCORES.items():
        shape = (num_frames, NUM_BINS) if score.is_per_bin else (num_frames,)
        numbers = random.random(shape, np.float32)
        arrays[name] = numbers > 0.5 if score.mark else numbers
    return FrameScores(**arrays)


def assert_same_scores(got: FrameScores, wanted: FrameScores) -> None:
    assert got.arrays.keys() == wanted.arrays.keys()
    for name, array in wanted.arrays.items():
        assert got.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(got.arrays[name], array, err_msg=name)
