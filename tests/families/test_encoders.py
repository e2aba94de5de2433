# SPDX-License-Identifier: MIT
from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import goldens
from engines import load_engine
from rfm import families
from rfm.checkpoint.content import PREPROCESSOR_CONFIG, CheckpointError
from rfm.engine.execution import Execution
from rfm.rewind.encoders import Encoders, ImagePreprocessor
from rfm_client import (
    BatchTiming,
    InferenceFailedError,
    InvalidSampleError,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    RewardError,
    SimilaritySample,
    Trajectory,
)
from rfm_client.contract.samples import Footage

NAME = "enc_c1_t1_disc10"
# The original's embeddings, of images and of texts.
EMBEDDING_TOLERANCE = 5e-6  # seen: 6e-7


@pytest.fixture
def encoders() -> Encoders:
    encoders = load_engine(NAME).encoders
    assert encoders is not None
    return encoders


CASES = [case for config in goldens.WITH_ENCODERS for case in config.cases()]
WITH_PIXELS = [case for case in CASES if any("pixel_values" in key for key in case.content["expected_arrays"])]


def footage(frames: np.ndarray, task: str) -> Footage:
    """Of one trajectory."""
    return Footage((Trajectory(frames=frames, task=task),))


def positions(encoded: Footage) -> np.ndarray:
    """The embeddings of all frames, one trajectory after the other."""
    return np.concatenate([trajectory.positions for trajectory in encoded.trajectories])


def assert_same(left: object, right: object) -> None:
    assert not isinstance(left, RewardError), left
    assert not isinstance(right, RewardError), right
    for a, b in zip(goldens.frame_scores(left), goldens.frame_scores(right), strict=True):  # type: ignore[arg-type]
        np.testing.assert_allclose(a.progress, b.progress, rtol=0, atol=1e-5)
        np.testing.assert_allclose(a.success, b.success, rtol=0, atol=1e-5)
    for name in ("preference", "similarity"):
        if hasattr(left, name):
            assert abs(getattr(left, name) - getattr(right, name)) <= 1e-5


def cases_arrays(case: goldens.Case) -> dict[str, np.ndarray]:
    return dict(np.load(case.file.with_suffix("").with_suffix(".expected.npz")))


@pytest.mark.reference
@pytest.mark.parametrize("case", WITH_PIXELS, ids=str)
def test_pixels_are_those_of_the_original(case: goldens.Case, encoders: Encoders) -> None:
    expected = next(array for key, array in cases_arrays(case).items() if "pixel_values" in key)
    frames = [trajectory.frames for sample in case.samples() for trajectory in sample.trajectories]
    pixels = torch.cat([encoders.preprocessor(torch.from_numpy(video)) for video in frames if video is not None])
    np.testing.assert_allclose(pixels.numpy(), expected.reshape(pixels.shape), rtol=0, atol=1e-6)


@pytest.mark.reference
@pytest.mark.parametrize("case", [case for case in CASES if "steps" not in case.content["kind"]], ids=str)
def test_embeddings_are_those_of_the_original(case: goldens.Case) -> None:
    encoders = load_engine(case.config.name).encoders
    assert encoders is not None
    arrays = cases_arrays(case)
    samples = case.samples()
    films = [Footage(sample.trajectories) for sample in samples]
    kind = goldens.sample_type(samples[0])
    for row, encoded in enumerate(encoders.encode(films)):
        assert isinstance(encoded, Footage)
        expected_video, expected_text = (arrays[f"{kind}.encoder.{name}_embeddings"][row] for name in ("video", "text"))
        np.testing.assert_allclose(positions(encoded), expected_video, rtol=0, atol=EMBEDDING_TOLERANCE)
        np.testing.assert_allclose(
            encoded.trajectories[0].text_embedding, expected_text, rtol=0, atol=EMBEDDING_TOLERANCE
        )


