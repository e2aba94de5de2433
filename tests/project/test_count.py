# SPDX-License-Identifier: MIT
"""A pass of a model of a published size launches no more kernels than it did."""

from __future__ import annotations

import pytest

from paths import ROOT

# Of a Robometer with 4 billion parameters, for a sample of 8 frames of 224x224; each layer more is 28 to 31.
MOST_KERNELS = 1_570
TOKENS, LEAST_TFLOP = 583, 5.3


def test_a_pass_of_robometer_4b_launches_few_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import count

    row = count.counted(count.ROBOMETER, 1, 8, count.SMALL_PX)
    assert (row["tokens"], row["passes"]) == (TOKENS, 1)
    assert row["kernels"] <= MOST_KERNELS
    assert float(row["TFLOP"]) > LEAST_TFLOP  # the whole network was counted
