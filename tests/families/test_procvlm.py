# SPDX-License-Identifier: MIT
"""ProcVLM: the prompt, the frames and the answers of its public description. No numbers of the original code exist."""

from __future__ import annotations

import numpy as np
import pytest

from rfm import families
from rfm.engine import Engine, Execution
from rfm.procvlm.model import UNVERIFIED, parsed
from rfm.vlm.written import WrittenAnswer
from rfm_client import InvalidSampleError, ProgressSample, Trajectory
from robodopamine import CHECKPOINT

FRAMES = np.random.default_rng(0).integers(0, 256, (10, 48, 64, 3), np.uint8)
ANSWERS = {
    "Therefore, progress is <progress>84%</progress>.": 0.84,
    "<progress> 84.13 % </progress>": np.float64(84.13) / 100,
    "<PROGRESS>12</PROGRESS> <progress>50%</progress>": 0.12,
    "<progress>-3%</progress>": 0.0,
    "<progress>140%</progress>": 1.0,
    "<progress>done</progress>": None,
    "84%": None,
    "": None,
}


@pytest.fixture(scope="module")
def engine() -> Engine:
    """A tiny Qwen3-VL that was trained to write other answers."""
    return Engine.of(families.load(CHECKPOINT, reward_model="procvlm"))


@pytest.mark.parametrize(("answer", "progress"), ANSWERS.items(), ids=repr)
def test_progress_is_read_between_its_tags(answer: str, progress: float | None) -> None:
    assert parsed(answer) == progress


def test_each_frame_is_shown_with_the_seven_before_it(engine: Engine) -> None:
    rows = engine.predictor.rows(ProgressSample(Trajectory(frames=FRAMES, task="fold the towel")))
    shown = [[index for _, index in row.images] for row in rows]
    assert shown[0] == [0] * 8
    assert shown[3] == [0, 0, 0, 0, 0, 1, 2, 3]
    assert shown[9] == [2, 3, 4, 5, 6, 7, 8, 9]
    text = engine.predictor.collator.tokenizer.decode(rows[0].input_ids)
    assert text.startswith("<|im_start|>user\n" + "<|vision_start|>")
    assert 'the task "fold the towel", first infer the remaining atomic actions' in text
    assert text.endswith("<|im_start|>assistant\n")


def test_the_progress_of_each_frame_is_that_of_its_answer(engine: Engine) -> None:
    predictor, sample = engine.predictor, ProgressSample(Trajectory(frames=FRAMES[:2], task="fold the towel"))
    texts = ["<progress>10%</progress>", "<progress>35%</progress>"]
    rows = zip(texts, predictor.rows(sample), strict=True)
    read = [predictor.read(text, WrittenAnswer(), row, Execution()) for text, row in rows]
    np.testing.assert_allclose(predictor.joined(sample, read).progress, [0.1, 0.35])


def test_an_answer_without_progress_is_an_error(engine: Engine) -> None:
    (result,) = engine.evaluate([ProgressSample(Trajectory(frames=FRAMES[:1], task="fold the towel"))])
    assert isinstance(result, InvalidSampleError)
    assert str(result).startswith("answer: expected progress in percent, as <progress>84%</progress>")


def test_dense_mode_is_refused(engine: Engine) -> None:
    (result,) = engine.evaluate([ProgressSample(Trajectory(frames=FRAMES, task="fold the towel"), 4)])
    assert isinstance(result, InvalidSampleError)
    assert str(result).startswith("frame_steps: expected 0 (ProcVLM scores each frame")


def test_every_export_says_that_the_scores_are_unverified() -> None:
    checkpoint = families.load(CHECKPOINT, reward_model="procvlm")
    assert UNVERIFIED in checkpoint.notes
    assert checkpoint.description.kind == "ProcVLM (unverified)"
