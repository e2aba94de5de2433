# SPDX-License-Identifier: MIT
"""RynnValue: the numbers of the original code, and what a checkpoint's files must say."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from safetensors.torch import load_file, save_file

from rfm import families
from rfm.engine import Engine, Execution
from rfm.families import CheckpointError
from rfm.rynnvalue.network import Bins, RynnConfig, entropy
from rfm_client import (
    InvalidSampleError,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Trajectory,
    UInt8Array,
)
from rfm_client.contract import Analysis
from rynnvalue import (
    CASES,
    FOLDER,
    ISOLATED,
    LOGIT_TOLERANCE,
    OTHERS,
    RELATIVE_TOLERANCE,
    USUAL,
    Asked,
    Case,
    Meta,
    engine_of,
    said,
)
from tolerances import BATCHED_VLM_TOLERANCE

ISOLATED_CONFIG, CAUSAL_CONFIG = "bro_symlog_bf16_tied", "bro_quantile_fp32_tied"
NO_META = FOLDER / "linear_2heads_nometa_fp32" / "checkpoint"
UNSAID: Meta = (None, None)
TASK = "put the red block in the bowl"


def text_of(asked: Asked) -> tuple[str, tuple[str, str]]:
    return asked.sample.trajectory.task, asked.sample.trajectory.descriptions


def check_seconds(got: Any, expected: npt.NDArray[Any]) -> None:
    np.testing.assert_allclose(got, expected, rtol=RELATIVE_TOLERANCE, atol=RELATIVE_TOLERANCE)


@pytest.mark.reference
@pytest.mark.parametrize("case", CASES, ids=str)
def test_seconds_are_those_of_the_original_code(case: Case) -> None:
    asked_of_case = case.asked()
    results = case.engine.evaluate([asked.sample for asked in asked_of_case])
    for asked, result in zip(asked_of_case, results, strict=True):
        assert isinstance(result, ProgressResult), result
        assert np.isnan(result.progress).all()
        assert np.isnan(result.success).all()
        assert result.relative_s is not None
        seconds = case.expected(asked.prefix, "value.pred_value")
        relative = case.expected(asked.prefix, "relative.pred_value") if len(seconds) > 1 else np.zeros(0)
        if asked.sample.frame_steps:  # the arrays are those of the last prefix
            check_seconds(result.remaining_s[-1:], seconds[-1:])
            check_seconds(result.relative_s[-1:], relative[-1:])
            continue
        check_seconds(result.remaining_s, seconds)
        check_seconds(result.relative_s, np.concatenate([[0], relative]))
        if case.attention == ISOLATED and case.summary["dtype"] == "float32":  # entropies of no other are stored
            expected = case.expected(asked.prefix, "value.entropy")
            np.testing.assert_allclose(result.entropy, expected, rtol=0, atol=1e-3)


@pytest.mark.reference
@pytest.mark.parametrize(
    "case",
    [each for each in CASES if each.file.stem.startswith("steps") and each.summary["num_value_heads"] == 1],
    ids=str,
)
def test_each_step_has_the_seconds_of_the_original_server(case: Case) -> None:
    response = case.content["response"]["outputs_progress"]["progress_pred"]
    for asked, potentials in zip(case.asked(), response, strict=True):
        (result,) = case.engine.evaluate([asked.sample])
        assert isinstance(result, ProgressResult)
        if case.summary["dtype"] == "float32":
            check_seconds(-np.asarray(result.remaining_s), np.array(potentials))
        else:  # the original answers in bfloat16
            np.testing.assert_allclose(symlog(result.remaining_s), symlog(-np.array(potentials)), rtol=0, atol=0.4)


@pytest.mark.reference
@pytest.mark.parametrize("case", CASES, ids=str)
def test_tokens_positions_and_groups_are_those_of_the_original_code(case: Case) -> None:
    for asked in case.asked():
        collator = case.engine.predictor.collator
        (video, *_) = collator.rows(asked.sample)[0].videos
        conversation, arrays = collator.conversation(video, *text_of(asked)), case.arrays
        np.testing.assert_array_equal(conversation.input_ids, arrays[f"{asked.prefix}input_ids"][0])
        np.testing.assert_array_equal(conversation.position_ids, arrays[f"{asked.prefix}position_ids"])
        np.testing.assert_array_equal(conversation.slots, arrays[f"{asked.prefix}pred_slot_id"][0])


@pytest.mark.reference
@pytest.mark.parametrize("case", [each for each in CASES if each.attention == ISOLATED], ids=str)
def test_tokens_see_those_that_they_see_in_the_original_code(case: Case) -> None:
    """The stored mask is that of config.json's attention, where value tokens are seen by their group alone."""
    compared = 0
    for asked in case.asked():
        if (stored := case.arrays.get(f"{asked.prefix}visible_packbits")) is None:
            continue
        predictor = case.engine.predictor
        rows = predictor.rows(asked.sample)
        conversation = predictor.collator.conversation(rows[0].videos[0], *text_of(asked))
        length = len(conversation.input_ids)
        expected = np.unpackbits(stored)[: length**2].reshape(length, length).astype(bool)
        end = conversation.groups[-1][-1][1]
        np.testing.assert_array_equal(visible(predictor, rows, conversation.slots[:end]), expected[:end, :end])
        compared += 1
    assert compared == (0 if case.file.stem.startswith("steps") else compared)


