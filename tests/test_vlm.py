# SPDX-License-Identifier: MIT
"""Vision-language checkpoints: prompts, pixels, forms of checkpoints, batches, bad input."""

from __future__ import annotations

import importlib.metadata
import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import goldens
import numpy as np
import pytest
import torch
from conftest import Served, load_engine
from safetensors.torch import load_file, save_file

from rfm import checkpoint as checkpoints
from rfm.checkpoint import CheckpointError, VlmCheckpoint
from rfm.collate.images import Normalisation, QwenImages, fitted_size
from rfm.engine import Engine
from rfm.execution import Execution
from rfm.families.vlm import VlmFamily
from rfm_client import (
    InferenceFailedError,
    InvalidSampleError,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Sample,
    SimilaritySample,
    Trajectory,
)

WITH_SIMILARITY = "q25_peft_adapter_disc10"  # in the copied references too
BFLOAT16 = "q3_tok_disc10_bf16"
PLAIN = "q3_tok_disc10"
ADAPTER = "q25_peft_adapter_disc10"
LORA_INSIDE = "q3_lora_full_disc10"
PIXEL_TOLERANCE = 1e-6  # relative, of a sum over all pixels
MIXED_TOLERANCE = 1e-4


def family_of(name: str) -> VlmFamily:
    family = load_engine(name).family
    assert isinstance(family, VlmFamily)
    return family


def arrays_of(case: goldens.Case) -> dict[str, np.ndarray]:
    return dict(np.load(case.file.with_suffix("").with_suffix(".expected.npz")))


def by_type(samples: Sequence[Sample]) -> dict[str, list[Sample]]:
    kinds: dict[str, list[Sample]] = {}
    for sample in samples:
        kinds.setdefault(goldens.sample_type(sample), []).append(sample)
    return kinds


BATCHED = [case for case in goldens.VLM_CASES if not case.is_refused and case.content["kind"] != "ragg"]


@pytest.mark.parametrize("case", BATCHED, ids=str)
def test_token_ids_and_pixels_are_those_of_the_original(case: goldens.Case) -> None:
    family, arrays, content = family_of(case.config.name), arrays_of(case), case.content
    for kind, samples in by_type(case.samples()).items():
        if f"{kind}.collated.input_ids" not in arrays:  # evaluated one by one
            continue
        rows = [row for outcome in family.rows(samples, Execution()) if isinstance(outcome, list) for row in outcome]
        inputs = family.collate(rows).inputs
        for name in ("input_ids", "attention_mask", "image_grid_thw", "video_grid_thw"):
            if f"{kind}.collated.{name}" in arrays:
                np.testing.assert_array_equal(inputs[name].numpy(), arrays[f"{kind}.collated.{name}"])
        pixels = content["pixels"][kind]
        made = inputs[pixels["key"]].double()
        assert list(made.shape) == pixels["shape"]
        assert abs(float(made.sum()) - pixels["sum"]) <= PIXEL_TOLERANCE * pixels["abs_sum"]
        assert abs(float(made.abs().sum()) - pixels["abs_sum"]) <= PIXEL_TOLERANCE * pixels["abs_sum"]


@pytest.mark.parametrize("case", goldens.VLM_CASES, ids=str)
def test_the_engine_gives_every_reference_answer(case: goldens.Case) -> None:
    outcomes = load_engine(case.config.name).evaluate(case.samples())
    results = [outcome for outcome in outcomes if not isinstance(outcome, Exception)]
    for result, expected in zip(results, case.expected(), strict=True):
        goldens.check(result, expected, case.tolerances())
    case.check_response(results)


@pytest.mark.parametrize("case", goldens.config(BFLOAT16).cases(), ids=str)
def test_bfloat16_is_the_original_s_bfloat16(case: goldens.Case) -> None:
    config = case.config
    engine = Engine.from_checkpoint(config.checkpoint, base_model=str(config.base_model), dtype=torch.bfloat16)
    results = [outcome for outcome in engine.evaluate(case.samples()) if not isinstance(outcome, Exception)]
    for result, expected in zip(results, case.expected(bfloat16=True), strict=True):
        goldens.check(result, expected, case.tolerances(bfloat16=True))


def film(seed: int, num_frames: int, height: int, width: int, task: str = "stack the blocks") -> Trajectory:
    frames = np.random.default_rng(seed).integers(0, 256, (num_frames, height, width, 3), np.uint8)
    return Trajectory(frames=frames, task=task)


