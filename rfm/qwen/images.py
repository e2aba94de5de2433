# SPDX-License-Identifier: MIT
"""Turn raw frames into a vision-language backbone's pixels, with the same values as upstream's collator.

T frames, H x W pixels (H' x W' after resizing), C = 3 channels, P: patch side in pixels. A merged token stands for
MERGE x MERGE patches.
The CPU resizes frames once, as uint8 (``..._to_size``). The device does the rest in float.
Sources: the resizing rules in ``qwen-vl-utils`` 0.0.14, the patch order in ``transformers``' Qwen2-VL image processor.
Neither torchvision nor this processor is needed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from rfm.engine.layers import Normalisation
from rfm.files import MAX_UINT8, PIL_BICUBIC
from rfm_client.contract.checks import require
from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.samples import UInt8Array

MERGE = 2
FRAMES_PER_GROUP = 2  # frames per temporal patch in a video
IMAGE_TOKENS = (4, 16_384)  # merged tokens per image: least, most
VIDEO_TOKENS = (128.0, 768.0)  # per video frame
VIDEO_TOTAL_TOKENS = 128_000 * 0.9  # per video
MAX_QWEN_ASPECT_RATIO = 200
_NOT_LONG = f"an image at most {MAX_QWEN_ASPECT_RATIO} times as long as wide"
MAX_VIDEO_SIDE_PX = 480  # larger video frames are scaled down first


@dataclass(frozen=True)
class Grid:
    """How many temporal patches an image or video has, and how many rows and columns of patches are in one."""

    groups: int
    rows: int
    columns: int

    @property
    def tokens_per_group(self) -> int:
        """Merged tokens per temporal patch."""
        return self.rows * self.columns // MERGE**2


def check_aspect(height: int, width: int) -> None:
    """Raise InvalidSampleError for an image whose sides have a ratio over 200."""
    is_fit = max(height, width) / min(height, width) <= MAX_QWEN_ASPECT_RATIO
    require("frames", is_fit, _NOT_LONG, f"{height} x {width}", InvalidSampleError)


def fitted_size(height: int, width: int, factor: int, tokens: tuple[float, float] = IMAGE_TOKENS) -> tuple[int, int]:
    """Return the nearest height and width in multiples of ``factor``, with a similar shape, for a Qwen backbone.

    factor: a merged token's side in pixels
    tokens: least and most merged tokens
    Raises InvalidSampleError for an image whose sides have a ratio over 200.
    """
    check_aspect(height, width)
    least, most = (count * factor**2 for count in tokens)
    fitted = [max(factor, round(side / factor) * factor) for side in (height, width)]
    if fitted[0] * fitted[1] > most:
        scale = math.sqrt(height * width / most)
        fitted = [math.floor(side / scale / factor) * factor for side in (height, width)]
    elif fitted[0] * fitted[1] < least:
        scale = math.sqrt(least / (height * width))
        fitted = [math.ceil(side * scale / factor) * factor for side in (height, width)]
    return fitted[0], fitted[1]


def bounded_size(
    height: int, width: int, factor: int, bounds_px: tuple[int, int], num_frames: int = 1, num_filled: int = 1
) -> tuple[int, int]:
    """Return height and width as transformers' processors resize frames: in multiples of ``factor``, within bounds.

    factor: a merged token's side in pixels
    bounds_px: least and most pixels in all frames together
    num_filled: frame count after the last temporal patch is filled up
    Raises InvalidSampleError for an image whose sides have a ratio over 200.
    """
    check_aspect(height, width)
    least, most = bounds_px
    rows, columns = (round(side / factor) * factor for side in (height, width))
    if num_filled * rows * columns > most:
        scale = math.sqrt(num_frames * height * width / most)
        rows, columns = (max(factor, math.floor(side / scale / factor) * factor) for side in (height, width))
    elif num_filled * rows * columns < least:
        scale = math.sqrt(least / (num_frames * height * width))
        rows, columns = (math.ceil(side * scale / factor) * factor for side in (height, width))
    return rows, columns


def resized(frame: UInt8Array, height: int, width: int, resample: int = PIL_BICUBIC) -> UInt8Array:
    """Resize a frame with Pillow: uint8 [H, W, 3] -> [height, width, 3]; ``resample``: Pillow's filter."""
    if frame.shape[:2] == (height, width):
        return frame
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError('vision-language checkpoints need Pillow: pip install ".[vlm]"') from error
    return np.asarray(Image.fromarray(frame).resize((width, height), Image.Resampling(resample)))


