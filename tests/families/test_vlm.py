# SPDX-License-Identifier: MIT
"""Vision-language checkpoints: prompts, pixels, forms of checkpoints, batches, bad input."""

from __future__ import annotations

import importlib.metadata
import json
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from google.protobuf import text_format
from PIL import Image
from safetensors.torch import load_file, save_file
from torch.utils._python_dispatch import TorchDispatchMode
from tritonclient.grpc import model_config_pb2 as pb

import goldens
import rfm_export
from engines import load_engine
from reference_server import Served
from rfm import families
from rfm.checkpoint.content import CheckpointError
from rfm.config import ServeConfig
from rfm.engine import Engine
from rfm.execution import Execution
from rfm.predictor import RowScores
from rfm.vlm.checkpoint import VlmCheckpoint
from rfm.vlm.collator import QWEN3, VISION_START, VlmRow
from rfm.vlm.images import Normalisation, QwenImages, fitted_size
from rfm.vlm.network import VlmBatch
from rfm.vlm.predictor import VlmPredictor
from rfm.vlm.prompts import SPLIT_TOKEN
from rfm_client import (
    InferenceFailedError,
    InvalidSampleError,
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Sample,
    SimilaritySample,
    Trajectory,
)
from rfm_client.contract.model_info import FRAME_SIZE_PARAMETER

WITH_SIMILARITY = "q25_peft_adapter_disc10"  # in the copied references too
BFLOAT16 = "q3_tok_disc10_bf16"
PLAIN = "q3_tok_disc10"
ADAPTER = "q25_peft_adapter_disc10"
LORA_INSIDE = "q3_lora_full_disc10"
PIXEL_TOLERANCE = 1e-6  # relative, of a sum over all pixels
MIXED_TOLERANCE = 5e-6  # seen: 1e-6


def predictor_of(name: str) -> VlmPredictor:
    predictor = load_engine(name).predictor
    assert isinstance(predictor, VlmPredictor)
    return predictor


def arrays_of(case: goldens.Case) -> dict[str, np.ndarray]:
    return dict(np.load(case.file.with_suffix("").with_suffix(".expected.npz")))


def by_type(samples: Sequence[Sample]) -> dict[str, list[Sample]]:
    kinds: dict[str, list[Sample]] = {}
    for sample in samples:
        kinds.setdefault(goldens.sample_type(sample), []).append(sample)
    return kinds


BATCHED = [case for case in goldens.VLM_CASES if not case.is_refused and case.content["kind"] != "ragg"]


@pytest.mark.reference
@pytest.mark.parametrize("case", BATCHED, ids=str)
def test_token_ids_and_pixels_are_those_of_the_original(case: goldens.Case) -> None:
    predictor, arrays, content = predictor_of(case.config.name), arrays_of(case), case.content
    for kind, samples in by_type(case.samples()).items():
        if f"{kind}.collated.input_ids" not in arrays:  # evaluated one by one
            continue
        rows = [row for sample in samples for row in predictor.rows(sample)]
        inputs = predictor.collate(rows).inputs
        for name in ("input_ids", "attention_mask", "image_grid_thw", "video_grid_thw"):
            if f"{kind}.collated.{name}" in arrays:
                np.testing.assert_array_equal(inputs[name].numpy(), arrays[f"{kind}.collated.{name}"])
        pixels = content["pixels"][kind]
        if f"{kind}.collated.{pixels['key']}" in arrays:
            whole = arrays[f"{kind}.collated.{pixels['key']}"]
            np.testing.assert_allclose(inputs[pixels["key"]].numpy(), whole, rtol=0, atol=1e-6)
        made = inputs[pixels["key"]].double()
        assert list(made.shape) == pixels["shape"]
        assert abs(float(made.sum()) - pixels["sum"]) <= PIXEL_TOLERANCE * pixels["abs_sum"]
        assert abs(float(made.abs().sum()) - pixels["abs_sum"]) <= PIXEL_TOLERANCE * pixels["abs_sum"]


@pytest.mark.reference
@pytest.mark.parametrize("case", goldens.VLM_CASES, ids=str)
def test_the_engine_gives_every_reference_answer(case: goldens.Case) -> None:
    outcomes = load_engine(case.config.name).evaluate(case.samples())
    results = [outcome for outcome in outcomes if not isinstance(outcome, Exception)]
    for result, expected in zip(results, case.expected(), strict=True):
        goldens.check(result, expected, case.tolerances)
    case.check_response(results)


BFLOAT16_CASES = goldens.config(BFLOAT16).cases()


def engine_in_bfloat16() -> tuple[Engine, VlmPredictor]:
    config = goldens.config(BFLOAT16)
    engine = Engine.from_checkpoint(config.checkpoint, base_model=str(config.base_model), dtype=torch.bfloat16)
    assert isinstance(engine.predictor, VlmPredictor)
    return engine, engine.predictor


