# SPDX-License-Identifier: MIT
"""TOPReward: the numbers of LeRobot's code and Robometer's baseline, and refusals."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from engines import asked_engine
from reward_models import ROOT, Reference, references
from rfm import published
from rfm.engine import Engine
from rfm.published import CheckpointError
from rfm_client import (
    ProgressResult,
    ProgressSample,
    Trajectory,
)
from vlm import video

FOLDER = ROOT / "topreward"
CHECKPOINT = FOLDER / "checkpoints" / "vlm_fp32_untied"
OF_LEROBOT = FOLDER / "lerobot_plain" / "lerobot"
RAW, ANSWERS, ROUNDED = 1e-4, 2e-5, 0.3  # of log-probabilities, progress, and log-probabilities in bfloat16
CLIP = ProgressSample(video(0, 5, 64, 96))


def is_comparable(case: Reference) -> bool:
    """False where Robometer's code takes floats in 0..1 for grey levels, and sees black frames."""
    return not (case.summary["engine"] == "robometer" and case.file.stem.startswith("f01"))


CASES = [case for case in references("topreward") if is_comparable(case)]


def engine_of(case: Reference, num_prefixes: int | None) -> Engine:
    summary = case.summary
    name = "topreward" if summary["engine"] == "lerobot" else "topreward-robometer"
    settings = {"chat_template": str(summary["add_chat_template"]).lower()}
    settings |= {"fps": summary["fps"]} if "fps" in summary else {}
    settings |= {} if num_prefixes is None else {"num_prefixes": num_prefixes}
    said = ",".join([name, *(f"{key}={value}" for key, value in settings.items())])
    dtype = torch.bfloat16 if summary["vlm_dtype"] == "torch.bfloat16" else None
    return asked_engine((case.config / summary["checkpoint"]).resolve(), said, dtype)


def check(result: Any, expected: dict[str, Any], curve: list[float], *, is_rounded: bool) -> None:
    assert isinstance(result, ProgressResult), result
    assert result.log_prob is not None
    ends = np.array(expected["prefix_lengths"]) - 1
    log_probs = np.array(expected["log_prob_true"])
    np.testing.assert_allclose(result.log_prob[ends], log_probs, rtol=0, atol=ROUNDED if is_rounded else RAW)
    if not is_rounded:
        atol = max(ANSWERS, RAW / max(float(np.ptp(log_probs)), RAW))
        np.testing.assert_allclose(result.progress, curve, rtol=0, atol=atol)
    assert np.isnan(result.success).all()


@pytest.mark.reference
@pytest.mark.parametrize("case", CASES, ids=str)
def test_scores_are_those_of_the_original_code(case: Reference) -> None:
    content, is_rounded = case.content, case.summary["vlm_dtype"] == "torch.bfloat16"
    if case.summary["engine"] == "lerobot":
        for num_prefixes in (None, 15, 5):
            results = engine_of(case, num_prefixes).evaluate(case.samples())
            for result, expected in zip(results, content["prefixes"], strict=True):
                told = expected["all" if num_prefixes is None else str(num_prefixes)]
                check(result, told, told["curve"], is_rounded=is_rounded)
        last = engine_of(case, None).evaluate(case.samples(case.summary["max_frames"]))
        for result, reward in zip(last, content["reward"], strict=True):
            assert isinstance(result, ProgressResult)
            assert result.log_prob is not None
            assert result.log_prob[-1] == pytest.approx(reward, abs=ROUNDED if is_rounded else RAW)
        return
    most = case.summary["max_frames"]
    samples = [shortened(sample, most) for sample in case.samples()]
    results = engine_of(case, case.summary["num_prefix_samples"]).evaluate(samples)
    for result, expected in zip(results, content["samples"], strict=True):
        check(result, expected, expected["progress"], is_rounded=is_rounded)


def shortened(sample: ProgressSample, most: int) -> ProgressSample:
    """Return the sample with the frames that Robometer's baseline picks."""
    frames = sample.trajectory.positions
    if len(frames) > most:
        frames = frames[np.linspace(0, len(frames) - 1, most, dtype=int)]
    return ProgressSample(Trajectory(frames=frames, task=sample.trajectory.task))


@pytest.fixture(scope="module")
def lerobot() -> Engine:
    return asked_engine(CHECKPOINT, "topreward")


def test_a_large_video_is_shrunk_by_the_length_of_the_prefix(lerobot: Engine) -> None:
    most = lerobot.predictor.collator.config.most_px
    side = int((most / 4) ** 0.5) // 32 * 32 + 32  # a pair fits, two pairs do not
    sizes = [lerobot.predictor.collator.images.size(side, side, length) for length in (1, 2, 3, 4)]
    assert sizes[:2] == [(side, side)] * 2
    assert len(set(sizes)) == 3


def test_the_settings_of_lerobot_s_config_json_are_used(tmp_path: Path, lerobot: Engine) -> None:
    (expected,) = lerobot.evaluate([CLIP])
    by_file = Engine.of(published.load(str(OF_LEROBOT), base_model=str(CHECKPOINT)))
    changed = shutil.copytree(OF_LEROBOT, tmp_path / "changed")
    content = json.loads((changed / "config.json").read_text()) | {"fps": 4.0}
    (changed / "config.json").write_text(json.dumps(content))
    at_4_fps = Engine.of(published.load(str(changed), base_model=str(CHECKPOINT)))
    assert isinstance(expected, ProgressResult)
    for engine, is_equal in ((by_file, True), (at_4_fps, False)):
        (result,) = engine.evaluate([CLIP])
        assert isinstance(result, ProgressResult)
        assert np.array_equal(result.progress, expected.progress) is is_equal


def test_an_export_keeps_its_reward_model(tmp_path: Path) -> None:
    published.load(CHECKPOINT, reward_model="topreward").save(tmp_path / "saved")
    for said in ("topreward-robometer", "topreward,fps=4", "roboreward"):
        with pytest.raises(
            CheckpointError, match=r"--as: expected none for an export|expected an export of roboreward"
        ):
            published.load(tmp_path / "saved", reward_model=said)