def test_a_trajectory_is_encoded_as_alone(encoders: Encoders) -> None:
    random = np.random.default_rng(0)
    shapes = ((1, 64, 64), (70, 48, 100), (3, 1, 1), (130, 20, 31))
    films = [
        footage(random.integers(0, 256, (*shape, 3), np.uint8), f"lift {'the cup ' * index}")
        for index, shape in enumerate(shapes)
    ]
    for film, together in zip(films, encoders.encode(films), strict=True):
        (alone,) = encoders.encode([film])
        assert isinstance(together, Footage)
        assert isinstance(alone, Footage)
        np.testing.assert_allclose(positions(together), positions(alone), rtol=0, atol=EMBEDDING_TOLERANCE)
        texts = [encoded.trajectories[0].text_embedding for encoded in (together, alone)]
        np.testing.assert_allclose(*texts, rtol=0, atol=EMBEDDING_TOLERANCE)


def test_a_task_that_is_too_long_fails_alone(encoders: Encoders) -> None:
    frames = np.zeros((2, 30, 30, 3), np.uint8)
    films = [footage(frames, task) for task in ("lift", "lift " * 100, "drop")]
    first, failed, last = encoders.encode(films)
    assert isinstance(failed, InvalidSampleError)
    assert str(failed).startswith("task: expected at most 32 tokens (limit of the text encoder), got ")
    assert not isinstance(first, RewardError)
    assert not isinstance(last, RewardError)


def film(seed: int, num_frames: int, task: str = "lift the cup") -> Footage:
    return footage(np.random.default_rng(seed).integers(0, 256, (num_frames, 40, 40, 3), np.uint8), task)


def sized(seed: int, num_frames: int, height: int, width: int) -> Trajectory:
    frames = np.random.default_rng(seed).integers(0, 256, (num_frames, height, width, 3), np.uint8)
    return Trajectory(frames=frames, task=f"lift cup {seed}")


@pytest.mark.parametrize("kind", [PreferenceSample, SimilaritySample])
def test_a_pair_of_two_frame_sizes_is_scored_from_the_embeddings_of_each_trajectory(
    encoders: Encoders, kind: type[PreferenceSample] | type[SimilaritySample]
) -> None:
    first, second = sized(1, 5, 48, 100), sized(2, 3, 90, 61)
    apart = encoders.encode([Footage((t,)) for t in (first, replace(second, task=first.task))])
    embedded = [encoded.trajectories[0] for encoded in apart if isinstance(encoded, Footage)]
    expected, pair = load_engine(NAME).evaluate([kind(*embedded), kind(first, second)])
    assert_same(pair, expected)


def test_a_pair_of_one_frame_size_is_encoded_as_one_film(encoders: Encoders) -> None:
    """To the bit, also where its frames are those of two forward passes."""
    first, second = sized(1, 40, 48, 100), sized(2, 40, 48, 100)
    (pair,) = encoders.encode([Footage((first, second))])
    (film,) = encoders.encode_frames([np.concatenate([first.positions, second.positions])])
    assert isinstance(pair, Footage)
    assert [trajectory.num_frames for trajectory in pair.trajectories] == [40, 40]
    np.testing.assert_array_equal(positions(pair), film)
    for trajectory in pair.trajectories:
        np.testing.assert_array_equal(trajectory.text_embedding, encoders.encode_tasks([first.task])[0])


def refuse(model: torch.nn.Module, is_too_large: Callable[[Tensor], bool], monkeypatch: pytest.MonkeyPatch) -> None:
    """The CPU has no memory of a device that could run out: the model refuses what it is given in its place."""
    forward = model.forward

    def refusing(*arguments: Tensor, **named: Tensor) -> Any:
        if is_too_large(next(iter((*arguments, *named.values())))):
            raise torch.OutOfMemoryError("made up")
        return forward(*arguments, **named)

    monkeypatch.setattr(model, "forward", refusing)