def round_frequencies(network: torch.nn.Module) -> None:
    """The fault of casting a whole network: the rotary frequencies are rounded with it."""
    buffers = [(m, name) for m in network.modules() for name, _ in m.named_buffers(recurse=False) if name == "inv_freq"]
    for module, name in buffers:
        module.register_buffer(name, getattr(module, name).to(torch.bfloat16), persistent=False)
    assert len(buffers) == 2  # of images and of text


def excesses(engine: Engine, case: goldens.Case, *, bfloat16: bool, tolerances: tuple[float, float]) -> list[float]:
    """How many times its tolerance each sample's largest difference is."""
    results = [outcome for outcome in engine.evaluate(case.samples()) if not isinstance(outcome, Exception)]
    pairs = zip(results, case.expected(bfloat16=bfloat16), strict=True)
    each = (goldens.differences(result, expected) for result, expected in pairs)
    return [max(raw / tolerances[0], probability / tolerances[1]) for raw, probability in each]


@pytest.mark.reference
@pytest.mark.parametrize("case", BFLOAT16_CASES, ids=str)
def test_bfloat16_is_the_original_s_bfloat16(case: goldens.Case) -> None:
    engine, predictor = engine_in_bfloat16()
    assert max(excesses(engine, case, bfloat16=True, tolerances=goldens.BFLOAT16_TOLERANCES)) <= 1
    round_frequencies(predictor.network)
    if goldens.HAS_AVX512:  # elsewhere the rounding of sums moves scores as far as that fault does: see below
        assert max(excesses(engine, case, bfloat16=True, tolerances=goldens.BFLOAT16_TOLERANCES)) > 1


@pytest.mark.reference
@pytest.mark.parametrize("case", [case for case in BFLOAT16_CASES if case.has_float32], ids=str)
def test_a_network_in_bfloat16_holds_the_original_s_numbers(case: goldens.Case) -> None:
    """Computed in float32, where a CPU's rounding is a thousandth of what a rounded frequency does."""
    _, predictor = engine_in_bfloat16()
    engine = Engine(VlmPredictor(predictor.network.float(), predictor.collator, torch.device("cpu")))
    assert max(excesses(engine, case, bfloat16=False, tolerances=case.tolerances)) <= 1
    round_frequencies(predictor.network)
    assert min(excesses(engine, case, bfloat16=False, tolerances=case.tolerances)) > 10


def film(seed: int, num_frames: int, height: int, width: int, task: str = "stack the blocks") -> Trajectory:
    frames = np.random.default_rng(seed).integers(0, 256, (num_frames, height, width, 3), np.uint8)
    return Trajectory(frames=frames, task=task)


def mixture() -> list[Sample]:
    """T = 2, 8, 16; three image sizes, in some pairs two; all three types."""
    samples: list[Sample] = []
    for seed, (num_frames, (height, width)) in enumerate(
        (count, size) for count in (2, 8, 16) for size in ((56, 56), (64, 100), (90, 61))
    ):
        samples.append(ProgressSample(film(seed, num_frames, height, width, f"task {seed}")))
        samples.append(PreferenceSample(film(seed, num_frames, height, width), film(seed + 50, 3, height, width)))
        samples.append(SimilaritySample(film(seed, 1, height, width), film(seed + 90, num_frames, height, width)))
        samples.append(PreferenceSample(film(seed, num_frames, height, width), film(seed + 70, 3, 84, 112)))
        samples.append(SimilaritySample(film(seed, 1, 60, 60), film(seed + 80, num_frames, height, width)))
    return samples


def assert_close(left: object, right: object, tolerance: float) -> None:
    assert not isinstance(left, Exception), left
    assert not isinstance(right, Exception), right
    for a, b in zip(goldens.frame_scores(left), goldens.frame_scores(right), strict=True):  # type: ignore[arg-type]
        np.testing.assert_allclose(a.progress, b.progress, rtol=0, atol=tolerance)
        np.testing.assert_allclose(a.success, b.success, rtol=0, atol=tolerance)
    for name in ("preference", "similarity"):
        if hasattr(left, name):
            assert abs(getattr(left, name) - getattr(right, name)) <= tolerance


@pytest.mark.parametrize(
    ("name", "token_budget"),
    [
        ("q25_peft_adapter_disc10", 4096),
        ("q25_peft_adapter_disc10", 65_536),
        ("q25_video_last_l2", 65_536),
        ("smol_mean_disc10", 4096),
    ],
)
def test_a_mixture_equals_its_samples_alone(name: str, token_budget: int) -> None:
    samples = mixture()
    engine = Engine(load_engine(name).predictor, token_budget=token_budget)
    order = np.random.default_rng(0).permutation(len(samples))
    together = engine.evaluate([samples[index] for index in order])
    for index, outcome in zip(order, together, strict=True):
        assert_close(outcome, engine.evaluate([samples[index]])[0], MIXED_TOLERANCE)


