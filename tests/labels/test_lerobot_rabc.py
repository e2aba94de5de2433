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
from labelling import FEW, LEROBOT, BrightnessScorer, Notes
from reward_models import BASE, ROOT
from rfm_client import ProgressResult, ProgressSample
from rfm_labels import LabelOptions, label, open_dataset, read_episode_labels

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
    done = rfm(*words)
    assert done.exit_code == 0, done.output
    table = parquet.read_table(file)
    for name in ("index", "episode_index", "frame_index"):
        assert table[name].to_pylist() == run["rows"][name]
        assert str(table.schema.field(name).type) == run["columns"][name]
    assert str(table.schema.field("progress_sparse").type) == run["columns"]["progress_sparse"]
    expected = np.array(run["rows"]["progress_sparse"])
    np.testing.assert_allclose(table["progress_sparse"].to_numpy(), expected, rtol=0, atol=atol)


INTERVAL, CHUNK = 8, 50


class Comparing(BrightnessScorer):
    """Compares every eighth frame and the last with the one before, as Robo-Dopamine. Progress rises, then falls."""

    def _result(self, sample: ProgressSample) -> ProgressResult:
        frames = np.arange(sample.trajectory.num_frames)
        is_answered = (frames > 0) & ((frames % INTERVAL == 0) | (frames == frames[-1]))
        rising_then_falling = np.minimum(frames, 50 - frames) / 25
        progress = np.where(is_answered, rising_then_falling, np.nan).astype(np.float32)
        return ProgressResult(progress=progress, success=np.full_like(progress, np.nan), hop=progress)


def test_frames_that_the_model_skipped_are_filled_for_lerobot_s_weights_alone(output: Path) -> None:
    options, notes = {**FEW, "frames": None, "mode": "whole", "limit": 2}, Notes()
    dataset = open_dataset(LEROBOT / "toy_v30_many")
    report = label(dataset, Comparing(max_frames=None), LabelOptions(output=output, **options), notes)
    table, signals = map(parquet.read_table, report.files)
    assert table.schema.metadata[b"rfm.progress_sparse_fill"] == b"linear"
    own, filled = table["progress"].to_numpy(), table["progress_sparse"].to_numpy()
    np.testing.assert_array_equal(own, signals["reward.rfm.progress"].to_numpy())
    np.testing.assert_array_equal(np.isfinite(own), signals["reward.rfm.is_inference_frame"].to_numpy())
    begin, num_weighted, was_weighted = 0, 0, 0
    for episode in dataset.episodes[:2]:
        frames, end = np.arange(episode.num_frames), begin + episode.num_frames
        known = np.union1d(frames[::INTERVAL], frames[-1:])  # the first is 0, from which the model measures
        expected = np.interp(frames, known, np.minimum(known, 50 - known) / 25)
        np.testing.assert_allclose(filled[begin:end], expected, rtol=0, atol=1e-6)
        later = np.minimum(frames + CHUNK, frames[-1])  # of LeRobot 0.6.1's RABCWeights; NaN: the weight is 1
        num_weighted += np.isfinite(filled[begin:end][later] - filled[begin:end]).sum()
        was_weighted += np.isfinite(own[begin:end][later] - own[begin:end]).sum()
        shown = read_episode_labels(report.files[0], episode.index)
        assert shown is not None
        np.testing.assert_array_equal(shown.fused.progress, own[begin:end])
        np.testing.assert_array_equal(shown.is_answered, np.isfinite(own[begin:end]))
        begin = end
    assert (num_weighted, was_weighted) == (begin, 13)
    (told,) = [line for line in notes.lines if line.startswith("progress_sparse: filled at the ")]
    assert told.startswith(f"progress_sparse: filled at the {np.isnan(own).sum()} of {begin} frames that the model")