def test_out_of_memory_halves_images_and_tasks_and_is_counted(
    encoders: Encoders, monkeypatch: pytest.MonkeyPatch
) -> None:
    films = [film(0, 3), film(1, 2, "push the red button"), film(2, 70)]
    expected = encoders.encode(films)
    refuse(encoders.image_model, lambda images: len(images) > 20, monkeypatch)
    refuse(encoders.text_model, lambda tokens: len(tokens) > 1, monkeypatch)
    execution, passes = Execution(), []
    execution.on_forward = lambda: passes.append(None)
    for encoded, other in zip(encoders.encode(films, execution), expected, strict=True):
        assert isinstance(encoded, Footage)
        assert isinstance(other, Footage)
        np.testing.assert_allclose(positions(encoded), positions(other), rtol=0, atol=EMBEDDING_TOLERANCE)
        texts = [each.trajectories[0].text_embedding for each in (encoded, other)]
        np.testing.assert_allclose(*texts, rtol=0, atol=EMBEDDING_TOLERANCE)
    assert execution.out_of_memory_count == 3 + 2  # images: 64 and its halves; tasks: all three and the last two
    assert len(passes) == 3 + 2 + (4 + 1) + 3  # ... and what fitted: four times 16 and 11 images; each task


def test_a_film_that_does_not_fit_in_memory_fails_alone(encoders: Encoders, monkeypatch: pytest.MonkeyPatch) -> None:
    white = footage(np.full((3, 40, 40, 3), 255, np.uint8), "lift the cup")
    white_pixel = encoders.preprocessor(torch.full((1, 40, 40, 3), 255, dtype=torch.uint8))[0, 0].max()
    refuse(encoders.image_model, lambda images: bool((images[:, 0].amin(dim=(1, 2)) == white_pixel).any()), monkeypatch)
    first, failed, last = encoders.encode([film(0, 3), white, film(0, 3)])
    assert isinstance(failed, InferenceFailedError)
    assert str(failed) == "the sample does not fit in the device's memory"
    assert isinstance(first, Footage)
    assert isinstance(last, Footage)
    np.testing.assert_allclose(positions(first), positions(last), rtol=0, atol=EMBEDDING_TOLERANCE)


