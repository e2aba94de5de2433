# SPDX-License-Identifier: MIT
"""Robo-Dopamine: the original code's prompts, pixels, answers and progress."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rfm import published
from rfm.engine import Engine, Execution
from rfm.families.robodopamine.prompts import fused, hops, parsed, sampled_frames
from rfm_client import InvalidSampleError, ProgressResult, ProgressSample, Trajectory
from robodopamine import ANSWERED, CHECKPOINT, FOLDER, READABLE, Case, case_named

UNREADABLE_SCORE = 0.0  # the original's, in place of an error


@pytest.mark.reference
@pytest.mark.parametrize(
    "case", json.loads((FOLDER / "parse_cases.json").read_text()), ids=lambda case: repr(case["text"])
)
def test_a_score_is_read_as_the_original_reads_it(case: dict[str, Any]) -> None:
    score = parsed(str(case["text"]))
    if score is None:
        assert case["score"] == UNREADABLE_SCORE or case["text"] == "<score>nan</score>"
    else:
        assert score == case["score"]


@pytest.mark.parametrize(
    "answer",
    ["", "no score", "<score></score>", "<score>%</score>", "<score>nan</score>", "<score>+ 37%</score>", "50% <score>",
     "<SCORE>5%</SCORE>", "</score>7%<score>", "<score>0x10</score>"],
)  # fmt: skip
def test_an_answer_without_a_score_is_not_zero(answer: str) -> None:
    assert parsed(answer) is None


@pytest.mark.parametrize("answer", ["<score>0%</score>", "<score>-0%</score>", "0"])
def test_zero_is_a_score(answer: str) -> None:
    assert parsed(answer) == 0


@pytest.mark.reference
@pytest.mark.parametrize("case", json.loads((FOLDER / "fusion_cases.json").read_text()))
def test_progress_is_made_of_scores_as_in_the_original(case: dict[str, Any]) -> None:
    scores, mode = [percent / 100 for percent in case["percent"]], case["eval_mode"]
    assert fused(scores, mode) == case["progress"]
    assert hops(scores, mode) == case["hop"]


@pytest.mark.reference
@pytest.mark.parametrize("case", json.loads((FOLDER / "fusion_cases_benchmark.json").read_text()))
def test_the_rule_of_the_benchmark_keeps_progress_within_0_and_1(case: dict[str, Any]) -> None:
    """``inverse`` begins at 1 with the last answer: what is left is made of the negative scores. Answers without a score
    are errors here, and change nothing there."""
    scores = [score for text in case["texts"] if (score := parsed(text)) is not None]
    expected = [progress for progress in case["progress"] if progress != "Error"]
    assert scores == [hop for hop in case["hop"] if hop is not None] == hops(scores, "benchmark")
    if case["inverse"]:
        left = fused([-score for score in reversed(scores)], "benchmark")
        np.testing.assert_allclose([1 - each for each in reversed(left)], expected, rtol=0, atol=1e-12)
    else:
        assert fused(scores, "benchmark") == expected


def test_progress_is_not_clipped() -> None:
    assert fused([-0.5], "forward") == [-0.5]
    assert fused([0.5], "backward") == [1.5]
    assert math.isclose(fused([-0.5, 0.5], "incremental")[-1], 0.25)


@pytest.mark.reference
@pytest.mark.parametrize("case", json.loads((FOLDER / "sampling_cases.json").read_text()))
def test_frames_are_sampled_by_the_interval_and_the_last_always(case: dict[str, Any]) -> None:
    if case["frames"]:
        np.testing.assert_array_equal(sampled_frames(case["frames"], case["frame_interval"]), case["indices"])


@pytest.mark.reference
@pytest.mark.parametrize("case", ANSWERED, ids=str)
def test_tokens_and_pixels_are_those_of_the_original_code(case: Case) -> None:
    predictor = case.engine().predictor
    rows = predictor.rows(case.sample)
    calls, arrays = case.content["calls"], case.arrays
    assert len(rows) == len(calls)
    for index, (row, call) in enumerate(zip(rows, calls, strict=True)):
        expected = arrays.get(f"call_{index}.input_ids", arrays["call_0.input_ids"])[0]
        np.testing.assert_array_equal(row.input_ids, expected)
        grids = [predictor.collator.grid(video) for video, _ in row.images]
        assert call["image_grid_thw"] == [[1, grid.rows, grid.columns] for grid in grids]
        check_pixels(predictor, row, call["pixels"])


def check_pixels(predictor: Any, row: Any, told: dict[str, Any]) -> None:
    """Each image's pixels in the prompt's order, as the processor stacks them."""
    predictor.work_ahead([row])
    images = predictor.collator.images
    parts = [
        images.patches(predictor.collator.images.images_to_size(video.stack([at])), None) for video, at in row.images
    ]
    pixels = torch.cat(parts).double()
    assert list(pixels.shape) == told["shape"]
    assert float(pixels.abs().sum()) == pytest.approx(told["abs_sum"], rel=1e-6)
    assert float(pixels.sum()) == pytest.approx(told["sum"], rel=1e-5, abs=1e-2)
    np.testing.assert_allclose(pixels[0, :8], told["first_row_head"], rtol=0, atol=1e-6)


@pytest.mark.reference
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
@pytest.mark.parametrize("case", ANSWERED, ids=str)
def test_answers_are_those_of_the_original_code(case: Case, dtype: torch.dtype) -> None:
    predictor = case.engine(dtype).predictor
    rows = predictor.rows(case.sample)
    answers, _ = predictor.write(rows, predictor.collate(rows), Execution())
    texts = [predictor.collator.tokenizer.decode(answer.tokens, skip_special_tokens=True) for answer in answers]
    assert texts == [call["text"] for call in case.content["calls"]]


@pytest.mark.reference
@pytest.mark.parametrize("case", READABLE, ids=str)
def test_progress_is_that_of_the_original_code(case: Case) -> None:
    (result,) = case.engine().evaluate([case.sample])
    assert isinstance(result, ProgressResult), result
    after = sampled_frames(len(result.progress), case.request["frame_interval"])[1:]
    assert np.flatnonzero(result.is_answered).tolist() == after.tolist()
    assert np.isnan(result.progress[~result.is_answered]).all()
    if case.is_baseline:  # clips, begins with 0, and does not spread the values over the frames
        expected = case.content["progress"][1 : len(after) + 1]
        np.testing.assert_allclose(result.progress[after].clip(0, 1), expected, rtol=0, atol=1e-6)
        return
    steps = case.content["results"]
    np.testing.assert_allclose(result.progress[after], [step["progress"] for step in steps], rtol=0, atol=1e-6)
    np.testing.assert_allclose(result.hop[after], [step["hop"] for step in steps], rtol=0, atol=1e-6)


def test_an_answer_without_a_score_is_an_error_and_counted() -> None:
    case, execution = case_named("incremental_T4_one_view"), Execution()
    (result,) = case.engine().evaluate([case.sample], execution)
    assert isinstance(result, InvalidSampleError)
    expected = "answer: expected a score in percent, as <score>+37%</score>, in the model's answer, got 'no score'"
    assert str(result) == expected
    assert execution.num_unreadable == 1


def test_a_batch_gives_the_scores_of_each_sample_alone() -> None:
    engine = case_named("forward_T5").engine()
    samples = [case_named(name).sample for name in ("forward_T5", "forward_T4_odd_size", "baseline_T3_forward")]
    together = engine.evaluate(samples)
    for sample, result in zip(samples, together, strict=True):
        (alone,) = engine.evaluate([sample])
        assert isinstance(alone, ProgressResult)
        assert isinstance(result, ProgressResult)
        np.testing.assert_array_equal(result.progress, alone.progress)


def test_the_mean_is_that_of_the_three_modes() -> None:
    checkpoint, sample = CHECKPOINT, case_named("forward_T5").sample
    results = {}
    for mode in ("incremental", "forward", "backward", "mean"):
        (results[mode],) = Engine.of(published.load(checkpoint, reward_model=f"robodopamine,mode={mode}")).evaluate(
            [sample]
        )
        assert isinstance(results[mode], ProgressResult), results[mode]
    three = [results[mode].progress for mode in ("incremental", "forward", "backward")]
    np.testing.assert_allclose(results["mean"].progress, np.mean(three, axis=0), rtol=0, atol=1e-6)


def test_a_missing_wrist_is_replaced_by_the_front_camera() -> None:
    case = case_named("forward_T5")
    front = case.sample.trajectory.frames
    assert front is not None
    one = Trajectory(frames=front, task="organize the table")
    three = Trajectory(frames=front, task="organize the table", views=(front, front))
    results = case.engine().evaluate([ProgressSample(one), ProgressSample(three)])
    np.testing.assert_array_equal(results[0].progress, results[1].progress)


FRONT = np.zeros((3, 32, 32, 3), np.uint8)


@pytest.mark.parametrize("name", ["Robo-Dopamine-GRM-3B", "models--tanhuajie2001--Robo-Dopamine-GRM-2.0-4B-Preview"])
def test_a_published_folder_is_known_by_its_name(name: str, tmp_path: Path) -> None:
    shutil.copytree(FOLDER / "grm_qwen25vl_bf16_tied" / "checkpoint", tmp_path / name)
    checkpoint = published.load(tmp_path / name)
    assert checkpoint.description.kind == "Robo-Dopamine, incremental"


def test_an_export_gives_the_same_scores_and_takes_another_mode(tmp_path: Path) -> None:
    case = case_named("forward_T5")
    published.load(case.config / "checkpoint", reward_model=case.said).save(tmp_path / "saved")
    (before,), (after,) = (
        engine.evaluate([case.sample]) for engine in (case.engine(), Engine.of(published.load(tmp_path / "saved")))
    )
    np.testing.assert_array_equal(before.progress, after.progress)
    changed = published.load(tmp_path / "saved", reward_model="robodopamine,mode=mean")
    assert changed.config.mode == "mean"


def test_cached_features_give_the_same_scores() -> None:
    case, execution = case_named("backward_T5"), Execution()
    checkpoint = published.load(CHECKPOINT, reward_model=case.said)
    cached = Engine.of(checkpoint, feature_cache_mib=64)
    (expected,), (first,) = case.engine().evaluate([case.sample]), cached.evaluate([case.sample])
    (again,) = cached.evaluate([case.sample], execution)
    assert isinstance(expected, ProgressResult), expected
    for result in (first, again):
        np.testing.assert_array_equal(result.progress, expected.progress)
    assert execution.num_encoded == 0
    assert execution.num_found > 0
