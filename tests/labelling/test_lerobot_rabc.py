# SPDX-License-Identifier: MIT
"""The tables of LeRobot's ``compute_rabc_weights``, which reward-aligned behaviour cloning reads, made by ``rfm label``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet
from typer.testing import CliRunner

from goldens import HAS_AVX512
from reward_models import BASE, ROOT
from rfm_commands.cli import app

FOLDER = ROOT / "lerobot_rabc"
EXPECTED = json.loads((FOLDER / "expected.json").read_text())
RUNS = [run for run in EXPECTED["runs"] if "robometer" in run["what"]]


@pytest.mark.parametrize("run", RUNS, ids=lambda run: run["file"])
def test_robometer_s_table_is_that_of_lerobot(tmp_path: Path, run: dict[str, Any]) -> None:
    arguments = run["arguments"]
    words = ["label", FOLDER / EXPECTED["dataset"], "--output", tmp_path, "--alias", "robometer_progress"]
    words += ["--checkpoint", FOLDER / run["checkpoint"], "--base-model", BASE, "--dtype", "bfloat16"]
    words += ["--sampling", "linspace_round", "--frames", arguments.get("num_subsampled_frames", 4)]
    if "episodes" in arguments:
        words += ["--episodes", ",".join(map(str, arguments["episodes"]))]
    done = CliRunner().invoke(app, [*map(str, words), "--no-picture"])
    assert done.exit_code == 0, done.output
    table = parquet.read_table(tmp_path / "robometer_progress.parquet")
    for name in ("index", "episode_index", "frame_index"):
        assert table[name].to_pylist() == run["rows"][name]
        assert str(table.schema.field(name).type) == run["columns"][name]
    assert str(table.schema.field("progress_sparse").type) == run["columns"]["progress_sparse"]
    expected = np.array(run["rows"]["progress_sparse"])
    atol = 1e-5 if HAS_AVX512 else 0.05  # other processors round bfloat16 sums elsewhere
    np.testing.assert_allclose(table["progress_sparse"].to_numpy(), expected, rtol=0, atol=atol)