def test_what_the_encoders_take_is_forward_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that says that each of their forward passes takes an hour."""
    engine = load_engine(NAME)
    encoders = load_engine(NAME).encoders
    assert encoders is not None
    hours = [0]
    seconds = time.perf_counter
    monkeypatch.setattr(time, "perf_counter", lambda: seconds() + 3600 * hours[0])
    for model in (encoders.image_model, encoders.text_model):

        def passing(*arguments: Any, forward: Any = model.forward, **named: Any) -> Any:
            hours[0] += 1
            return forward(*arguments, **named)

        monkeypatch.setattr(model, "forward", passing)
    execution = Execution()
    (result,) = engine.evaluate([ProgressSample(film(0, 3).trajectories[0])], execution)
    assert isinstance(result, ProgressResult)
    assert result.timing is not None
    assert hours == [2]
    assert execution.forward_s == pytest.approx(2 * 3600, abs=60)
    assert execution.collate_s < 60
    assert result.timing == BatchTiming(execution.collate_s * 1e3, execution.forward_s * 1e3)


def test_special_tokens_in_a_task_are_text(encoders: Encoders) -> None:
    plain, special = encoders.encode_tasks(["a [ SEP ] b [ PAD ]", "a [SEP] b [PAD]"])
    np.testing.assert_allclose(plain, special, rtol=0, atol=1e-6)


def test_saving_and_loading_changes_nothing(encoders: Encoders, tmp_path: Path) -> None:
    encoders.save(tmp_path)
    copy = Encoders.from_pretrained(tmp_path / "image_encoder", tmp_path / "text_encoder")
    frames = [np.random.default_rng(0).integers(0, 256, (2, 50, 70, 3), np.uint8)]
    np.testing.assert_array_equal(copy.encode_frames(frames)[0], encoders.encode_frames(frames)[0])
    np.testing.assert_array_equal(copy.encode_tasks(["lift the cup"]), encoders.encode_tasks(["lift the cup"]))


def test_a_checkpoints_own_encoder_weights_win(encoders: Encoders) -> None:
    config = goldens.config(NAME)
    assert config.image_encoder is not None
    assert config.text_encoder is not None
    base = Encoders.from_pretrained(config.image_encoder, config.text_encoder)
    weights = {name: tensor + 0.1 for name, tensor in base.image_model.state_dict().items()}
    changed = Encoders.from_pretrained(config.image_encoder, config.text_encoder, image_weights=weights)
    frames = [np.full((1, 64, 64, 3), 99, np.uint8)]
    assert np.abs(changed.encode_frames(frames)[0] - base.encode_frames(frames)[0]).max() > 1e-3
    np.testing.assert_array_equal(changed.encode_tasks(["lift"]), base.encode_tasks(["lift"]))


def test_encoder_weights_that_do_not_fit_are_named() -> None:
    config = goldens.config(NAME)
    assert config.image_encoder is not None
    assert config.text_encoder is not None
    weights = {"embeddings.cls_token": torch.zeros(1, 1, 48)}
    with pytest.raises(ValueError, match=r"the encoder's weights do not fit: \{'missing_keys': .*'layernorm.weight'"):
        Encoders.from_pretrained(config.image_encoder, config.text_encoder, image_weights=weights)


@pytest.mark.gpu
def test_the_gpu_gives_the_embeddings_of_the_cpu(encoders: Encoders) -> None:
    frames = [np.random.default_rng(0).integers(0, 256, (5, 50, 70, 3), np.uint8)]
    on_cpu = encoders.encode_frames(frames)[0]
    try:
        on_gpu = encoders.to(torch.device("cuda")).encode_frames(frames)[0]
    finally:
        encoders.to(torch.device("cpu"))
    np.testing.assert_allclose(on_gpu, on_cpu, rtol=0, atol=1e-4)


UNSUPPORTED = {
    "no resize": ({"do_resize": False}, "do_resize: expected True, got False"),
    "bilinear": ({"resample": 2}, "resample: expected 3, got 2"),
    "another scale": ({"rescale_factor": 1.0}, "rescale_factor: expected 1/255, got 1.0"),
    "fixed size": ({"size": {"height": 3, "width": 3}}, "expected size {shortest_edge}"),
    "a number of a processor of squares": (
        {"size": 64, "image_processor_type": "ViTImageProcessor"},
        "expected size {shortest_edge} and crop_size {height, width}, got 64 and",
    ),
    "a size of half a pixel": ({"size": {"shortest_edge": 0.5}}, "expected size {shortest_edge}"),
}


@pytest.mark.parametrize(("change", "message"), UNSUPPORTED.values(), ids=UNSUPPORTED)
def test_a_preprocessor_that_works_otherwise_is_refused(
    tmp_path: Path, change: dict[str, object], message: str
) -> None:
    config = goldens.config(NAME)
    assert config.image_encoder is not None
    assert config.text_encoder is not None
    shutil.copytree(config.image_encoder, tmp_path / "image")
    file = tmp_path / "image" / PREPROCESSOR_CONFIG
    content = json.loads(file.read_text()) | change
    file.chmod(0o644)
    file.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        Encoders.from_pretrained(tmp_path / "image", config.text_encoder)


def test_sizes_may_be_numbers_as_transformers_once_wrote_them(encoders: Encoders, tmp_path: Path) -> None:
    encoders.save(tmp_path)
    file = tmp_path / "image_encoder" / PREPROCESSOR_CONFIG
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"size": 64, "crop_size": 56}))
    assert Encoders.load(tmp_path).preprocessor == encoders.preprocessor
    assert (encoders.preprocessor.resize_px, encoders.preprocessor.crop_px) == (64, (56, 56))


def without_tokenizer(folder: Path) -> None:
    for file in (folder / "text_encoder").iterdir():
        if file.name not in ("config.json", "model.safetensors"):
            file.unlink()


def of_type(which: str, **config: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / which / "config.json").write_text(json.dumps(config))

    return change


def whole_and_in_shards(folder: Path) -> None:
    (folder / "image_encoder" / "model.safetensors.index.json").write_text('{"weight_map": {}}')


def too_many_words(folder: Path) -> None:
    file = folder / "text_encoder" / "tokenizer.json"
    content = json.loads(file.read_text())
    content["model"]["vocab"] |= {f"word{index}": 1000 + index for index in range(200)}
    file.write_text(json.dumps(content))


IMAGE_MODEL = r"image_encoder: model_type: expected one of dinov2, dinov2_with_registers, got "
TEXT_MODEL = r"text_encoder: model_type: expected one of bert, .*, got "
MISFITS: dict[str, tuple[Callable[[Path], None], str]] = {
    "no files of a tokenizer": (without_tokenizer, r"text_encoder: expected files of a tokenizer \(tokenizer\.json, or vocab"),
    "a tokenizer of more words": (too_many_words, r"text_encoder: expected a tokenizer of at most 180 tokens, got 3"),
    "ViT": (of_type("image_encoder", model_type="vit"), IMAGE_MODEL + "vit"),
    "T5": (of_type("text_encoder", model_type="t5"), TEXT_MODEL + "t5"),
    "weights whole and in shards": (whole_and_in_shards, r"image_encoder: expected model\.safetensors or shards, got"),
}  # fmt: skip


@pytest.mark.parametrize(("change", "message"), MISFITS.values(), ids=MISFITS)
def test_encoders_that_do_not_fit_are_refused(
    encoders: Encoders, tmp_path: Path, change: Callable[[Path], None], message: str
) -> None:
    encoders.save(tmp_path)
    change(tmp_path)
    with pytest.raises((ValueError, CheckpointError), match=message):
        Encoders.load(tmp_path)


def test_an_encoder_s_settings_of_another_type_are_told(encoders: Encoders, tmp_path: Path) -> None:
    encoders.save(tmp_path)
    file = tmp_path / "image_encoder" / "config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"hidden_size": "x"}))
    sources = {which: str(tmp_path / which) for which in ("image_encoder", "text_encoder")}
    checkpoint = families.load(goldens.config(NAME).checkpoint, **sources)
    with pytest.raises(CheckpointError, match=r"^encoders .* \(name local folders with --image-encoder"):
        checkpoint.encoders()


NO_ROOM = """
import resource, sys
room, checkpoint, image, text = sys.argv[1:]
resource.setrlimit(resource.RLIMIT_FSIZE, (int(room), int(room)))
from rfm import families
from rfm.checkpoint.content import CheckpointError
from rfm_commands.engine_scorer import EngineScorer
options = {"image_encoder": image, "text_encoder": text}
families.load(checkpoint, **options).encoders()
try:
    EngineScorer(checkpoint, **options)