def test_an_ordinary_film_over_the_token_budget_is_scored() -> None:
    """The budget decides which samples share a forward pass, not which are scored."""
    samples = [ProgressSample(film(0, 12, 280, 420)), PreferenceSample(film(1, 6, 280, 420), film(2, 7, 280, 420))]
    samples.append(ProgressSample(film(3, 5, 84, 84), frame_steps=4))
    engine = Engine(load_engine(PLAIN).predictor, token_budget=100)
    for outcome, other in zip(engine.evaluate(samples), load_engine(PLAIN).evaluate(samples), strict=True):
        assert_close(outcome, other, MIXED_TOLERANCE)


def test_a_mixture_over_the_wire_equals_its_samples_alone(served: Served, protocol: str) -> None:
    samples = mixture()
    alone = [load_engine(WITH_SIMILARITY).evaluate([sample])[0] for sample in samples]
    with served.client(protocol, WITH_SIMILARITY) as client:
        for result, expected in zip(client.evaluate(samples), alone, strict=True):
            assert_close(result, expected, MIXED_TOLERANCE)


def spliced(left: VlmRow, right: VlmRow, predictor: VlmPredictor) -> tuple[np.ndarray, int]:
    """The tokens of one row up to its split token and those of another from there, by which they are moved."""
    split = predictor.collator.tokenizer.convert_tokens_to_ids(SPLIT_TOKEN)
    ends, start = (int(np.flatnonzero(row.input_ids == split)[0]) for row in (left, right))
    return np.concatenate([left.input_ids[:ends], right.input_ids[start:]]), ends - start


def spliced_pixels(left: VlmBatch, right: VlmBatch, counts: tuple[int, int]) -> dict[str, torch.Tensor]:
    """The first ``counts[0]`` images or videos of one batch of one row, and the last ``counts[1]`` of another's."""
    if "pixel_attention_mask" in left.inputs:
        names, axis = ("pixel_values", "pixel_attention_mask"), 1
        return {n: torch.cat([left.inputs[n][:, : counts[0]], right.inputs[n][:, -counts[1] :]], axis) for n in names}
    grid = next(name for name in left.inputs if name.endswith("grid_thw"))
    pixels = next(name for name in left.inputs if name.startswith("pixel_values"))
    grids = left.inputs[grid][: counts[0]], right.inputs[grid][-counts[1] :]
    patches = [int(of_side.prod(dim=1).sum()) for of_side in grids]
    both = [left.inputs[pixels][: patches[0]], right.inputs[pixels][-patches[1] :]]
    return {grid: torch.cat(grids), pixels: torch.cat(both)}


def on_videos(name: str) -> VlmPredictor:
    """A checkpoint that reads images, as if it had been trained on videos."""
    checkpoint = load(name)
    config = replace(checkpoint.config, multi_image=False, per_frame_progress_token=False)
    base = str(goldens.config(name).base_model)
    return replace(checkpoint, config=config, processor=base).predictor(torch.device("cpu"))


TWO_SIZES: dict[str, Callable[[], VlmPredictor]] = {
    **{config.name: partial(predictor_of, config.name) for config in goldens.VLM},
    f"{PLAIN} on videos": lambda: on_videos(PLAIN),
}


@pytest.mark.parametrize("make", TWO_SIZES.values(), ids=TWO_SIZES)
def test_a_pair_of_two_frame_sizes_is_read_as_its_trajectories_are_beside_one_of_their_own_size(
    make: Callable[[], VlmPredictor],
) -> None:
    """The reference is put together by hand from two pairs of one size each, and scored by the network."""
    predictor = make()
    wide, tall = film(0, 3, 56, 140), film(1, 4, 130, 84)
    pairs = [(wide, tall), (wide, film(2, 4, 56, 140)), (film(3, 3, 130, 84), tall)]
    (row,), (left,), (right,) = (predictor.collator.rows(PreferenceSample(*pair)) for pair in pairs)
    ids, moved = spliced(left, right, predictor)
    np.testing.assert_array_equal(row.input_ids, ids)

    batch, of_left, of_right = (predictor.collate([each]) for each in (row, left, right))
    counts = (3, 4) if predictor.network.config.multi_image else (1, 1)
    pixels = spliced_pixels(of_left, of_right, counts)
    for name, tensor in pixels.items():
        torch.testing.assert_close(batch.inputs[name], tensor, rtol=0, atol=0)

    if not predictor.network.config.multi_image and predictor.network.config.family == QWEN3:
        # There a trajectory's states are read from the vision start of its number on, in the first one's frames.
        start = predictor.collator.tokenizer.convert_tokens_to_ids(VISION_START)
        second = [int(np.flatnonzero(tokens == start)[1]) for tokens in (ids, right.input_ids)]
        moved_spans = second[0] - second[1]
    else:
        moved_spans = moved
    spans = [(0, *span) for span in left.spans[0]] + [(0, a + moved_spans, b + moved_spans) for a, b in right.spans[1]]
    assert right.query is not None
    inputs = {**batch.inputs, **pixels, "input_ids": torch.from_numpy(ids)[None]}
    by_hand = VlmBatch(inputs, torch.tensor(spans), torch.tensor([0]), torch.tensor([right.query + moved]))
    (expected,) = predictor.score([row], by_hand)
    (outcome,) = Engine(predictor).evaluate([PreferenceSample(wide, tall)])
    assert isinstance(outcome, PreferenceResult)
    assert isinstance(expected, RowScores)
    assert outcome.preference == pytest.approx(expected.query, rel=0, abs=1e-6)
    for scores, told in zip((outcome.first, outcome.second), expected.frames, strict=True):
        np.testing.assert_allclose(scores.progress, told.progress, rtol=0, atol=1e-6)
        np.testing.assert_allclose(scores.success, told.success, rtol=0, atol=1e-6)


