# SPDX-License-Identifier: MIT
"""Frames are made as small as the served checkpoint reads them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
import torch
from PIL import Image

import clip
from rfm.engine import Engine
from rfm.rewind.encoders import ImagePreprocessor
from rfm.vlm.images import Normalisation, QwenImages, SmolImages, _scaled_to_longest, fitted_size
from rfm_client import ProgressResult, ProgressSample, Trajectory
from rfm_client.contract.frame_size import FrameSize
from rfm_client.contract.samples import UInt8Array
from rfm_client.data.resize import resize_frames


@pytest.mark.parametrize("text", ["shortest 256", "longest 512", "exact 224x320"])
def test_a_frame_size_is_read_and_written(text: str) -> None:
    assert str(FrameSize.parse(text)) == text


def test_a_frame_size_tells_its_parts() -> None:
    assert FrameSize.parse("shortest 256") == FrameSize("shortest", (256,))
    assert FrameSize.parse("exact 224x320") == FrameSize("exact", (224, 320))


@pytest.mark.parametrize(
    "text",
    ["", "256", "shortest", "shortest 0", "shortest -1", "shortest 2x3", "exact 224", "longest 512 ", "exact ٣x٣"],
)
def test_a_frame_size_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ValueError) as refused:
        FrameSize.parse(text)
    forms = "'shortest PX', 'longest PX' or 'exact HEIGHTxWIDTH'"
    assert str(refused.value) == f"frame_size: expected {forms}, got {text!r}"


FITTED = {
    "landscape": ("shortest 256", (480, 640), (256, 341)),
    "portrait": ("shortest 256", (640, 480), (341, 256)),
    "square": ("shortest 256", (300, 300), (256, 256)),
    "small enough": ("shortest 256", (256, 4000), (256, 4000)),
    "longest landscape": ("longest 512", (480, 640), (384, 512)),
    "longest to an even edge": ("longest 512", (1000, 701), (512, 358)),
    "longest, rounded as by the server": ("longest 512", (186, 1024), (92, 512)),  # 93 by another expression
    "longest small enough": ("longest 512", (511, 333), (511, 333)),
    "exact": ("exact 224x320", (480, 640), (224, 320)),
    "exact of smaller frames": ("exact 224x320", (200, 300), (200, 300)),
    "exact of a longer edge": ("exact 224x320", (200, 640), (200, 320)),
}


@pytest.mark.parametrize(("text", "size", "fitted"), FITTED.values(), ids=FITTED)
def test_frames_are_only_ever_made_smaller(text: str, size: tuple[int, int], fitted: tuple[int, int]) -> None:
    frames = np.zeros((1, *size, 3), np.uint8)
    resized = resize_frames(frames, FrameSize.parse(text))
    assert resized.shape == (1, *fitted, 3)
    assert resized.dtype == np.uint8
    assert (resized is frames) == (size == fitted)


NO_COLOURS = Normalisation((0.0,) * 3, (1 / 255,) * 3)  # so that the network reads grey levels


def preprocessor(resize_px: int) -> ImagePreprocessor:
    return ImagePreprocessor(resize_px, (resize_px, resize_px), (0.0,) * 3, (1 / 255,) * 3)


def blank(height: int, width: int) -> torch.Tensor:
    """uint8 [1, 3, H, W] that takes no memory."""
    return torch.zeros(1, 1, 1, 1, dtype=torch.uint8).expand(1, 3, height, width)


def test_rewind_s_encoder_has_nothing_left_to_resize() -> None:
    small, size = preprocessor(16), FrameSize.parse("shortest 16")
    for height, width in product(range(17, 150, 4), range(17, 150, 3)):
        assert small._resize(blank(height, width)).shape[2:] == size.fitted(height, width)
    server, size = preprocessor(256), FrameSize.parse("shortest 256")
    for height, width in np.random.default_rng(0).integers(257, 3000, (5000, 2)).tolist():
        resized = blank(*size.fitted(height, width))
        assert server._resize(resized) is resized, (height, width)


def test_smolvlm_has_nothing_left_to_scale() -> None:
    size = FrameSize.parse("longest 512")
    for height, width in np.random.default_rng(0).integers(30, 5000, (20_000, 2)).tolist():
        fitted = size.fitted(height, width)
        if max(height, width) > 512:
            assert fitted == _scaled_to_longest(height, width, 512) == _scaled_to_longest(*fitted, 512)


@pytest.fixture(scope="module")
def large() -> UInt8Array:
    """A picture with edges, text-like detail and noise: uint8 [2, 300, 401, 3]."""
    random = np.random.default_rng(1)
    rows, columns = np.mgrid[:300, :401]
    waves = 127 * (1 + np.sin(rows * columns / 900))
    frames = np.stack([waves, 255 * (columns // 40 % 2), random.integers(0, 256, (300, 401))], axis=-1)
    return np.stack([frames, frames[::-1]]).astype(np.uint8)


def test_rewind_s_encoder_reads_what_it_would_have_read_to_a_grey_level(large: UInt8Array) -> None:
    size = FrameSize.parse("shortest 256")
    for frames in (large, np.ascontiguousarray(large.transpose(0, 2, 1, 3))):
        whole = preprocessor(256)(torch.from_numpy(frames))
        resized = preprocessor(256)(torch.from_numpy(resize_frames(frames, size)))
        assert (whole - resized).abs().max() <= 1
        assert (whole - resized).abs().mean() < 0.01


def test_smolvlm_reads_the_very_pixels_that_it_would_have_read(large: UInt8Array) -> None:
    images = SmolImages(256, int(Image.Resampling.LANCZOS), 1, NO_COLOURS)
    for frames in (large, large.transpose(0, 2, 1, 3)):
        resized = resize_frames(frames, FrameSize.parse("longest 256"))
        assert torch.equal(images.images_to_size(np.ascontiguousarray(frames)), images.images_to_size(resized))


def test_qwen_reads_the_very_pixels_that_it_would_have_read(large: UInt8Array) -> None:
    height, width = fitted_size(224, 320, 28)
    images = QwenImages(14, NO_COLOURS, (224, 320))
    whole, resized = (
        images.images_to_size(frames) for frames in (large, resize_frames(large, FrameSize("exact", (height, width))))
    )
    assert torch.equal(whole, resized)


def test_scores_of_resized_frames_are_close(engine: Callable[[str], Engine]) -> None:
    frames = clip.render()[::4]
    samples = [
        ProgressSample(Trajectory(frames=film, task=clip.TASK))
        for film in (frames, resize_frames(frames, FrameSize.parse("shortest 64")))
    ]
    assert samples[1].trajectory.positions.shape == (8, 64, 64, 3)
    whole, resized = engine("enc_c1_t1_disc10").evaluate(samples)
    assert isinstance(whole, ProgressResult)
    assert isinstance(resized, ProgressResult)
    np.testing.assert_allclose(resized.progress, whole.progress, rtol=0, atol=1e-4)
    np.testing.assert_allclose(resized.success, whole.success, rtol=0, atol=1e-4)
