# SPDX-License-Identifier: MIT
from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from paths import ROOT

sys.path.append(str(ROOT / "benchmarks"))

import gpu
from real_size import FULL


def test_results_of_parts_and_of_another_checkout_stay_and_are_judged(tmp_path: Path) -> None:
    row = {"what": "Robometer", "way": "served", "graphs": False, "frames": 8, "size": "224x224", "repeated": False}
    slow, quick = ({**row, "callers": 32, "samples_per_s": rate} for rate in (60.0, 120.0))
    bare = {**row, "callers": 32, "way": "engine", "samples_per_s": 130.0}
    gpu.Results(tmp_path, gpu.BEFORE, FULL).add(slow)
    gpu.Results(tmp_path, gpu.NOW, FULL).add(slow)
    for measured in (quick, bare):
        gpu.Results(tmp_path, gpu.NOW, FULL).add(measured)
    told = (tmp_path / "gpu.md").read_text()
    assert "| figure | aim | before | now |" in told
    assert "| Robometer, 224x224, 32 callers, samples/s | >= 100 | 60, missed | 120, met |" in told
    assert "| Robometer, 224x224, 32 callers, beside the engine | >= 0.95 | not measured | 0.923, missed |" in told


@pytest.mark.nightly
@pytest.mark.triton
def test_make_gpu_s_program_runs_to_the_end_on_the_cpu_with_tiny_networks(tmp_path: Path) -> None:
    words = [sys.executable, str(ROOT / "benchmarks" / "gpu.py"), "--tiny", "--output", str(tmp_path)]
    subprocess.run(words, check=True)
    assert "not measured" not in (tmp_path / "gpu.md").read_text()
