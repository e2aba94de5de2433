# SPDX-License-Identifier: MIT
from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from paths import ROOT


@pytest.mark.nightly
@pytest.mark.triton
def test_make_gpu_s_program_runs_to_the_end_on_the_cpu_with_tiny_networks(tmp_path: Path) -> None:
    words = [sys.executable, str(ROOT / "benchmarks" / "gpu.py"), "--tiny", "--output", str(tmp_path)]
    subprocess.run(words, check=True)
    assert "not measured" not in (tmp_path / "gpu.md").read_text()
