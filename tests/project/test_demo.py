# SPDX-License-Identifier: MIT
"""The demo's checkpoint, ``rfm try``, and the training. CI runs ``make demo`` itself."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

import clip
import rfm_export
from commands import nothing_left_behind
from in_process import rfm
from paths import ROOT
from rfm import published
from rfm.config import ExportConfig
from rfm.engine import Engine, Outcome
from rfm_client import PreferenceSample, ProgressResult, ProgressSample, Sample, Trajectory
from rfm_client.contract.description import TOY
from toy_world import TASKS, make_clip

REPOSITORY = ROOT / "model_repository"
PNG = b"\x89PNG"


def example(name: str, *arguments: object) -> str:
    """Return the output of a script in examples/."""
    command = [sys.executable, str(ROOT / "examples" / name), *map(str, arguments)]
    environment = {**os.environ, "COLUMNS": "160"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.triton
@pytest.mark.nightly
def test_a_policy_is_paid_by_the_served_checkpoint(tmp_path: Path) -> None:
    """Two short rounds; learning the task takes ten whole ones and minutes."""
    few = ("--rounds", 2, "--population", 6, "--scenes", 1, "--tests", 3, "--log", tmp_path / "triton.log")
    with nothing_left_behind():
        shown = example("train_policy.py", *few).splitlines()
    assert [line.split(":")[0] for line in shown] == ["round  1", "round  2", "success of untrained policies"]
    paid = [float(re.findall(r"reward ([\d.]+)", line)[0]) for line in shown[:2]]
    assert all(0 < reward < 1 for reward in paid)


def test_the_demo_s_checkpoint_separates_right_from_wrong_on_unseen_clips() -> None:
    """A part of the model card's figures, with the scores that the server's are compared with elsewhere."""
    encoders = {
        f"{kind}_encoder": str(REPOSITORY / "rfm_encoder" / "1" / f"{kind}_encoder") for kind in ("image", "text")
    }
    loaded = published.read(str(REPOSITORY / "rfm" / "1" / "checkpoint"), **encoders)
    engine = Engine.of(loaded.checkpoint, encoders=loaded.encoders())
    samples: list[Sample] = []
    for seed in range(3_000_000, 3_000_012, 4):
        task, other = TASKS[seed // 4 % len(TASKS)], TASKS[(seed // 4 + 1) % len(TASKS)]
        clips = (make_clip("success", task, seed), make_clip("dropped", task, seed + 1))
        good, bad, wrong = (
            Trajectory(frames=shown.frames, task=task.sentence())
            for shown in (*clips, make_clip("success", task, seed + 2, shown=other))
        )
        samples += [ProgressSample(good), ProgressSample(wrong), PreferenceSample(good, bad)]
    results = [_scored(outcome) for outcome in engine.evaluate(samples)]
    right, wrong_sentence, preferred = (results[kind::3] for kind in range(3))
    assert min(right) > 0.9
    assert max(wrong_sentence) < 0.2
    assert min(preferred) > 0.5


def _scored(outcome: Outcome) -> float:
    assert not isinstance(outcome, Exception), outcome
    return outcome.last_progress if isinstance(outcome, ProgressResult) else outcome.preference  # type: ignore[union-attr]


@pytest.mark.nightly
@pytest.mark.triton
def test_a_checkpoint_of_one_s_own_scores_a_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    clip.write(tmp_path / "clip.mp4")
    encoders = REPOSITORY / "rfm_encoder" / "1"
    checkpoint = REPOSITORY / "rfm" / "1" / "checkpoint"
    options = {
        "--task": clip.TASK,
        "--fps": 10,
        "--output": tmp_path,
        "--checkpoint": checkpoint,
        "--image-encoder": encoders / "image_encoder",
        "--text-encoder": encoders / "text_encoder",
    }
    with nothing_left_behind():
        result = rfm("try", tmp_path / "clip.mp4", *(word for pair in options.items() for word in pair))
    assert result.exit_code == 0, result.output
    public = f"rfm try {tmp_path / 'clip.mp4'} --task '{clip.TASK}' --checkpoint robometer/Robometer-4B\n"
    served = f"rfm serve {checkpoint} --image-encoder {encoders / 'image_encoder'} --text-encoder "
    for shown in (TOY, clip.TASK, "clip.mp4", "32 frames", public, served, "text_encoder --gateway-port 8100\n"):
        assert shown in result.output
    assert (tmp_path / "clip.1.checkpoint.png").read_bytes().startswith(PNG)


@pytest.mark.nightly
def test_training_is_reproducible_and_its_result_is_served_as_any_checkpoint(tmp_path: Path) -> None:
    steps = ("--encoder-steps", 2, "--frozen-steps", 1, "--joint-steps", 1, "--groups", 1)
    for name in ("first", "second"):
        example("train_demo_checkpoint.py", tmp_path / name, *steps)
    weights = [load_file(tmp_path / name / "checkpoint" / "model.safetensors") for name in ("first", "second")]
    assert weights[0].keys() == weights[1].keys()
    for name, array in weights[0].items():
        np.testing.assert_array_equal(array, weights[1][name], err_msg=name)
    written = tmp_path / "first"
    config = ExportConfig(image_encoder=str(written / "image_encoder"), text_encoder=str(written / "text_encoder"))
    assert rfm_export.export(str(written / "checkpoint"), tmp_path / "model_repository", config) == 1  # verified there
    assert json.loads((written / "training.json").read_text())["steps"] == {"encoder": 2, "frozen": 1, "joint": 1}


def test_the_committed_repository_is_small() -> None:
    files = [file for file in REPOSITORY.rglob("*") if file.is_file()]
    assert sum(file.stat().st_size for file in files) <= 3e6