def test_a_vision_language_model_takes_frames_alone(served: Served, protocol: str) -> None:
    embeddings = Trajectory(video_embeddings=np.ones((2, 8), np.float32), text_embedding=np.ones(8, np.float32))
    (outcome,) = load_engine(PLAIN).evaluate([ProgressSample(embeddings)])
    assert str(outcome) == "video_embeddings: expected frames (this checkpoint reads raw frames), got embeddings"
    with served.client(protocol, PLAIN) as client:
        assert client.is_ready()


BAD: dict[str, tuple[Callable[[], Sample], str]] = {
    "a special token in the task": (
        lambda: ProgressSample(film(0, 1, 56, 56, "lift <|prog_token|> it")),
        "task: expected text without the model's special tokens, got '<|prog_token|>'",
    ),
    "an image token in the task": (
        lambda: PreferenceSample(film(0, 1, 56, 56, "<|image_pad|>"), film(0, 1, 56, 56)),
        "task: expected text without the model's special tokens, got '<|image_pad|>'",
    ),
    "an image that is a line": (
        lambda: ProgressSample(film(0, 1, 1, 300)),
        "frames: expected an image at most 200 times as long as wide, got 1 x 300",
    ),
    "a 20-megapixel frame": (
        lambda: ProgressSample(Trajectory(frames=np.zeros((1, 4000, 5000, 3), np.uint8), task="lift")),
        "num_frames: expected at most 8192 tokens (max_position_embeddings of this checkpoint), got",
    ),
    "similarity without a head": (
        lambda: SimilaritySample(film(0, 1, 56, 56), film(1, 1, 56, 56)),
        "sample_type: expected progress or preference (this checkpoint has no similarity head), got similarity",
    ),
}


@pytest.mark.parametrize(("make", "message"), BAD.values(), ids=BAD)
def test_what_cannot_be_scored_fails_alone(make: Callable[[], Sample], message: str) -> None:
    good = ProgressSample(film(1, 2, 56, 56))
    first, failed, last = load_engine(PLAIN).evaluate([good, make(), good])
    assert isinstance(failed, InvalidSampleError)
    assert str(failed).startswith(message)
    assert_close(first, last, MIXED_TOLERANCE)


@pytest.mark.parametrize(
    "sample",
    [
        ProgressSample(film(0, 1, 1, 1)),
        ProgressSample(film(0, 2, 64, 64, "naïve: 積み木を\nput {task} 'there' " * 20)),
        ProgressSample(film(0, 1, 64, 64, "lift the cup " * 770)),  # 10,000 characters
    ],
    ids=["one pixel", "odd characters", "10,000 characters"],
)
def test_what_is_unusual_is_scored(sample: ProgressSample) -> None:
    (outcome,) = load_engine(PLAIN).evaluate([sample])
    assert isinstance(outcome, ProgressResult)


def test_the_task_is_not_a_template() -> None:
    tokens = predictor_of(PLAIN).collator
    (row,) = tokens.rows(ProgressSample(film(0, 1, 56, 56, "put {task} there")))
    assert "'put {task} there'" in tokens.tokenizer.decode(row.input_ids)


def test_both_frames_of_a_group_carry_its_value() -> None:
    (outcome,) = load_engine("q25_video_last_l2").evaluate([ProgressSample(film(0, 5, 56, 56))])
    assert isinstance(outcome, ProgressResult)
    progress = outcome.progress.tolist()
    assert len(progress) == 5
    assert progress[0] == progress[1]
    assert progress[2] == progress[3]
    assert len(set(progress)) == 3