def mixture() -> list[Sample]:
    """T = 2, 8, 16; three image sizes; all three types."""
    samples: list[Sample] = []
    for seed, (num_frames, (height, width)) in enumerate(
        (count, size) for count in (2, 8, 16) for size in ((56, 56), (64, 100), (90, 61))
    ):
        samples.append(ProgressSample(film(seed, num_frames, height, width, f"task {seed}")))
        samples.append(PreferenceSample(film(seed, num_frames, height, width), film(seed + 50, 3, height, width)))
        samples.append(SimilaritySample(film(seed, 1, height, width), film(seed + 90, num_frames, height, width)))
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
    engine = Engine(load_engine(name).family, token_budget=token_budget)
    order = np.random.default_rng(0).permutation(len(samples))
    together = engine.evaluate([samples[index] for index in order])
    for index, outcome in zip(order, together, strict=True):
        assert_close(outcome, engine.evaluate([samples[index]])[0], MIXED_TOLERANCE)


def test_a_mixture_over_the_wire_equals_its_samples_alone(served: Served, protocol: str) -> None:
    samples = mixture()
    alone = [load_engine(WITH_SIMILARITY).evaluate([sample])[0] for sample in samples]
    with served.client(protocol, WITH_SIMILARITY) as client:
        for result, expected in zip(client.evaluate(samples), alone, strict=True):
            assert_close(result, expected, MIXED_TOLERANCE)


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
        "num_frames: expected at most 16384 tokens (token_budget of this server), got",
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
    assert_close(first, last, 1e-5)


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
    tokens = family_of(PLAIN).collator
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
    engine = Engine(load_engine(PLAIN).family)
    samples = [ProgressSample(film(seed, 2, 56, 56)) for seed in range(5)]
    expected = engine.evaluate(samples)
    score = engine.family.score

    def refusing(rows: Sequence[Any], batch: Any) -> Any:
        if len(rows) > 2:
            raise torch.OutOfMemoryError("made up")
        return score(rows, batch)

    monkeypatch.setattr(engine.family, "score", refusing)
    execution = Execution()
    for result, other in zip(engine.evaluate(samples, execution), expected, strict=True):
        assert_close(result, other, 1e-5)
    assert execution.out_of_memory_count == 2  # 5 rows, then the 3 of them


def test_a_sample_that_does_not_fit_in_memory_fails_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = Engine(load_engine(PLAIN).family)
    score = engine.family.score

    def refusing(rows: Sequence[Any], batch: Any) -> Any:
        if any(len(row.frames[0]) > 2 for row in rows):
            raise torch.OutOfMemoryError("made up")
        return score(rows, batch)

    monkeypatch.setattr(engine.family, "score", refusing)
    small, large = ProgressSample(film(0, 2, 56, 56)), ProgressSample(film(0, 3, 56, 56))
    first, failed, last = engine.evaluate([small, large, small])
    assert isinstance(failed, InferenceFailedError)
    assert str(failed) == "the sample does not fit in the device's memory"
    assert_close(first, last, 1e-5)


def load(name: str, folder: Path | None = None, base: str | None = None) -> VlmCheckpoint:
    config = goldens.config(name)
    checkpoint = checkpoints.load(folder or config.checkpoint, base_model=base or str(config.base_model))
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
    checkpoints.save(original, tmp_path / "saved")
    copy = checkpoints.load(tmp_path / "saved")
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
    "a pooling that is none": (PLAIN, change_yaml("frame_pooling: mean", "frame_pooling: max"), r"frame_pooling: expected"),
    "a type that is none": (PLAIN, change_yaml("torch_dtype: float32", "torch_dtype: int8"), r"torch_dtype: expected"),
    "tokens without images": (PLAIN, change_yaml("use_multi_image: true", "use_multi_image: false"), r"per-frame progress tokens: expected"),
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


def test_fields_that_a_config_lacks_have_defaults(copied: Callable[[str], Path]) -> None:
    folder = copied("q25_video_last_l2")
    (folder / "config.yaml").write_text("model:\n  base_model_id: some/base\n")
    config = load("q25_video_last_l2", folder).config
    assert not config.multi_image
    assert not config.per_frame_progress_token
    assert not config.progress_in_preference
    assert (config.frame_pooling, config.pooling_temperature, config.size_px) == ("mean", 1.0, None)


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
