# SPDX-License-Identifier: MIT
"""``rfm label`` writes the tables of LeRobot's ``compute_rabc_weights`` for reward-aligned behaviour cloning."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

from goldens import AS_REFERENCES
from in_process import rfm
from reward_models import BASE, ROOT

FOLDER = ROOT / "lerobot_rabc"
EXPECTED = json.loads((FOLDER / "expected.json").read_text())
RUNS = [run for run in EXPECTED["runs"] if "robometer" in run["what"]]
TOPREWARD_RUNS = [run for run in EXPECTED["runs"] if "topreward" in run["what"]]


@pytest.mark.parametrize("run", RUNS, ids=lambda run: run["file"])
def test_robometer_s_table_is_that_of_lerobot(tmp_path: Path, run: dict[str, Any]) -> None:
    arguments = run["arguments"]
    words = ["label", FOLDER / EXPECTED["dataset"], "--output", tmp_path, "--alias", "robometer_progress"]
    words += ["--checkpoint", FOLDER / run["checkpoint"], "--base-model", BASE, "--dtype", "bfloat16"]
    words += ["--sampling", "linspace_round", "--frames", arguments.get("num_subsampled_frames", 4)]
    if "episodes" in arguments:
        words += ["--episodes", ",".join(map(str, arguments["episodes"]))]
    atol = 1e-5 if AS_REFERENCES else 0.05  # other processors round bfloat16 sums elsewhere
    check(tmp_path / "robometer_progress.parquet", words, run, atol)


@pytest.mark.parametrize("run", TOPREWARD_RUNS, ids=lambda run: run["file"])
def test_topreward_s_table_is_that_of_lerobot(tmp_path: Path, run: dict[str, Any]) -> None:
    arguments = run["arguments"]
    settings = [f"num_prefixes={arguments['num_samples']}"] if "num_samples" in arguments else []
    settings += [f"fps={arguments['fps']}"] if "fps" in arguments else []
    words = ["label", FOLDER / EXPECTED["dataset"], "--output", tmp_path, "--alias", "topreward_progress"]
    words += ["--checkpoint", FOLDER / run["checkpoint"], "--as", ",".join(["topreward", *settings]), "--mode", "whole"]
    if "episodes" in arguments:
        words += ["--episodes", ",".join(map(str, arguments["episodes"]))]
    check(tmp_path / "topreward_progress.parquet", words, run, 2e-5)
    labels = parquet.read_table(tmp_path / "rfm_progress.parquet")
    assert labels["log_prob"].to_numpy().max() < 0
    assert "success" not in labels.column_names


def check(file: Path, words: list[Any], run: dict[str, Any], atol: float) -> None:
    done = rfm(*words, "--no-picture")
    assert done.exit_code == 0, done.output
    table = parquet.read_table(file)
    for name in ("index", "episode_index", "frame_index"):
        assert table[name].to_pylist() == run["rows"][name]
        assert str(table.schema.field(name).type) == run["columns"][name]
    assert str(table.schema.field("progress_sparse").type) == run["columns"]["progress_sparse"]
    expected = np.array(run["rows"]["progress_sparse"])
    np.testing.assert_allclose(table["progress_sparse"].to_numpy(), expected, rtol=0, atol=atol)