def test_out_of_memory_halves_the_batch_and_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The CPU has no memory of a device that could run out: the network refuses larger batches in its place."""
    engine = Engine(load_engine(PLAIN).predictor)
    samples = [ProgressSample(film(seed, 2, 56, 56)) for seed in range(5)]
    expected = engine.evaluate(samples)
    score = engine.predictor.score

    def refusing(rows: Sequence[Any], batch: Any) -> Any:
        if len(rows) > 2:
            raise torch.OutOfMemoryError("made up")
        return score(rows, batch)

    monkeypatch.setattr(engine.predictor, "score", refusing)
    execution = Execution()
    for result, other in zip(engine.evaluate(samples, execution), expected, strict=True):
        assert_close(result, other, MIXED_TOLERANCE)
    assert execution.out_of_memory_count == 2  # 5 rows, then the 3 of them


def test_a_sample_that_does_not_fit_in_memory_fails_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = Engine(load_engine(PLAIN).predictor)
    score = engine.predictor.score

    def refusing(rows: Sequence[Any], batch: Any) -> Any:
        if any(len(row.frames[0]) > 2 for row in rows):
            raise torch.OutOfMemoryError("made up")
        return score(rows, batch)

    monkeypatch.setattr(engine.predictor, "score", refusing)
    small, large = ProgressSample(film(0, 2, 56, 56)), ProgressSample(film(0, 3, 56, 56))
    first, failed, last = engine.evaluate([small, large, small])
    assert isinstance(failed, InferenceFailedError)
    assert str(failed) == "the sample does not fit in the device's memory"
    assert_close(first, last, MIXED_TOLERANCE)


def load(name: str, folder: Path | None = None, base: str | None = None) -> VlmCheckpoint:
    config = goldens.config(name)
    checkpoint = families.load(folder or config.checkpoint, base_model=base or str(config.base_model))
    assert isinstance(checkpoint, VlmCheckpoint)
    return checkpoint


@pytest.fixture
def copied(tmp_path: Path) -> Callable[[str], Path]:
    def copy(name: str) -> Path:
        folder = tmp_path / name
        shutil.copytree(goldens.config(name).checkpoint, folder)
        for file in folder.iterdir():
            file.chmod(0o644)
        return folder

    return copy


def test_saving_and_loading_changes_nothing(tmp_path: Path) -> None:
    original = load(LORA_INSIDE)
    original.save(tmp_path / "saved")
    copy = families.load(tmp_path / "saved")
    assert isinstance(copy, VlmCheckpoint)
    assert copy.config == original.config
    assert all(torch.equal(copy.weights[name], original.weights[name]) for name in original.weights)


def test_settings_are_read_from_the_training_run() -> None:
    assert load("q25_video_last_l2").config.size_px == (56, 84)
    assert load(PLAIN).config.progress_in_preference
    assert load(PLAIN).config.per_frame_progress_token
    assert load(BFLOAT16).config.dtype == "bfloat16"
    assert not load("smol_mean_disc10").config.progress_in_preference


def change_yaml(old: str, new: str) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        text = (folder / "config.yaml").read_text()
        assert old in text
        (folder / "config.yaml").write_text(text.replace(old, new))

    return spoil


def change_tensors(file: str, change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        weights = load_file(folder / file)
        change(weights)
        save_file(weights, folder / file)

    return spoil


def change_adapter(**changes: object) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        file = folder / "adapter_config.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | changes))

    return spoil


def drop_first(part: str) -> Callable[[dict[str, Any]], object]:
    return lambda weights: weights.pop(next(name for name in weights if part in name))


SPOILED: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "missing and unexpected keys": (
        PLAIN,
        change_tensors("model.safetensors", lambda w: w.update(surplus=w.pop("success_head.4.bias"))),
        r"missing keys: \['success_head.4.bias'\]; unexpected keys: \['surplus'\]",
    ),
    "no reward heads": (
        PLAIN,
        change_tensors("model.safetensors", lambda w: w.pop("progress_head.4.weight")),
        r"expected reward heads, got no progress_head.4.weight",
    ),
    "a video whose size is not told": (
        "q25_video_last_l2",
        change_yaml("  resized_height: 56\n", ""),
        r"data\.resized_height: expected a number or null, got no such key",
    ),
    "a size that is none": (PLAIN, change_yaml("resized_width: null", "resized_width: wide"), r"data\.resized_width: expected a whole number"),
    "a run of nothing": (PLAIN, lambda folder: (folder / "config.yaml").write_text("{}") and None, r"config\.yaml: model: expected the settings"),
    "text for a truth": (PLAIN, change_yaml("average_temporal_patches: false", "average_temporal_patches: 'false'"), r"average_temporal_patches: expected bool, got 'false'"),
    "a temperature of zero": (PLAIN, change_yaml("attn_temperature: 1.0", "attn_temperature: 0.0"), r"temperature: expected a number above 0, got 0.0"),
    "pairwise progress": (PLAIN, change_yaml("  model_type: default", "  pairwise_progress: true"), r"model\.pairwise_progress: expected false .*, got true"),
    "a pooling that is none": (PLAIN, change_yaml("frame_pooling: mean", "frame_pooling: max"), r"frame_pooling: expected"),
    "a type that is none": (PLAIN, change_yaml("torch_dtype: float32", "torch_dtype: int8"), r"torch_dtype: expected"),
    "tokens without images": (PLAIN, change_yaml("use_multi_image: true", "use_multi_image: false"), r"use_multi_image with per-frame progress tokens: expected true"),
    "answers in generated text": (
        PLAIN,
        change_yaml("model_type: default", "model_type: vqa"),
        r"model\.model_type: expected default, got 'vqa': .* upstream's successor dropped the type",
    ),
    "another model type": (PLAIN, change_yaml("model_type: default", "model_type: dpo"), r"model_type: expected default, got 'dpo'$"),
    "LoRA without alpha": (LORA_INSIDE, change_yaml("lora_alpha: 8", "lora_beta: 8"), r"expected lora_alpha and r of the LoRA weights"),
    "half a LoRA pair": (LORA_INSIDE, change_tensors("model.safetensors", drop_first("lora_B")), r"expected a weight and LoRA factors A and B, got \['A'\]"),
    "LoRA of another kind": (ADAPTER, change_adapter(use_dora=True), r"expected plain LoRA, got use_dora"),
    "an adapter without its embedding": (
        ADAPTER,
        change_tensors("adapter_model.safetensors", drop_first("embed_tokens")),
        r"expected the embedding of the special tokens, got none",
    ),
    "an adapter of another model": (
        ADAPTER,
        change_tensors("adapter_model.safetensors", lambda w: w.update({"base_model.model.other.weight": torch.zeros(1)})),
        r"got also \['model.other.weight'\]",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("name", "spoil", "message"), SPOILED.values(), ids=SPOILED)
def test_a_spoiled_checkpoint_is_refused(
    copied: Callable[[str], Path], name: str, spoil: Callable[[Path], None], message: str
) -> None:
    folder = copied(name)
    spoil(folder)
    with pytest.raises(CheckpointError, match=message):
        load(name, folder).build()


def test_an_adapter_whose_base_model_is_missing_is_refused(copied: Callable[[str], Path]) -> None:
    with pytest.raises(CheckpointError, match=r"base model /no/such/base: cannot be had: .*--base-model"):
        load(ADAPTER, copied(ADAPTER), base="/no/such/base")


def test_smolvlm_is_refused_where_its_scores_would_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = load("smol_mean_disc10")
    monkeypatch.setattr(importlib.metadata, "version", lambda _name: "5.0.0")
    with pytest.raises(CheckpointError, match=r"transformers: expected transformers < 5 for a SmolVLM checkpoint"):
        checkpoint.build()


def test_a_processor_of_another_model_is_refused() -> None:
    other = str(goldens.config(ADAPTER).base_model)
    with pytest.raises(CheckpointError, match=r"expected a tokenizer of 451 tokens .*, got 447"):
        Engine.from_checkpoint(goldens.config(PLAIN).checkpoint, base_model=other)


def test_a_preprocessor_file_as_qwen_publishes_it_is_read(tmp_path: Path) -> None:
    """With few fields, where the references have all that transformers writes."""
    base = tmp_path / "base"
    shutil.copytree(str(goldens.config(PLAIN).base_model), base)
    file = base / "preprocessor_config.json"
    few = ("size", "patch_size", "temporal_patch_size", "merge_size", "image_mean", "image_std")
    fields = {name: value for name, value in json.loads(file.read_text()).items() if name in few}
    file.chmod(0o644)
    file.write_text(json.dumps(fields))
    Engine.from_checkpoint(goldens.config(PLAIN).checkpoint, base_model=str(base))


def test_a_thin_video_is_refused() -> None:
    sample = ProgressSample(film(0, 2, 1, 500))
    (outcome,) = load_engine("q25_video_last_l2").evaluate([sample])
    assert isinstance(outcome, InvalidSampleError)
    assert str(outcome) == "frames: expected an image at most 200 times as long as wide, got 1 x 500"


def rewritten(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """The folder's config.yaml, changed."""
    file = folder / "config.yaml"
    content = yaml.safe_load(file.read_text())
    change(content)
    file.write_text(yaml.safe_dump(content))


