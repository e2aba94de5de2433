# SPDX-License-Identifier: MIT
"""RoboReward: the original code's answers, batches, and refusals."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from engines import asked_engine
from reward_models import Reference, references
from rfm import published
from rfm.engine import Engine, Execution
from rfm.families.roboreward.checkpoint import RoboRewardPredictor
from rfm.families.roboreward.prompts import as_jpeg, is_unclear, parsed
from rfm.files import CheckpointError
from rfm.qwen.backbone import ROOM
from rfm.qwen.batch import VlmRow
from rfm.qwen.written import WrittenAnswer
from rfm_client import (
    InferenceFailedError,
    InvalidSampleError,
    ProgressResult,
    ProgressSample,
    Trajectory,
)

CASES = references("roboreward")
CONFIGS = sorted({case.config for case in CASES})
CHECKPOINT = CONFIGS[0] / "checkpoint"
EXACT, ROUNDED = 1e-4, 0.3  # of logits: in float32, in bfloat16


def samples_of(case: Reference) -> list[ProgressSample]:
    """The samples; where the original scores steps, each prefix is a sample."""
    samples = case.samples()
    if not case.content["use_frame_steps"]:
        return samples
    return [
        ProgressSample(Trajectory(frames=sample.trajectory.positions[: end + 1], task=sample.trajectory.task))
        for sample in samples
        for end in range(sample.trajectory.num_frames)
    ]


@pytest.mark.reference
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
@pytest.mark.parametrize("case", CASES, ids=str)
def test_answers_are_those_of_the_original_code(case: Reference, dtype: torch.dtype) -> None:
    engine = asked_engine(case.config / "checkpoint", "roboreward", dtype)
    samples = samples_of(case)
    for sample, result, told in zip(samples, engine.evaluate(samples), case.content["generations"], strict=True):
        if told["parsed_score"] is None:
            assert isinstance(result, InvalidSampleError)
            assert repr(told["generated_text"]) in str(result)
            continue
        assert isinstance(result, ProgressResult), result
        expected = np.full(sample.trajectory.num_frames, told["parsed_score"] / 4 - 0.25, np.float32)
        np.testing.assert_array_equal(result.progress, expected)
        assert result.progress_logits is not None
        logits = np.tile(told["digit_logits_at_answer"], (sample.trajectory.num_frames, 1))
        np.testing.assert_allclose(result.progress_logits, logits, rtol=0, atol=ROUNDED)
        assert np.isnan(result.success).all()


@pytest.mark.reference
@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_expected_value_is_that_of_the_digits_behind_answer(case: Reference) -> None:
    engine = asked_engine(case.config / "checkpoint", "roboreward-expected")
    for result, told in zip(engine.evaluate(samples_of(case)), case.content["generations"], strict=True):
        assert isinstance(result, ProgressResult), result
        assert result.progress_logits is not None
        np.testing.assert_allclose(result.progress_logits[0], told["fp32_forced_digit_logits"], rtol=0, atol=EXACT)
        assert result.progress[-1] * 4 + 1 == pytest.approx(told["expected_score_fp32"], abs=1e-4)
        assert result.unclear is None


@pytest.mark.parametrize("shape", [(48, 64, 3), (33, 57, 3)])
def test_jpeg_has_the_pixels_of_the_original_which_optimises_its_tables(shape: tuple[int, ...]) -> None:
    frame, file = np.random.default_rng(0).integers(0, 256, shape, np.uint8), io.BytesIO()
    Image.fromarray(frame).save(file, format="JPEG", quality=85, optimize=True)
    np.testing.assert_array_equal(as_jpeg(frame), np.asarray(Image.open(file)))


@pytest.mark.reference
@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: str(config.name))
def test_a_score_is_read_as_the_original_reads_it(config: Path) -> None:
    for case in json.loads((config / "parse_cases.json").read_text()):
        assert parsed(case["text"]) == case["parsed"], case["text"]


ANSWERS = {  # the score that the original reads, and whether the answer states no single whole score
    "ANSWER: 4": (4, False),
    "answer:5": (5, False),
    "ANSWER:\n2": (2, False),
    "ANSWER: **5**": (5, False),
    "Score: 3.": (3, False),
    "ANSWER: 4. It misses 1 requirement.": (4, False),
    "ANSWER: 4\n1 minor requirement is missing": (4, False),
    "ANSWER: 3 ANSWER: 3": (3, False),
    "ANSWER: 1.5": (1, True),
    "ANSWER: 1,5": (1, True),
    "ANSWER: -2": (2, True),
    "ANSWER: 4-5": (4, True),
    "ANSWER: 4 or 5": (4, True),
    "ANSWER: 4/5": (4, True),
    "ANSWER: 3%": (3, True),
    "ANSWER: 2 ANSWER: 5": (2, True),
    "ANSWER: 2\nANSWER: 5": (2, True),
    "ANSWER: 6 or 3": (3, True),
    "ANSWER: 7\n2": (2, True),
    "score 3/5": (5, True),
    "score 3 of 5": (5, True),
    "1 2 3 4 5": (5, True),
}


@pytest.mark.parametrize(("answer", "score", "unclear"), [(text, *told) for text, told in ANSWERS.items()])
def test_an_answer_without_a_single_whole_score_is_unclear(answer: str, score: int, unclear: bool) -> None:
    assert parsed(answer) == score
    assert is_unclear(answer, score) is unclear


def samples_named(name: str) -> list[ProgressSample]:
    return next(case for case in CASES if case.file.stem == name).samples()


def test_a_tokenizer_without_a_token_for_a_score_is_refused_with_its_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint: Any = published.load(str(CHECKPOINT), reward_model="roboreward")
    monkeypatch.setattr("rfm.families.roboreward.checkpoint.SCORES", (1, 2, 4, 3, 5))
    with pytest.raises(CheckpointError, match=f"^base model {CHECKPOINT}: expected a token for 4, got none"):
        checkpoint.load_collator()


def test_unclear_answers_are_marked_and_counted(engine: Engine) -> None:
    execution = Execution()
    samples = [*samples_named("fallback_digits_T2"), *samples_named("score5_T4")]  # 'Score 2 of 5', 'ANSWER: 5'
    unclear, clear = engine.evaluate(samples, execution)
    assert isinstance(unclear, ProgressResult)
    assert isinstance(clear, ProgressResult)
    assert unclear.last_progress == clear.last_progress == 1.0  # as the original
    assert unclear.unclear is not None
    assert clear.unclear is not None
    assert (unclear.unclear.tolist(), clear.unclear.tolist()) == ([True] * 2, [False] * 4)
    assert execution.num_unclear == 1


def test_dense_mode_marks_the_frames_whose_prefix_has_an_unclear_answer(engine: Engine) -> None:
    trajectory = samples_named("fallback_digits_T2")[0].trajectory
    (dense,) = engine.evaluate([ProgressSample(trajectory, frame_steps=2)])
    assert isinstance(dense, ProgressResult)
    assert dense.unclear is not None
    for end, mark in enumerate(dense.unclear):
        frames = trajectory.positions[[0, end]]
        (alone,) = engine.evaluate([ProgressSample(Trajectory(frames=frames, task=trajectory.task))])
        assert isinstance(alone, ProgressResult)
        assert alone.unclear is not None
        assert alone.unclear[-1] == mark
        assert alone.progress[-1] == dense.progress[end]
    assert dense.unclear[-1]


@pytest.mark.parametrize("is_exported", [False, True], ids=["checkpoint", "export"])
def test_strict_answers_refuse_an_unclear_answer(tmp_path: Path, is_exported: bool) -> None:
    folder, options = CHECKPOINT, {"reward_model": "roboreward", "strict_answers": True}
    if is_exported:
        published.load(CHECKPOINT, **options).save(tmp_path / "saved")  # type: ignore[arg-type]
        folder, options = tmp_path / "saved", {}
    execution = Execution()
    strict = Engine.of(published.load(folder, **options))  # type: ignore[arg-type]
    samples = [*samples_named("fallback_digits_T2"), *samples_named("score5_T4")]
    refused, clear = strict.evaluate(samples, execution)
    assert isinstance(refused, InvalidSampleError)
    expected = "answer: expected one whole score from 1 to 5 (strict_answers of this model), got 'Score 2 of 5'"
    assert str(refused) == expected
    assert isinstance(clear, ProgressResult)
    assert execution.num_unclear == 1


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine.of(published.load(str(CHECKPOINT), reward_model="roboreward"), feature_cache_mib=16)


PASSES = {"score4_T7": 2, "fallback_digits_T2": 8, "lower_T2": 8}  # 'ANSWER: 4', 'Score 2 of 5', 'answer: 3'


@pytest.mark.parametrize("name", PASSES)
def test_a_usual_answer_takes_two_passes_and_every_pass_is_progress_of_the_batch(engine: Engine, name: str) -> None:
    steps: list[int] = []
    engine.evaluate(samples_named(name), Execution(on_forward=lambda: steps.append(1)))
    assert len(steps) == PASSES[name] + 1  # and the batch as a whole


def writer(dtype: torch.dtype = torch.float32, **settings: Any) -> RoboRewardPredictor:
    checkpoint: Any = published.load(CHECKPOINT, reward_model="roboreward")
    changed = replace(checkpoint, config=replace(checkpoint.config, **settings))
    predictor = Engine.of(changed, dtype=dtype).predictor
    assert isinstance(predictor, RoboRewardPredictor)
    return predictor


def written(
    predictor: RoboRewardPredictor, rows: Sequence[VlmRow], draft: Sequence[int]
) -> tuple[list[WrittenAnswer], int]:
    """The answers, and the number of passes."""
    predictor.collator.draft = np.array(draft, np.int64)
    passes: list[int] = []
    batch = predictor.collate(rows)
    assert batch.inputs["input_ids"].shape[1] == max(map(predictor.num_tokens, rows))
    answers, _ = predictor.write(rows, batch, Execution(on_forward=lambda: passes.append(1)))
    return answers, len(passes)


OTHER = 5  # a token that no answer has
# The draft, and the number of accepted tokens, for an answer and the end token.
DRAFTS: dict[str, Callable[[list[int], int], tuple[list[int], int]]] = {
    "beginning": lambda answer, _: (answer[:3], 3),
    "whole answer": lambda answer, _: (answer, len(answer)),
    "half right": lambda answer, _: ([*answer[:2], OTHER, *answer[3:]], 2),
    "wrong": lambda answer, _: ([OTHER] * 4, 0),
    "goes on behind the end": lambda answer, end: ([*answer, end, OTHER, OTHER], len(answer) + 1),
}
SETTINGS: dict[str, dict[str, Any]] = {
    "as published": {},
    "shorter than a draft": {"max_new_tokens": 2},
    "longer than the room for keys and values": {"max_new_tokens": 2 * ROOM + 3, "stops": ()},
}
MIXED = ("T1_single", "fallback_digits_T2", "odd_task_T3")


@pytest.mark.parametrize(
    ("settings", "dtype"),
    [*((each, torch.float32) for each in SETTINGS.values()), (SETTINGS["as published"], torch.bfloat16)],
    ids=[*SETTINGS, "bfloat16"],
)
def test_a_draft_changes_no_answer(settings: dict[str, Any], dtype: torch.dtype) -> None:
    predictor = writer(dtype, **settings)
    rows = [row for name in MIXED for sample in samples_named(name) for row in predictor.rows(sample)]
    plain = [written(predictor, [row], []) for row in rows]
    expected, num_passes = [answer for (answer,), _ in plain], plain[0][1]
    for name, drafted in DRAFTS.items():
        draft, num_right = drafted(expected[0].tokens, CASES[0].summary["eos_token_id"][0])
        alone, num_drafted = written(predictor, rows[:1], draft)
        assert num_drafted == max(1, num_passes - num_right), name
        together, _ = written(predictor, rows, draft)
        for answer, told in zip([*alone, *together], [expected[0], *expected], strict=True):
            assert answer.tokens == told.tokens, name
            assert answer.is_finite
            assert (answer.digit_logits is None) == (told.digit_logits is None)
            if answer.digit_logits is not None:
                atol = EXACT if dtype == torch.float32 else ROUNDED
                np.testing.assert_allclose(answer.digit_logits, told.digit_logits, rtol=0, atol=atol)


NOT_FINITE_AT = {  # for each draft: number of tokens before, and whether the answer is lost
    "behind an accepted token": ("whole answer", 2, True),
    "behind a rejected token": ("wrong", 2, False),
    "behind the end": ("goes on behind the end", 6, False),
}


@pytest.mark.parametrize(("kind", "at", "is_lost"), NOT_FINITE_AT.values(), ids=NOT_FINITE_AT)
def test_only_the_logits_of_an_answer_s_own_tokens_must_be_finite(kind: str, at: int, is_lost: bool) -> None:
    predictor = writer()
    rows = predictor.rows(samples_named("T1_single")[0])
    (expected,), _ = written(predictor, rows, [])
    draft, _ = DRAFTS[kind](expected.tokens, CASES[0].summary["eos_token_id"][0])
    is_first = iter([True])

    def spoil(_: Any, __: Any, logits: torch.Tensor) -> None:
        if next(is_first, False):
            logits[at] = torch.nan

    predictor.network.lm_head.register_forward_hook(spoil)
    (answer,), _ = written(predictor, rows, draft)
    assert answer.is_finite is not is_lost
    assert is_lost or answer.tokens == expected.tokens


def test_logits_that_are_not_finite_are_a_failure_and_no_answer() -> None:
    checkpoint = published.load(CHECKPOINT, reward_model="roboreward")
    checkpoint.parts["network"]["model.language_model.norm.weight"].fill_(torch.inf)
    engine = Engine.of(checkpoint)
    (outcome,) = engine.evaluate(CASES[0].samples()[:1])
    assert isinstance(outcome, InferenceFailedError)
