# SPDX-License-Identifier: MIT
"""RynnValue: the numbers of the original code, and what a checkpoint's files must say."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

from rfm import published
from rfm.engine import Engine, Execution
from rfm.families.rynnvalue.network import Bins, entropy
from rfm.published import CheckpointError
from rfm_client import ProgressResult, ProgressSample, Trajectory, UInt8Array
from rynnvalue import CASES, FOLDER, ISOLATED, RELATIVE_TOLERANCE, USUAL, Case, engine_of, said
from spoilt import in_json, settings
from tolerances import BATCHED_VLM_TOLERANCE

ISOLATED_CONFIG, CAUSAL_CONFIG = "bro_symlog_bf16_tied", "bro_quantile_fp32_tied"
NO_META, CAUSAL = FOLDER / "linear_2heads_nometa_fp32" / "checkpoint", FOLDER / CAUSAL_CONFIG / "checkpoint"
TASK = "put the red block in the bowl"
EVERY_CASE = pytest.mark.parametrize("case", CASES, ids=str)
BOTH_KINDS = pytest.mark.parametrize("name", [ISOLATED_CONFIG, CAUSAL_CONFIG])


def check_seconds(got: Any, expected: npt.NDArray[Any], tolerance: float = RELATIVE_TOLERANCE) -> None:
    np.testing.assert_allclose(got, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.reference
@EVERY_CASE
def test_seconds_are_those_of_the_original_code_and_of_its_server(case: Case) -> None:
    is_bfloat16 = case.summary["dtype"] == "bfloat16"
    for number, asked in enumerate(case.asked()):
        (result,) = scored(asked.engine, asked.sample)
        assert np.isnan([result.progress, result.success]).all()
        assert result.relative_s is not None
        seconds = case.expected(asked.prefix, "value.pred_value")
        relative = case.expected(asked.prefix, "relative.pred_value") if len(seconds) > 1 else np.zeros(0)
        if not asked.sample.frame_steps:
            check_seconds(result.remaining_s, seconds)
            check_seconds(result.relative_s, np.concatenate([[0], relative]))
            if case.attention == ISOLATED and not is_bfloat16:  # entropies of no other are stored
                expected = case.expected(asked.prefix, "value.entropy")
                np.testing.assert_allclose(result.entropy, expected, rtol=0, atol=1e-3)
            continue
        check_seconds(result.remaining_s[-1:], seconds[-1:])  # the arrays are those of the last prefix
        check_seconds(result.relative_s[-1:], relative[-1:])
        if case.summary["num_value_heads"] > 1:
            continue
        potentials = np.array(case.content["response"]["outputs_progress"]["progress_pred"][number])
        if is_bfloat16:  # so is the server's answer
            np.testing.assert_allclose(symlog(result.remaining_s), symlog(-potentials), rtol=0, atol=0.4)
        else:
            check_seconds(-np.asarray(result.remaining_s), potentials)


@pytest.mark.reference
@EVERY_CASE
def test_tokens_masks_and_pixels_are_those_of_the_original_code(case: Case) -> None:
    """The stored mask is that of config.json's attention, where value tokens are seen by their group alone."""
    arrays, masks = case.arrays, 0
    for index, asked in enumerate(case.asked()):
        told, predictor = case.content["samples"][index], asked.engine.predictor
        rows = predictor.rows(asked.sample)
        conversation = predictor.collator.conversation(rows[0].videos[0], asked.sample.trajectory.task)
        np.testing.assert_array_equal(conversation.input_ids, arrays[f"{asked.prefix}input_ids"][0])
        np.testing.assert_array_equal(conversation.position_ids, arrays[f"{asked.prefix}position_ids"])
        np.testing.assert_array_equal(conversation.slots, arrays[f"{asked.prefix}pred_slot_id"][0])
        pixels = predictor.collate(rows[-1:]).pixels.inputs(torch.device("cpu"), torch.float32)["pixel_values"]
        grid = predictor.collator.grid(rows[0].videos[0])
        assert told["image_grid_thw"] == [[1, grid.rows, grid.columns]] * grid.groups
        if asked.sample.frame_steps:
            continue
        assert list(pixels.shape) == told["pixels"]["shape"]
        assert float(pixels.double().abs().sum()) == pytest.approx(told["pixels"]["abs_sum"], rel=1e-6)
        np.testing.assert_allclose(pixels[0, :8], told["pixels"]["first_row_head"], rtol=0, atol=1e-6)
        if case.attention == ISOLATED and (stored := arrays.get(f"{asked.prefix}visible_packbits")) is not None:
            length, end = len(conversation.input_ids), conversation.groups[-1][-1][1]
            expected = np.unpackbits(stored)[: length**2].reshape(length, length).astype(bool)
            np.testing.assert_array_equal(visible(predictor, rows, conversation.slots[:end]), expected[:end, :end])
            masks += 1
    assert masks or case.attention != ISOLATED or case.file.stem != "T3"  # others may have none


