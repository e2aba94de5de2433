# SPDX-License-Identifier: MIT
"""Models of a published size launch no more kernels, and need no more passes and tokens, than they did."""

from __future__ import annotations

import importlib
from typing import Any

import pytest

from paths import ROOT

# For a Robometer with 4 billion parameters and 8 frames of 224x224; another layer adds 28 to 31.
MOST_KERNELS = 1_570
TOKENS, LEAST_TFLOP = 583, 5.3


@pytest.fixture
def count(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("count")


def test_a_pass_of_robometer_4b_launches_few_kernels(count: Any) -> None:
    row = count.counted(count.ROBOMETER, 1, 8, count.SMALL_PX)
    assert (row["tokens"], row["passes"]) == (TOKENS, 1)
    assert row["kernels"] <= MOST_KERNELS
    assert float(row["TFLOP"]) > LEAST_TFLOP  # the whole network was counted


def test_a_usual_answer_of_roboreward_takes_two_passes(count: Any) -> None:
    assert count.counted(count.ROBOREWARD, 1, 8, count.SMALL_PX)["passes"] == 2
