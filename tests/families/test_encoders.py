# SPDX-License-Identifier: MIT
from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import goldens
from engines import load_engine
from rfm.engine import Execution
from rfm.families.rewind.encoders import Encoders, ImagePreprocessor
from rfm.files import PREPROCESSOR_CONFIG
from rfm_client import (
    InferenceFailedError,
    PreferenceSample,
    RewardError,
    SimilaritySample,
    Trajectory,
)
from rfm_client.contract.samples import EncoderSample
from spoilt import in_json
from vlm import assert_close, video

NAME = "enc_c1_t1_disc10"
# The original's embeddings, of images and of texts.
EMBEDDING_TOLERANCE = 5e-6  # seen: 6e-7


@pytest.fixture
def encoders() -> Encoders:
    return encoders_of(NAME)


CASES = [case for config in goldens.WITH_ENCODERS for case in config.cases()]
WITH_PIXELS = [case for case in CASES if any("pixel_values" in key for key in case.content["expected_arrays"])]


def encoders_of(name: str) -> Encoders:
    encoders = load_engine(name).encoders
    assert isinstance(encoders, Encoders)
    return encoders


def encoded(outcome: EncoderSample | RewardError) -> tuple[np.ndarray, np.ndarray]:
    """Return the embeddings of all frames in order, and of the task."""
    assert isinstance(outcome, EncoderSample), outcome
    task = outcome.trajectories[0].text_embedding
    assert task is not None
    return np.concatenate([trajectory.positions for trajectory in outcome.trajectories]), task


def assert_encoded(outcome: EncoderSample | RewardError, expected: Sequence[Any]) -> None:
    for got, wanted in zip(encoded(outcome), expected, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=0, atol=EMBEDDING_TOLERANCE)


def footage(seed: int, num_frames: int, height: int = 40, width: int = 40, task: str = "lift the cup") -> EncoderSample:
    return EncoderSample((video(seed, num_frames, height, width, task),))


@pytest.mark.reference
@pytest.mark.parametrize("case", WITH_PIXELS, ids=str)
def test_pixels_are_those_of_the_original(case: goldens.Case, encoders: Encoders) -> None:
    expected = next(array for key, array in case.arrays.items() if "pixel_values" in key)
    videos = [trajectory.positions for sample in case.samples() for trajectory in sample.trajectories]
    pixels = torch.cat([encoders.preprocessor(torch.from_numpy(video)) for video in videos])
    np.testing.assert_allclose(pixels.numpy(), expected.reshape(pixels.shape), rtol=0, atol=1e-6)


@pytest.mark.reference
@pytest.mark.parametrize("case", [case for case in CASES if "steps" not in case.content["kind"]], ids=str)
def test_embeddings_are_those_of_the_original(case: goldens.Case) -> None:
    samples, arrays = case.samples(), case.arrays
    kind = goldens.sample_type(samples[0])
    expected = [arrays[f"{kind}.encoder.{name}_embeddings"] for name in ("video", "text")]
    outcomes = encoders_of(case.config.name).encode([EncoderSample(sample.trajectories) for sample in samples])
    for row, outcome in enumerate(outcomes):
        assert_encoded(outcome, [array[row] for array in expected])


def test_a_trajectory_is_encoded_as_alone(encoders: Encoders) -> None:
    shapes = ((1, 64, 64), (70, 48, 100), (3, 1, 1), (130, 20, 31))
    videos = [footage(index, *shape, f"lift {'the cup ' * index}") for index, shape in enumerate(shapes)]
    for alone, together in zip(videos, encoders.encode(videos), strict=True):
        assert_encoded(together, encoded(encoders.encode([alone])[0]))


@pytest.mark.parametrize("kind", [PreferenceSample, SimilaritySample])
def test_a_pair_of_two_frame_sizes_is_scored_from_the_embeddings_of_each_trajectory(
    encoders: Encoders, kind: type[PreferenceSample] | type[SimilaritySample]
) -> None:
    first, second = video(1, 5, 48, 100), video(2, 3, 90, 61)
    apart = encoders.encode([EncoderSample((first,)), EncoderSample((second,))])
    embedded = [outcome.trajectories[0] for outcome in apart if isinstance(outcome, EncoderSample)]
    expected, pair = load_engine(NAME).evaluate([kind(*embedded), kind(first, second)])
    assert_close(pair, expected, 1e-5)


def test_a_pair_of_one_frame_size_is_encoded_as_one_video(encoders: Encoders) -> None:
    """Bit for bit, also where the frames take two forward passes."""
    first, second = video(1, 40, 48, 100), video(2, 40, 48, 100)
    (pair,) = encoders.encode([EncoderSample((first, second))])
    (as_one,) = encoders.encode_frames([np.concatenate([first.positions, second.positions])])
    assert isinstance(pair, EncoderSample)
    assert [trajectory.num_frames for trajectory in pair.trajectories] == [40, 40]
    np.testing.assert_array_equal(encoded(pair)[0], as_one)
    for trajectory in pair.trajectories:
        np.testing.assert_array_equal(trajectory.text_embedding, encoders.encode_tasks([first.task])[0])


