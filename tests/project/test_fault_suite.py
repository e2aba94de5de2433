# SPDX-License-Identifier: MIT
"""What the fault suite counts as a right answer."""

from __future__ import annotations

import numpy as np
import pytest

from callers import Exam

EXPECTED = np.float32([-90.0, 0.5, 0.0])  # a similarity, and progress of two frames

ANSWERS = {
    "the same": ([0, 0, 0], True),
    "a similarity that is off by its share": ([8e-4, 0, 0], True),
    "a similarity that is off by more": ([1e-3, 0, 0], False),
    "progress that is off by less than the bound": ([0, 9e-6, -9e-6], True),
    "progress that is off by more": ([0, 1.2e-5, 0], False),
    "progress of zero that is off by more": ([0, 0, 1.2e-5], False),
    "no number": ([0, np.nan, 0], False),
}


@pytest.mark.parametrize(("change", "is_right"), ANSWERS.values(), ids=ANSWERS)
def test_an_answer_is_right_within_the_bound_of_the_contract(change: list[float], is_right: bool) -> None:
    exam = Exam([], [EXPECTED])
    assert exam.is_right(0, EXPECTED + np.float32(change)) == is_right


def test_an_answer_of_another_length_is_wrong() -> None:
    assert not Exam([], [EXPECTED]).is_right(0, EXPECTED[:2])