def test_fields_that_an_old_upstream_did_not_have_are_what_it_did(copied: Callable[[str], Path]) -> None:
    folder = copied("q25_video_last_l2")
    (folder / "config.yaml").write_text(
        "model: {base_model_id: some/base}\ndata: {resized_height: 56, resized_width: 84}\n"
    )
    config = load("q25_video_last_l2", folder).config
    assert not config.multi_image
    assert not config.per_frame_progress_token
    assert not config.progress_in_preference
    assert not config.average_temporal_patches
    assert (config.frame_pooling, config.pooling_temperature, config.size_px) == ("mean", 1.0, (56, 84))
    assert (config.dtype, config.trained_frames) == ("bfloat16", None)


@pytest.mark.parametrize("name", [PLAIN, ADAPTER, "q25_mean_l2", "q25_video_avg_disc10"])
def test_without_config_yaml_nothing_is_guessed(copied: Callable[[str], Path], name: str) -> None:
    folder = copied(name)
    (folder / "config.yaml").unlink()
    with pytest.raises(CheckpointError, match=r"expected config\.yaml of the training run there, in the folder above"):
        load(name, folder)


def test_config_yaml_is_found_above_the_checkpoint(copied: Callable[[str], Path]) -> None:
    folder = copied(PLAIN)
    (folder / "config.yaml").rename(folder.parent / "config.yaml")
    assert load(PLAIN, folder).config == load(PLAIN).config