def visible(predictor: Any, rows: Any, slots: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the tokens that each token of a conversation sees in our two passes, in the conversation's order."""
    (packs,) = predictor.collate(rows).packs
    num_trunk, num_groups = int((slots < 0).sum()), int((slots >= 0).sum())
    seen = np.zeros((len(slots), len(slots)), bool)
    seen[:num_trunk, :num_trunk] = np.tril(np.ones((num_trunk, num_trunk), bool))
    seen[num_trunk:] = packs.mask()[0, 0, :num_groups].numpy()
    order = np.argsort(np.concatenate([np.flatnonzero(slots < 0), np.flatnonzero(slots >= 0)]))
    return seen[np.ix_(order, order)]


def symlog(seconds: Any) -> npt.NDArray[Any]:
    values = np.asarray(seconds, np.float64)
    return np.asarray(np.sign(values) * np.log1p(np.abs(values)))


@pytest.mark.reference
def test_seconds_in_bfloat16_are_near_the_original_s() -> None:
    case = next(each for each in CASES if str(each) == f"{ISOLATED_CONFIG}/T3")
    (asked,) = case.asked()
    engine = Engine.of(published.load(case.checkpoint, **said(asked.meta)), dtype=torch.bfloat16)
    (result,) = scored(engine, asked.sample)
    expected = case.arrays[f"{asked.prefix}inv_freq_float32.{ISOLATED}.value.pred_value"][0]
    assert np.abs(symlog(result.remaining_s) - symlog(expected)).max() < 0.4


DECODED = json.loads((FOLDER / "decode_cases.json").read_text())


@pytest.mark.reference
@pytest.mark.parametrize("told", DECODED, ids=lambda told: f"{told['bins']}_{told['support_transform']}")
def test_logits_become_the_seconds_of_the_original_code(told: dict[str, Any]) -> None:
    arrays = np.load(FOLDER / "decode_cases.npz")
    logits = torch.from_numpy(arrays[f"{told['index']}.logits"])
    edges = tuple(told["bin_edges"]) if "bin_edges" in told else None
    bins = Bins(told["bins"], told["support_transform"], told["min_value"], told["max_value"], edges)
    check_seconds(bins.seconds(logits), arrays[f"{told['index']}.decoded"])
    np.testing.assert_allclose(entropy(logits), arrays[f"{told['index']}.entropy"], rtol=1e-5, atol=1e-6)


def noise(num_frames: int, height: int = 24, width: int = 40, seed: int = 0) -> UInt8Array:
    return np.random.default_rng(seed).integers(0, 256, (num_frames, height, width, 3), np.uint8)


def progress(frames: UInt8Array, task: str = TASK, frame_steps: int = 0) -> ProgressSample:
    return ProgressSample(Trajectory(frames=frames, task=task), frame_steps)


def engine(name: str) -> Engine:
    return engine_of(FOLDER / name / "checkpoint", USUAL)


def scored(engine: Engine, *samples: ProgressSample, execution: Execution | None = None) -> list[ProgressResult]:
    results = engine.evaluate(samples, execution)
    assert all(isinstance(result, ProgressResult) for result in results), results
    return [result for result in results if isinstance(result, ProgressResult)]


RAGGED = [progress(noise(n, h, w, n), f"task {n}") for n, h, w in ((1, 24, 40), (5, 48, 80), (3, 33, 120))]
RAGGED += [progress(noise(9, seed=9), "task 9", 4), progress(noise(1), "task 1", 4)]


@BOTH_KINDS
def test_a_mixed_batch_gives_the_answers_of_single_samples(name: str) -> None:
    for alone, together in zip(RAGGED, scored(engine(name), *RAGGED), strict=True):
        (expected,) = scored(engine(name), alone)
        assert len(expected.progress) == alone.trajectory.num_frames
        for score in ("remaining_s", "relative_s", "entropy"):
            check_seconds(getattr(together, score), getattr(expected, score), BATCHED_VLM_TOLERANCE)


@BOTH_KINDS
def test_frames_have_the_seconds_of_their_prefixes_in_one_pass_and_in_dense_mode(name: str) -> None:
    frames, execution, predictor = noise(24, 48, 80), Execution(), engine(name).predictor
    (whole,) = scored(engine(name), progress(frames[:6]))
    rows = predictor.collator.rows(progress(frames, frame_steps=4))
    (dense,) = scored(engine(name), progress(frames, frame_steps=4), execution=execution)
    assert execution.num_tokens < sum(row.num_tokens for each in rows for row in predictor.sequences(each))
    prefixes = [(whole, last, frames[: last + 1]) for last in (0, 2)]
    prefixes += [(dense, last, frames[np.linspace(0, last, 4).astype(int)]) for last in (0, 7, 23)]
    for together, last, shown in prefixes:
        (alone,) = scored(engine(name), progress(shown))
        for score in ("remaining_s", "relative_s"):
            check_seconds(getattr(together, score)[last], getattr(alone, score)[-1], 1e-4)


def test_an_export_gives_the_same_seconds_and_takes_another_robot(tmp_path: Path) -> None:
    loaded = published.load(CAUSAL, **said(USUAL))
    loaded.save(tmp_path / "export")
    saved = published.load(tmp_path / "export")
    assert published.choose(tmp_path / "export").name == "rfm.families.rynnvalue"
    assert saved.config == loaded.config
    other = published.load(tmp_path / "export", robot_description="another, with two arms")
    assert other.config == replace(saved.config, robot_description="another, with two arms")
    before, after, differing = (scored(Engine.of(each), progress(noise(3)))[0] for each in (loaded, saved, other))
    np.testing.assert_array_equal(before.remaining_s, after.remaining_s)
    assert np.abs(np.subtract(before.remaining_s, differing.remaining_s)).max() > 1e-2


def test_layers_are_rounded_but_not_the_heads() -> None:
    rounded = published.load(CAUSAL, **said(USUAL), weights="int8")
    assert rounded.weights["model.language_model.layers.0.mlp.up_proj.weight"].dtype is torch.int8
    assert rounded.weights["value_heads.0.proj.blocks.0.fc1.weight"].dtype is torch.float32
    (result,) = scored(Engine.of(rounded), progress(noise(2)))
    assert np.isfinite(np.asarray(result.remaining_s)).all()


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    return Path(shutil.copytree(NO_META, tmp_path / "checkpoint"))


REFUSED: dict[str, tuple[Path, dict[str, Any], str]] = {
    "needed": (CAUSAL, {}, "expected robot_description, camera_description or both, .* got neither; for example --"),
    "unused": (NO_META, said(USUAL), "--robot-description: expected a RynnValue whose prompt names robot and camera"),
    "special": (CAUSAL, said((None, "a <value>")), "camera_description: expected text without the model's special"),
}


@pytest.mark.parametrize(("checkpoint", "options", "message"), REFUSED.values(), ids=REFUSED)
def test_descriptions_that_do_not_fit_the_prompt_are_refused(
    checkpoint: Path, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(CheckpointError, match=message):
        _ = published.load(checkpoint, **options).collator


def test_missing_settings_are_assumed_and_unexpected_keys_are_noted(copied: Path) -> None:
    in_json("config.json", lambda config: config.pop("attn_implementation"))(copied)
    settings("config.json", success_head_config={})(copied)
    in_json("config.json", lambda config: config["value_head_config"].update(dropout=0.1))(copied)
    loaded = published.read(copied)
    assert loaded.checkpoint.config.attention == "isolated"
    assert [(each.name, each.value) for each in loaded.assumptions] == [("attn_implementation", ISOLATED)]
    assert loaded.notes(loaded.checkpoint) == [
        f"config.json{where}: not expected, and not used: scores may differ from the original's"
        for where in (": 'success_head_config'", ": value_head_config: 'dropout'")
    ]


WRONG = {
    "attention": (lambda c: c.update(attn_implementation="window"), "attn_implementation: expected one of pred_slot"),
    "copies": (lambda c: c.update(value_token_repeat=8), "value_token_repeat: expected 8, as in config.json, got 3"),
    "token": (lambda c: c.update(value_token_id=7), "value_token_id: expected 665, the tokenizer's id of <value>"),
    "head": (lambda c: c["value_head_config"].update(head_type="mlp"), "head_type: expected one of bro, linear"),
    "width": (
        lambda c: c["value_head_config"].update(hidden_dims=0),
        "hidden_dims: expected a whole number of at least",
    ),
    "bins": (lambda c: c["value_tokenizer_config"].update(support_transform="log"), "support_transform: expected one"),
    "edges": (lambda c: c["value_tokenizer_config"].update(support_transform="quantile"), "33 ascending numbers"),
    "edges that fall": (
        lambda c: c["value_tokenizer_config"].update(support_transform="quantile", bin_edges=[*range(33, 0, -1)]),
        "33 ascending numbers",
    ),
    "heads": (lambda c: c.update(num_value_heads=3), "value_heads.2.proj"),
}


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG)
def test_settings_that_cannot_be_right_are_refused(copied: Path, change: Any, message: str) -> None:
    in_json("config.json", change)(copied)
    with pytest.raises(CheckpointError, match=message):
        published.load(copied)


@pytest.mark.gpu
@BOTH_KINDS
def test_a_gpu_gives_the_cpu_s_seconds(name: str) -> None:
    loaded = published.load(FOLDER / name / "checkpoint", **said(USUAL))
    on_cpu, on_gpu = (Engine.of(loaded, device=device, dtype=torch.float32) for device in ("cpu", "cuda"))
    for expected, result in zip(scored(on_cpu, *RAGGED), scored(on_gpu, *RAGGED), strict=True):
        check_seconds(result.remaining_s, expected.remaining_s)
        check_seconds(result.relative_s, expected.relative_s)