def visible(predictor: Any, rows: Any, slots: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the tokens that each token of a conversation sees in our two passes, in the conversation's order."""
    (packs,) = predictor.collate(rows).packs
    num_trunk, num_groups = int((slots < 0).sum()), int((slots >= 0).sum())
    seen = np.zeros((len(slots), len(slots)), bool)
    seen[:num_trunk, :num_trunk] = np.tril(np.ones((num_trunk, num_trunk), bool))
    seen[num_trunk:] = packs.mask()[0, 0, :num_groups].numpy()
    order = np.argsort(np.concatenate([np.flatnonzero(slots < 0), np.flatnonzero(slots >= 0)]))
    return seen[np.ix_(order, order)]


@pytest.mark.reference
@pytest.mark.parametrize("case", CASES, ids=str)
def test_frames_have_the_original_s_pixels(case: Case) -> None:
    for index, asked in enumerate(case.asked()):
        told = case.content["samples"][index]
        predictor = case.engine.predictor
        rows = predictor.rows(asked.sample)[-1:]
        pixels = predictor.collate(rows).pixels.inputs(torch.device("cpu"), torch.float32)["pixel_values"]
        grid = predictor.collator.grid(rows[0].videos[0])
        assert told["image_grid_thw"] == [[1, grid.rows, grid.columns]] * grid.groups
        if not asked.sample.frame_steps:
            assert list(pixels.shape) == told["pixels"]["shape"]
            assert float(pixels.double().abs().sum()) == pytest.approx(told["pixels"]["abs_sum"], rel=1e-6)
            np.testing.assert_allclose(pixels[0, :8], told["pixels"]["first_row_head"], rtol=0, atol=1e-6)


def symlog(seconds: Any) -> npt.NDArray[Any]:
    values = np.asarray(seconds, np.float64)
    return np.asarray(np.sign(values) * np.log1p(np.abs(values)))


@pytest.mark.reference
def test_seconds_in_bfloat16_are_near_the_original_s() -> None:
    case = next(each for each in CASES if str(each) == f"{ISOLATED_CONFIG}/T3")
    (asked,) = case.asked()
    engine = Engine.of(families.load(case.checkpoint, reward_model=said(asked.meta)), dtype=torch.bfloat16)
    (result,) = engine.evaluate([asked.sample])
    assert isinstance(result, ProgressResult)
    expected = case.arrays[f"{asked.prefix}inv_freq_float32.{ISOLATED}.value.pred_value"][0]
    assert np.abs(symlog(result.remaining_s) - symlog(expected)).max() < 0.4


@pytest.mark.reference
@pytest.mark.parametrize("case", [each for each in CASES if not each.file.stem.startswith("steps")], ids=str)
def test_analyses_have_the_tokens_of_the_original_code(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RynnConfig, "max_new_tokens", case.summary["max_new_tokens"])
    predictor, text_of_answer, written = case.engine.predictor, case.engine.predictor.text, []
    monkeypatch.setattr(predictor, "text", lambda answer: written.append(answer.tokens) or text_of_answer(answer))
    for asked in case.asked():
        (result,) = case.engine.evaluate([replace(asked.sample, analysis=True)])
        assert isinstance(result, ProgressResult), result
        check_seconds(result.remaining_s, case.expected(asked.prefix, "value.pred_value"))
        told = case.generated(asked.prefix)
        least = 1 if case.summary["dtype"] == "bfloat16" else 2 * LOGIT_TOLERANCE
        if told is None or told["margin"] < least:
            continue  # not stored, or another kernel may write another token
        ended = [*predictor.collator.config.stops] * told["stopped_at_eos"]
        assert [*written[-1], *ended] == told["new_ids"]
        assert result.analysis == Analysis(told["text"])


# What is unknown here, where the original guesses: from the first letters of a word, or from the next line.
UNKNOWN = {
    "- Match: Yesterday": "match",
    "- Match: Not sure": "match",
    "- Success: Yes/No": "success",
    "- Video Description:\n- Match: Yes": "description",
    "- Video Description:   \n\n- Success: Yes": "description",
}


def test_an_analysis_is_read_as_by_the_original_code_but_not_guessed() -> None:
    cases = {told["text"]: told["parsed"] for told in json.loads((FOLDER / "parse_cases.json").read_text())}
    assert cases.keys() > UNKNOWN.keys()
    for text, parsed in cases.items():
        said = {name: parsed[name] and parsed[name].lower() == "yes" for name in ("match", "success")}
        expected = {"description": parsed["description"], **said, **dict.fromkeys([UNKNOWN.get(text)])}
        expected.pop(None, None)
        assert Analysis(text).parts == expected, text


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


def progress(frames: UInt8Array, task: str = TASK, frame_steps: int = 0, **described: str) -> ProgressSample:
    return ProgressSample(Trajectory(frames=frames, task=task, **described), frame_steps)


def engine(name: str) -> Engine:
    return engine_of(FOLDER / name / "checkpoint", USUAL)


def scored(engine: Engine, *samples: ProgressSample, execution: Execution | None = None) -> list[ProgressResult]:
    results = engine.evaluate(samples, execution)
    assert all(isinstance(result, ProgressResult) for result in results), results
    return [result for result in results if isinstance(result, ProgressResult)]


@pytest.mark.parametrize("name", [ISOLATED_CONFIG, CAUSAL_CONFIG])
def test_a_mixed_batch_gives_the_answers_of_single_samples(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RynnConfig, "max_new_tokens", 24)
    samples = [progress(noise(n, h, w, n), f"task {n}") for n, h, w in ((1, 24, 40), (5, 48, 80), (3, 33, 120))]
    samples += [replace(samples[0], analysis=True), replace(samples[1], analysis=True)]
    samples += [progress(noise(9, seed=9), "task 9", 4), progress(noise(1), "task 1", 4)]
    for alone, together in zip(samples, scored(engine(name), *samples), strict=True):
        (expected,) = scored(engine(name), alone)
        assert len(expected.progress) == alone.trajectory.num_frames
        for score in ("remaining_s", "relative_s", "entropy"):
            got, wanted = getattr(together, score), getattr(expected, score)
            np.testing.assert_allclose(got, wanted, rtol=BATCHED_VLM_TOLERANCE, atol=BATCHED_VLM_TOLERANCE)
        assert together.analysis == expected.analysis
        assert (expected.analysis is not None) is alone.analysis


def test_a_sample_s_descriptions_replace_both_of_the_export() -> None:
    robot, camera = USUAL
    usual, other = engine(CAUSAL_CONFIG), engine_of(FOLDER / CAUSAL_CONFIG / "checkpoint", OTHERS)
    described = [progress(noise(3), robot_description=robot, camera_description=camera), progress(noise(3))]
    both, own = scored(other, *described)
    (expected,) = scored(usual, described[1])
    np.testing.assert_allclose(both.remaining_s, expected.remaining_s, rtol=1e-5)
    assert np.abs(np.subtract(own.remaining_s, expected.remaining_s)).max() > 1e-2
    (camera_alone,) = scored(other, progress(noise(3), camera_description=camera))
    (expected,) = scored(engine_of(FOLDER / CAUSAL_CONFIG / "checkpoint", (None, camera)), described[1])
    np.testing.assert_allclose(camera_alone.remaining_s, expected.remaining_s, rtol=1e-5)


def test_descriptions_that_a_prompt_cannot_take_are_refused() -> None:
    (refused,) = engine_of(NO_META, UNSAID).evaluate([progress(noise(2), robot_description="an arm")])
    with pytest.raises(InvalidSampleError, match="camera_description: expected none, as the prompt of this checkpoint"):
        raise refused
    (refused,) = engine(CAUSAL_CONFIG).evaluate([progress(noise(2), camera_description="the <value> camera")])
    with pytest.raises(InvalidSampleError, match="camera_description: expected text without the model's special token"):
        raise refused
    with pytest.raises(InvalidSampleError, match="robot_description: expected str, got int"):
        progress(noise(2), robot_description=7)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", [ISOLATED_CONFIG, CAUSAL_CONFIG])
def test_one_pass_gives_each_frame_the_seconds_of_the_frames_before_it(name: str) -> None:
    frames = noise(6)
    (whole,) = scored(engine(name), progress(frames))
    for count in (1, 3):
        (prefix,) = scored(engine(name), progress(frames[:count]))
        np.testing.assert_allclose(prefix.remaining_s, whole.remaining_s[:count], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(prefix.relative_s, whole.relative_s[:count], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", [ISOLATED_CONFIG, CAUSAL_CONFIG])
def test_dense_mode_gives_each_prefix_its_own_answer_in_fewer_tokens(name: str) -> None:
    frames, execution = noise(24, 48, 80), Execution()
    predictor = engine(name).predictor
    rows = predictor.collator.rows(progress(frames, frame_steps=4))
    (dense,) = scored(engine(name), progress(frames, frame_steps=4), execution=execution)
    apart = sum(row.num_tokens for each in rows for row in predictor.sequences(each))
    assert execution.num_tokens < apart
    for last in (0, 7, 23):
        shown = frames[np.linspace(0, last, 4).astype(int)]
        (alone,) = scored(engine(name), progress(shown))
        np.testing.assert_allclose(dense.remaining_s[last], alone.remaining_s[-1], rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(dense.relative_s[last], alone.relative_s[-1], rtol=1e-4, atol=1e-4)


def test_analyses_of_prefixes_are_refused() -> None:
    with pytest.raises(InvalidSampleError, match=r"analysis: expected frame_steps 0 with it, .*, got frame_steps 4"):
        ProgressSample(Trajectory(frames=noise(3), task=TASK), 4, analysis=True)


def test_other_frames_than_progress_are_refused() -> None:
    first = Trajectory(frames=noise(2), task=TASK)
    (refused,) = engine(CAUSAL_CONFIG).evaluate([PreferenceSample(first, first)])
    assert isinstance(refused, InvalidSampleError)


def test_special_tokens_in_a_task_are_refused() -> None:
    (refused,) = engine(CAUSAL_CONFIG).evaluate([progress(noise(2), "put <value> in the bowl")])
    assert isinstance(refused, InvalidSampleError)
    assert "'<value>'" in str(refused)


def test_features_of_frames_are_computed_once() -> None:
    loaded = families.load(NO_META)
    cached = Engine.of(loaded, feature_cache_mib=16)
    execution, again = Execution(), Execution()
    first, second = (scored(cached, progress(noise(3)), execution=each)[0] for each in (execution, again))
    assert (execution.num_encoded, again.num_encoded, again.num_found) == (3, 0, 3)
    np.testing.assert_allclose(first.remaining_s, second.remaining_s, rtol=1e-5)


def test_an_export_gives_the_same_seconds(tmp_path: Path) -> None:
    loaded = families.load(FOLDER / CAUSAL_CONFIG / "checkpoint", reward_model=said(USUAL))
    loaded.save(tmp_path / "export")
    saved = families.load(tmp_path / "export")
    assert families.choose(tmp_path / "export").name == "rfm.rynnvalue"
    assert saved.config == loaded.config
    asked = replace(progress(noise(3)), analysis=True)
    (before,), (after,) = (scored(Engine.of(each), asked) for each in (loaded, saved))
    np.testing.assert_array_equal(before.remaining_s, after.remaining_s)
    assert before.analysis == after.analysis
    other = families.load(tmp_path / "export", reward_model="rynnvalue,robot=a robot of another kind")
    assert other.config.robot == "a robot of another kind"
    assert other.config.camera == USUAL[1]


def test_an_export_without_a_language_head_scores_and_refuses_analyses(tmp_path: Path) -> None:
    """Exports of earlier versions have none."""
    families.load(NO_META).save(tmp_path / "export")
    changed(tmp_path / "export" / "config.json", lambda config: config["rfm"].pop("stops"))
    weights = load_file(tmp_path / "export" / "model.safetensors")
    del weights["lm_head.weight"]
    save_file(weights, tmp_path / "export" / "model.safetensors", metadata={"format": "pt"})
    older = families.load(tmp_path / "export")
    assert not older.description.writes_analyses
    usual, refused = Engine.of(older).evaluate([progress(noise(2)), replace(progress(noise(2)), analysis=True)])
    assert isinstance(usual, ProgressResult)
    with pytest.raises(InvalidSampleError, match="analysis: expected False, as this checkpoint writes none, got True"):
        raise refused


def test_layers_are_rounded_but_not_the_heads() -> None:
    rounded = families.load(FOLDER / CAUSAL_CONFIG / "checkpoint", reward_model=said(USUAL), weights="int8")
    assert rounded.weights["model.language_model.layers.0.mlp.up_proj.weight"].dtype is torch.int8
    assert rounded.weights["value_heads.0.proj.blocks.0.fc1.weight"].dtype is torch.float32
    (result,) = scored(Engine.of(rounded), progress(noise(2)))
    assert np.isfinite(np.asarray(result.remaining_s)).all()


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    return Path(shutil.copytree(NO_META, tmp_path / "checkpoint"))


def changed(file: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def test_a_prompt_that_names_the_robot_needs_a_description() -> None:
    with pytest.raises(CheckpointError, match=r"--as: expected robot=\.\.\., camera=\.\.\. or both"):
        families.load(FOLDER / CAUSAL_CONFIG / "checkpoint")
    with pytest.raises(CheckpointError, match="the prompt of this checkpoint has none"):
        families.load(NO_META, reward_model=said(USUAL))


def test_missing_settings_are_those_of_the_published_checkpoints_and_told(copied: Path) -> None:
    changed(copied / "config.json", lambda config: config.pop("attn_implementation"))
    loaded = families.load(copied)
    assert loaded.config.attention == "isolated"
    (told,) = [each for each in loaded.decisions() if each.name == "attn_implementation"]
    assert told.is_assumed


def test_unexpected_keys_are_told(copied: Path) -> None:
    changed(copied / "config.json", lambda config: config.update(success_head_config={}))
    changed(copied / "config.json", lambda config: config["value_head_config"].update(dropout=0.1))
    assert families.load(copied).notes == [
        f"config.json{where}: not expected, and not used: scores may differ from the original's"
        for where in (": 'success_head_config'", ": value_head_config: 'dropout'")
    ]


WRONG = {
    "attention": (lambda c: c.update(attn_implementation="window"), "attn_implementation: expected pred_slot"),
    "copies": (lambda c: c.update(value_token_repeat=8), "value_token_repeat: expected 8, as in config.json, got 3"),
    "token": (lambda c: c.update(value_token_id=7), "value_token_id: expected 665, the tokenizer's id of <value>"),
    "head": (lambda c: c["value_head_config"].update(head_type="mlp"), "head_type: expected bro or linear"),
    "bins": (lambda c: c["value_tokenizer_config"].update(support_transform="log"), "support_transform: expected one"),
    "edges": (lambda c: c["value_tokenizer_config"].update(support_transform="quantile"), "33 ascending numbers"),
    "heads": (lambda c: c.update(num_value_heads=3), "value_heads.2.proj"),
}


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG)
def test_settings_that_cannot_be_right_are_refused(copied: Path, change: Any, message: str) -> None:
    changed(copied / "config.json", change)
    with pytest.raises(CheckpointError, match=message):
        families.load(copied)


def test_explain_states_attention_bins_and_sources() -> None:
    told = {each.name: each for each in families.load(NO_META).decisions()}
    assert told["attn_implementation"].value == ISOLATED
    assert told["attn_implementation"].source == "config.json: attn_implementation"
    assert told["value_tokenizer_config"].value == {
        "bins": 32, "max_value": 100.0, "min_value": 0.0, "support_transform": "linear",
    }  # fmt: skip
    assert told["use_meta"].value is False
    assert told["rows_of_the_embedding"].value == 667


@pytest.mark.gpu
@pytest.mark.parametrize("name", [ISOLATED_CONFIG, CAUSAL_CONFIG])
def test_a_gpu_gives_the_cpu_s_seconds(name: str) -> None:
    samples = [progress(noise(n, h, w, n)) for n, h, w in ((1, 24, 40), (5, 48, 80), (3, 33, 120))]
    samples += [progress(noise(9, seed=9), frame_steps=4)]
    loaded = families.load(FOLDER / name / "checkpoint", reward_model=said(USUAL))
    on_cpu, on_gpu = (Engine.of(loaded, device=device, dtype=torch.float32) for device in ("cpu", "cuda"))
    for expected, result in zip(scored(on_cpu, *samples), scored(on_gpu, *samples), strict=True):
        check_seconds(result.remaining_s, expected.remaining_s)
        check_seconds(result.relative_s, expected.relative_s)
