# SPDX-License-Identifier: MIT
"""Frames are made as small as the served checkpoint reads them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rfm.engine.pixels import Normalisation
from rfm.families.rewind.encoders import ImagePreprocessor
from rfm.qwen.images import QwenImages, fitted_size
from rfm_client import FrameSize, ProgressSample, Trajectory, UInt8Array
from rfm_client.frames import resize_frames
from rfm_client.frames.fit_to_checkpoint import fitted, snapshot


@pytest.mark.parametrize(
    ("text", "size"),
    [("shortest 256", FrameSize("shortest", (256,))), ("exact 224x320", FrameSize("exact", (224, 320)))],
)
def test_a_frame_size_is_read_and_written(text: str, size: FrameSize) -> None:
    assert (FrameSize.parse(text), str(size)) == (size, text)


@pytest.mark.parametrize(
    "text",
    ["", "256", "shortest", "shortest 0", "shortest -1", "shortest 2x3", "exact 224", "longest 512", "exact ٣x٣"],
)
def test_a_frame_size_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ValueError) as refused:
        FrameSize.parse(text)
    forms = "'shortest PX' or 'exact HEIGHTxWIDTH'"
    assert str(refused.value) == f"frame_size: expected {forms}, got {text!r}"


FITTED = {
    "landscape": ("shortest 256", (480, 640), (256, 341)),
    "portrait": ("shortest 256", (640, 480), (341, 256)),
    "square": ("shortest 256", (300, 300), (256, 256)),
    "small enough": ("shortest 256", (256, 4000), (256, 4000)),
    "exact": ("exact 224x320", (480, 640), (224, 320)),
    "exact of smaller frames": ("exact 224x320", (200, 300), (200, 300)),
    "exact of a longer edge": ("exact 224x320", (200, 640), (200, 320)),
}


@pytest.mark.parametrize(("text", "size", "expected"), FITTED.values(), ids=FITTED)
def test_frames_are_only_ever_made_smaller(text: str, size: tuple[int, int], expected: tuple[int, int]) -> None:
    frames = np.zeros((1, *size, 3), np.uint8)
    resized = resize_frames(frames, FrameSize.parse(text))
    assert (resized.shape, resized.dtype) == ((1, *expected, 3), np.uint8)
    assert (resized is frames) == (size == expected)


def test_views_and_goal_are_fitted_as_the_frames_and_nothing_is_lost() -> None:
    frames = np.arange(6, dtype=np.uint8).repeat(48 * 64 * 3).reshape(6, 48, 64, 3)
    given = Trajectory(frames=frames, task="lift", views=(frames + 10, frames[:, :, :40]), goal=frames[5])
    (fit,) = fitted(snapshot(ProgressSample(given)), 2, FrameSize("exact", (24, 32))).sample.trajectories
    assert [array.shape for array in (fit.positions, *fit.views)] == [(2, 24, 32, 3)] * 3
    assert [array[:, 0, 0, 0].tolist() for array in (fit.positions, *fit.views)] == [[0, 5], [10, 15], [0, 5]]
    assert fit.goal is not None
    assert fit.goal.shape == (24, 32, 3)
    assert fit.task == given.task


NO_COLOURS = Normalisation((0.0,) * 3, (1 / 255,) * 3)  # so that the network reads grey levels
SIZES = [(300, 401), (401, 300)]


def large(height: int, width: int) -> UInt8Array:
    """A picture with edges, text-like detail and noise: uint8 [2, H, W, 3]."""
    rows, columns = np.mgrid[:height, :width]
    waves = 127 * (1 + np.sin(rows * columns / 900))
    noise = np.random.default_rng(1).integers(0, 256, (height, width))
    frames = np.stack([waves, 255 * (columns // 40 % 2), noise], axis=-1)
    return np.stack([frames, frames[::-1]]).astype(np.uint8)


@pytest.mark.parametrize("size", SIZES)
def test_rewind_s_encoder_reads_what_it_would_have_read_to_a_grey_level(size: tuple[int, int]) -> None:
    frames = large(*size)
    read = ImagePreprocessor(256, (256, 256), (0.0,) * 3, (1 / 255,) * 3)
    resized = resize_frames(frames, FrameSize.parse("shortest 256"))
    differences = (read(torch.from_numpy(frames)) - read(torch.from_numpy(resized))).abs()
    assert differences.max() <= 1
    assert differences.mean() < 0.01


def test_qwen_reads_the_very_pixels_that_it_would_have_read() -> None:
    frames, size = large(300, 401), FrameSize("exact", fitted_size(224, 320, 28))
    images = QwenImages(14, NO_COLOURS, (224, 320))
    assert torch.equal(images.images_to_size(frames), images.images_to_size(resize_frames(frames, size)))