def test_what_was_exported_needs_no_config_yaml(tmp_path: Path) -> None:
    load(PLAIN).save(tmp_path / "saved")
    assert not (tmp_path / "saved" / "config.yaml").exists()
    assert families.load(tmp_path / "saved").config == load(PLAIN).config


TWICE = ("use_multi_image", "use_per_frame_progress_token")


@pytest.mark.parametrize("section", ["model", "data"])
def test_either_section_tells_how_frames_are_shown(copied: Callable[[str], Path], section: str) -> None:
    folder = copied(PLAIN)
    rewritten(folder, lambda run: [run[section].pop(key) for key in TWICE])
    assert load(PLAIN, folder).config == load(PLAIN).config


@pytest.mark.parametrize("key", TWICE)
def test_sections_that_disagree_are_refused(copied: Callable[[str], Path], key: str) -> None:
    folder = copied(PLAIN)
    rewritten(folder, lambda run: run["data"].update({key: False}))
    expected = rf"expected model\.{key} and data\.{key} to agree, got model\.{key} true and data\.{key} false"
    with pytest.raises(CheckpointError, match=expected):
        load(PLAIN, folder)


SIZED = {"resized_height": 112, "resized_width": 84}


@pytest.fixture
def sized(copied: Callable[[str], Path]) -> Path:
    """A multi-image checkpoint whose run set a size for frames."""
    folder = copied(PLAIN)
    rewritten(folder, lambda run: run["data"].update(SIZED))
    return folder


def test_a_size_for_images_is_asked_about(sized: Path) -> None:
    with pytest.raises(CheckpointError, match=r"got 112 and 84: .* --resize-images .* --no-resize-images"):
        load(PLAIN, sized)


@pytest.mark.parametrize(("resize_images", "side_px"), [(True, (112, 84)), (False, None)])
def test_a_size_for_images_is_kept_or_ignored_as_told(
    sized: Path, tmp_path: Path, resize_images: bool, side_px: tuple[int, int] | None
) -> None:
    base = str(goldens.config(PLAIN).base_model)
    sample = ProgressSample(film(0, 2, 48, 80))
    resized = ProgressSample(film(0, 2, 48, 80))
    engine = Engine.from_checkpoint(sized, base_model=base, resize_images=resize_images)
    (result,) = engine.evaluate([sample])
    plain = load_engine(PLAIN)
    if side_px is not None:  # what the checkpoint without a size says of frames that were brought to it before
        frames = sample.trajectory.frames
        assert frames is not None
        fitted = fitted_size(*side_px, 32)
        small = np.stack(
            [np.asarray(Image.fromarray(f).resize(fitted[::-1], Image.Resampling.BICUBIC)) for f in frames]
        )
        resized = ProgressSample(Trajectory(frames=small, task=sample.trajectory.task))
    (expected,) = plain.evaluate([resized])
    assert_close(result, expected, 1e-6)

    serve = ServeConfig(num_gpus=0, torch_threads=1, base_model=base, resize_images=resize_images)
    rfm_export.export(sized, tmp_path / "repository", serve)
    text = (tmp_path / "repository" / "rfm_frames" / "config.pbtxt").read_text()
    told = text_format.Parse(text, pb.ModelConfig()).parameters[FRAME_SIZE_PARAMETER].string_value
    assert told == ("" if side_px is None else "exact 128x96")
    exported = families.load(tmp_path / "repository" / "rfm_frames" / "1" / "checkpoint")
    assert isinstance(exported, VlmCheckpoint)
    assert exported.config.size_px == side_px


@pytest.mark.parametrize("resize_images", [True, False, None])
def test_a_size_for_videos_always_holds(resize_images: bool | None) -> None:
    checkpoint = families.load(goldens.config("q25_video_last_l2").checkpoint, resize_images=resize_images)
    assert isinstance(checkpoint, VlmCheckpoint)
    assert checkpoint.config.size_px == (56, 84)