except CheckpointError as error:
    sys.exit(str(error))
"""


@pytest.mark.slow
def test_a_full_folder_of_temporary_files_is_told() -> None:
    """Loading needs none."""
    config = goldens.config(NAME)
    folders = (config.checkpoint, config.image_encoder, config.text_encoder)
    command = [sys.executable, "-B", "-c", NO_ROOM, "4096", *map(str, folders)]
    done = subprocess.run(command, check=False, stderr=subprocess.PIPE, text=True)
    assert "TMPDIR: expected a folder of temporary files with room for a copy of the encoders, got: " in done.stderr
    assert done.stderr.endswith("; name another one with it\n")


# Of a picture of 4 x 4 pixels: the crop, and where the picture begins in it, or the crop in the picture where it is less.
CROPS = {
    "both smaller, evenly": ((6, 8), (1, 2)),
    "both smaller, by odd counts: more zeros behind": ((7, 5), (1, 0)),
    "height smaller, width larger": ((9, 2), (2, -1)),
    "height larger, width smaller": ((3, 7), (0, 1)),
    "as large": ((4, 4), (0, 0)),
}


@pytest.mark.parametrize(("crop_px", "offset"), CROPS.values(), ids=CROPS)
def test_images_smaller_than_the_crop_are_padded(crop_px: tuple[int, int], offset: tuple[int, int]) -> None:
    picture = np.arange(1, 17, dtype=np.float32).reshape(4, 4)
    wide = np.zeros((20, 20), np.float32)
    wide[8 : 8 + 4, 8 : 8 + 4] = picture
    top, left = 8 - offset[0], 8 - offset[1]
    preprocessor = ImagePreprocessor(resize_px=4, crop_px=crop_px, mean=(0.0,) * 3, std=(1 / 255,) * 3)
    made = preprocessor(torch.from_numpy(picture.astype(np.uint8))[None, ..., None].expand(1, 4, 4, 3))[0, 0]
    np.testing.assert_allclose(made, wide[top : top + crop_px[0], left : left + crop_px[1]], rtol=1e-6)