@dataclass(frozen=True)
class QwenImages:
    """Image preprocessing for the Qwen backbones.

    patch_px: P
    size_px: height and width in the training run's settings; None: keep the frame's own
    max_video_side_px: scale larger video frames down to this side first; None: no scaling
    """

    patch_px: int
    normalisation: Normalisation
    size_px: tuple[int, int] | None = None
    max_video_side_px: int | None = MAX_VIDEO_SIDE_PX

    def to_config(self) -> dict[str, Any]:
        """Return the corresponding fields for preprocessor_config.json."""
        return {"patch_size": self.patch_px, **self.normalisation.to_config()}

    def image_grid(self, height: int, width: int) -> Grid:
        """Return the grid for a frame [H, W, 3] as an image."""
        return self.grid(1, *self._image_size(height, width))

    def video_grid(self, height: int, width: int, num_shown: int) -> Grid:
        """Return the grid for a video with ``num_shown`` frames [H, W, 3]."""
        groups = math.ceil(num_shown / FRAMES_PER_GROUP)
        return self.grid(groups, *self._video_sizes(height, width, num_shown)[-1])

    def images_to_size(self, frames: UInt8Array) -> Tensor:
        """Resize frames to separate images: uint8 [T, H, W, 3] -> [T, H', W', 3]."""
        return _to_sizes(frames, [self._image_size(frames.shape[1], frames.shape[2])])

    def video_to_size(self, frames: UInt8Array, num_shown: int) -> Tensor:
        """Resize frames for a video with ``num_shown`` frames: uint8 [T, H, W, 3] -> [T, H', W', 3]."""
        *first_sizes, last_size = self._video_sizes(frames.shape[1], frames.shape[2], num_shown)
        return scaled_video(_to_sizes(frames, first_sizes), last_size)

    def patches(self, frames: Tensor, shots: Tensor | None, dtype: torch.dtype = torch.float32) -> Tensor:
        """Cut frames into N patches: uint8 [T, H', W', 3] -> [N, C * FRAMES_PER_GROUP * P * P].

        A merged token's patches are adjacent.
        shots: frame indices of S temporal patches: int64 [S, 1] for images, [S, FRAMES_PER_GROUP] for videos; None:
            each frame is an image
        """
        planes = self.normalisation(frames).to(dtype)
        groups = planes[:, None] if shots is None else planes[shots]
        groups = groups.expand(-1, FRAMES_PER_GROUP, -1, -1, -1)  # an image becomes the same frame twice
        num_groups, _, channels, height, width = groups.shape
        grid = self.grid(num_groups, height, width)
        patches = groups.reshape(
            num_groups, FRAMES_PER_GROUP, channels,
            grid.rows // MERGE, MERGE, self.patch_px,
            grid.columns // MERGE, MERGE, self.patch_px,
        )  # fmt: skip
        return patches.permute(0, 3, 6, 4, 7, 2, 1, 5, 8).flatten(0, 4).flatten(1)

    def _image_size(self, height: int, width: int) -> tuple[int, int]:
        return fitted_size(*(self.size_px or (height, width)), self.patch_px * MERGE)

    def _video_sizes(self, height: int, width: int, num_shown: int) -> list[tuple[int, int]]:
        """Return the successive sizes to which the frames of a ``num_shown``-frame video are resized."""
        factor = self.patch_px * MERGE
        sizes = []
        fitted_size(height, width, factor)  # refuses narrow frames, which scaling down would leave without pixels
        if self.max_video_side_px is not None and max(height, width) > self.max_video_side_px:
            scale = self.max_video_side_px / max(height, width)
            height, width = max(int(height * scale), 1), max(int(width * scale), 1)
            sizes.append((height, width))
        sizes.append(fitted_size(*(self.size_px or (height, width)), MERGE * factor))
        if self.size_px:
            return [*sizes, fitted_size(*self.size_px, factor)]
        least, most = VIDEO_TOKENS
        count = math.ceil(num_shown / FRAMES_PER_GROUP) * FRAMES_PER_GROUP
        most_px = max(
            min(most, VIDEO_TOTAL_TOKENS / count * FRAMES_PER_GROUP) * factor**2, int(least * factor**2 * 1.05)
        )
        return [*sizes, fitted_size(*sizes[-1], factor, (least, most_px / factor**2))]

    def grid(self, groups: int, height: int, width: int) -> Grid:
        """Return the grid for ``groups`` temporal patches with this size in pixels."""
        return Grid(groups, height // self.patch_px, width // self.patch_px)


@dataclass(frozen=True)
class BoundedImages(QwenImages):
    """The preprocessing that transformers' processor applies to separate images: pixel counts stay within limits."""

    least_px: int = field(kw_only=True)
    most_px: int = field(kw_only=True)

    def images_to_size(self, frames: UInt8Array) -> Tensor:
        """Resize frames to separate images: uint8 [T, H, W, 3] -> [T, H', W', 3]."""
        pixels = torch.from_numpy(frames if frames.flags.writeable else frames.copy())
        return scaled_in_integers(pixels, self._image_size(frames.shape[1], frames.shape[2]))

    def _image_size(self, height: int, width: int) -> tuple[int, int]:
        return bounded_size(height, width, self.patch_px * MERGE, (self.least_px, self.most_px))


def scaled_video(video: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize a video to height and width as torchvision does: uint8 [T, H, W, 3] -> [T, *size, 3]."""
    if video.shape[1:3] == size:
        return video
    scaled = torch.empty(len(video), *size, video.shape[-1], dtype=torch.uint8)
    for index, frame in enumerate(video):
        # In float and rounded. PyTorch's own uint8 resizing differs by up to 1.
        planes = F.interpolate(frame.movedim(-1, 0)[None].float(), size, mode="bicubic", antialias=True)
        scaled[index] = planes.clamp_(0, MAX_UINT8).round_()[0].movedim(0, -1)
    return scaled


def scaled_in_integers(video: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize a video on the CPU as torchvision's v2 does, in integers: uint8 [T, H, W, 3] -> [T, *size, 3]."""
    if video.shape[1:3] == size:
        return video
    if len(video) == 0:  # all features are cached
        return video.new_empty(0, *size, video.shape[-1])
    planes = F.interpolate(video.movedim(-1, 1), size, mode="bicubic", antialias=True)
    return planes.movedim(1, -1).contiguous()


def _to_sizes(frames: UInt8Array, sizes: Sequence[tuple[int, int]]) -> Tensor:
    """Resize frames to all ``sizes`` in turn: uint8 [T, H, W, 3] -> [T, *sizes[-1], 3]."""
    if frames.flags.writeable and all(size == frames.shape[1:3] for size in sizes):
        return torch.from_numpy(frames)
    sized = np.empty((len(frames), *sizes[-1], frames.shape[-1]), np.uint8)
    for index, frame in enumerate(frames):
        for size in sizes:
            frame = resized(frame, *size)
        sized[index] = frame
    return torch.from_numpy(sized)