def test_the_processor_s_chat_template_wins_over_the_tokenizer_s(tmp_path: Path) -> None:
    """Upstream prompts by the processor."""
    base = tmp_path / "base"
    shutil.copytree(str(goldens.config(PLAIN).base_model), base, copy_function=shutil.copyfile)
    file = base / "tokenizer_config.json"
    other = {"chat_template": "{% for message in messages %}of the tokenizer{% endfor %}"}
    file.write_text(json.dumps(json.loads(file.read_text()) | other))

    def prompt() -> str:
        template = str(load(PLAIN, base=str(base)).collator.tokenizer.chat_template)
        with tempfile.TemporaryDirectory() as folder:
            saved = Path(folder, "saved")
            load(PLAIN, base=str(base)).save(saved)
            assert families.load(saved).collator.tokenizer.chat_template == template
        return template

    assert prompt() == json.loads((base / "chat_template.json").read_text())["chat_template"]
    (base / "chat_template.json").unlink()
    assert prompt() == other["chat_template"]
    (base / "chat_template.jinja").write_text("of the processor, in its newer file")
    assert prompt() == "of the processor, in its newer file"


class Largest(TorchDispatchMode):
    """Remembers the most elements of a tensor that was made."""

    elements = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = func(*args, **(kwargs or {}))
        for tensor in made if isinstance(made, (tuple, list)) else [made]:
            if isinstance(tensor, torch.Tensor):
                self.elements = max(self.elements, tensor.numel())
        return made


@pytest.mark.parametrize("name", ["q25_attention_disc10", "q25_mean_l2"])
def test_a_long_span_costs_the_short_ones_no_memory(name: str) -> None:
    network = predictor_of(name).network
    width, long, short = network.config.hidden_dim, 4000, 500
    hidden = torch.randn(2, long, width, generator=torch.Generator().manual_seed(0))
    spans = torch.tensor([[0, 0, long], *([1, 2 * at, 2 * at + 2] for at in range(short))])
    with torch.inference_mode(), Largest() as largest:
        together = network._frame_states(hidden, spans)
    assert largest.elements <= (long + 2 * short) * width
    with torch.inference_mode():
        for index in (0, 1, short):
            alone = network._frame_states(hidden, spans[index : index + 1])
            torch.testing.assert_close(together[index : index + 1], alone, rtol=0, atol=1e-6)
        tokens = hidden[0]
        weights = torch.full((long, 1), 1 / long)
        if network.config.frame_pooling == "attention":
            weights = (network.frame_pool_attn(tokens) / network.config.pooling_temperature).softmax(dim=0)
        torch.testing.assert_close(together[0], (weights * tokens).sum(dim=0), rtol=0, atol=1e-6)


SIZES = {
    "rounded": ((60, 90), 28, (56, 84)),
    "at least four tokens": ((1, 1), 28, (56, 56)),
    "at most 16384 tokens": ((4000, 5000), 28, (3192, 4004)),
}


@pytest.mark.parametrize(("size", "factor", "expected"), SIZES.values(), ids=SIZES)
def test_images_are_fitted(size: tuple[int, int], factor: int, expected: tuple[int, int]) -> None:
    fitted = fitted_size(*size, factor)
    assert fitted == expected
    assert 4 <= fitted[0] * fitted[1] / factor**2 <= 16_384


def test_patches_hold_every_pixel_once() -> None:
    images = QwenImages(2, Normalisation((0.0,) * 3, (1 / 255,) * 3))
    frame = np.arange(8 * 8 * 3, dtype=np.uint8).reshape(1, 8, 8, 3)
    (pixels,) = images.images(frame)
    assert pixels.patches.shape == (16, 3 * 2 * 2 * 2)
    first = pixels.patches[0].reshape(3, 2, 2, 2)  # C, frame of the group, rows, columns
    np.testing.assert_allclose(first[:, 0].permute(1, 2, 0).numpy(), frame[0, :2, :2], atol=1e-4)
    assert sorted(pixels.patches.round().int().flatten().tolist()) == sorted(frame.flatten().tolist() * 2)


@pytest.mark.gpu
def test_bfloat16_on_a_gpu_is_near_float32_on_the_cpu() -> None:
    config = goldens.config(BFLOAT16)
    samples = [sample for case in config.cases() for sample in case.samples()]
    on_cpu = load_engine(BFLOAT16).evaluate(samples)
    on_gpu = Engine.from_checkpoint(config.checkpoint, base_model=str(config.base_model), device="cuda").evaluate(
        samples
    )
    for left, right in zip(on_cpu, on_gpu, strict=True):
        assert not isinstance(left, Exception), left
        assert not isinstance(right, Exception), right
        for a, b in zip(goldens.frame_scores(left), goldens.frame_scores(right), strict=True):
            np.testing.assert_allclose(a.progress, b.progress, rtol=0, atol=5e-3)
            np.testing.assert_allclose(a.success, b.success, rtol=0, atol=1.5e-2)