def refuse(model: torch.nn.Module, is_too_large: Callable[[Tensor], bool], monkeypatch: pytest.MonkeyPatch) -> None:
    """A CPU has no device memory to exhaust, so the model itself refuses large inputs."""
    forward = model.forward

    def refusing(*arguments: Tensor, **named: Tensor) -> Any:
        if is_too_large(next(iter((*arguments, *named.values())))):
            raise torch.OutOfMemoryError("made up")
        return forward(*arguments, **named)

    monkeypatch.setattr(model, "forward", refusing)


def test_out_of_memory_halves_images_and_tasks_and_is_counted(
    encoders: Encoders, monkeypatch: pytest.MonkeyPatch
) -> None:
    videos = [footage(0, 3), footage(1, 2, task="push the red button"), footage(2, 70)]
    expected = encoders.encode(videos)
    refuse(encoders.image_model, lambda images: len(images) > 20, monkeypatch)
    refuse(encoders.text_model, lambda tokens: len(tokens) > 1, monkeypatch)
    execution, passes = Execution(), []
    execution.on_forward = lambda: passes.append(None)
    for outcome, other in zip(encoders.encode(videos, execution), expected, strict=True):
        assert_encoded(outcome, encoded(other))
    assert execution.out_of_memory_count == 3 + 2  # images: 64, then halves; tasks: all three, then the last two
    assert len(passes) == 3 + 2 + (4 + 1) + 3  # ... and the fitting ones: four times 16 and 11 images; each task


def test_a_video_that_does_not_fit_in_memory_fails_alone(encoders: Encoders, monkeypatch: pytest.MonkeyPatch) -> None:
    white = EncoderSample((Trajectory(frames=np.full((3, 40, 40, 3), 255, np.uint8), task="lift the cup"),))
    white_pixel = encoders.preprocessor(torch.full((1, 40, 40, 3), 255, dtype=torch.uint8))[0, 0].max()
    refuse(encoders.image_model, lambda images: bool((images[:, 0].amin(dim=(1, 2)) == white_pixel).any()), monkeypatch)
    first, failed, last = encoders.encode([footage(0, 3), white, footage(0, 3)])
    assert isinstance(failed, InferenceFailedError)
    assert str(failed) == "the sample does not fit in the device's memory"
    assert_encoded(first, encoded(last))


def test_special_tokens_in_a_task_are_text(encoders: Encoders) -> None:
    plain, special = encoders.encode_tasks(["a [ SEP ] b [ PAD ]", "a [SEP] b [PAD]"])
    np.testing.assert_allclose(plain, special, rtol=0, atol=1e-6)


def test_a_checkpoints_own_encoder_weights_win_and_must_fit(encoders: Encoders) -> None:
    sources = [goldens.config(NAME).sources[name] for name in ("image_encoder", "text_encoder")]
    base = Encoders.from_pretrained(*sources)
    weights = {name: tensor + 0.1 for name, tensor in base.image_model.state_dict().items()}
    changed = Encoders.from_pretrained(*sources, image_weights=weights)
    frames = [np.full((1, 64, 64, 3), 99, np.uint8)]
    assert np.abs(changed.encode_frames(frames)[0] - base.encode_frames(frames)[0]).max() > 1e-3
    np.testing.assert_array_equal(changed.encode_tasks(["lift"]), base.encode_tasks(["lift"]))
    few = {"embeddings.cls_token": torch.zeros(1, 1, 48)}
    with pytest.raises(ValueError, match=r"the encoder's weights do not fit: \{'missing_keys': .*'layernorm.weight'"):
        Encoders.from_pretrained(*sources, image_weights=few)


def saved(encoders: Encoders, folder: Path, file: str, change: Callable[[dict[str, Any]], object]) -> Path:
    """The encoders in a folder, in which a JSON file is changed."""
    encoders.save(folder)
    in_json(file, change)(folder)
    return folder


IMAGES = f"image_encoder/{PREPROCESSOR_CONFIG}"


def test_saved_encoders_load_the_same_also_with_sizes_as_transformers_once_wrote_them(
    encoders: Encoders, tmp_path: Path
) -> None:
    copy = Encoders.load(saved(encoders, tmp_path, IMAGES, lambda content: content.update(size=64, crop_size=56)))
    assert copy.preprocessor == encoders.preprocessor
    assert (copy.preprocessor.resize_px, copy.preprocessor.crop_px) == (64, (56, 56))
    frames = [video(0, 2, 50, 70).positions]
    np.testing.assert_array_equal(copy.encode_frames(frames)[0], encoders.encode_frames(frames)[0])
    np.testing.assert_array_equal(copy.encode_tasks(["lift the cup"]), encoders.encode_tasks(["lift the cup"]))


# For a 4 x 4 picture: the crop, and the offset of the picture in it, or of a smaller crop in the picture.
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
