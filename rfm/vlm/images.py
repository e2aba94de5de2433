# SPDX-License-Identifier: MIT
"""Raw frames -> the pixels that a vision-language backbone reads, value for value as the original collator's.

T frames, H x W pixels, C = 3 channels; P pixels a side of a patch. A merged token stands for MERGE x MERGE patches.
Sources: the resizing rules of ``qwen-vl-utils`` 0.0.14, the patch order of ``transformers``' Qwen2-VL image
processor, and its SmolVLM image processor. Neither torchvision nor those processors are needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from rfm.checkpoint.preprocessor import MAX_UINT8, PIL_BICUBIC
from rfm_client.contract.samples import UInt8Array

MERGE = 2
FRAMES_PER_GROUP = 2  # frames that share the patches of one temporal group
IMAGE_TOKENS = (4, 16_384)  # merged tokens of one image: at least, at most
VIDEO_TOKENS = (128.0, 768.0)  # of one frame of a video
VIDEO_TOTAL_TOKENS = 128_000 * 0.9  # of a whole video
MAX_QWEN_ASPECT_RATIO = 200
MAX_VIDEO_SIDE_PX = 480  # longer frames are scaled down before anything else, in video mode


@dataclass(frozen=True)
class Normalisation:
    """Normalisation of pixels per channel: (value - 255 mean) / (255 std)."""

    mean: tuple[float, ...]
    std: tuple[float, ...]

    def to_config(self) -> dict[str, Any]:
        """The fields of preprocessor_config.json that describe this."""
        return {"image_mean": self.mean, "image_std": self.std, "rescale_factor": 1 / MAX_UINT8}

    def __call__(self, images: Tensor) -> Tensor:
        """[..., C, H, W] in 0..255 -> float32."""
        mean, std = (torch.tensor(values).view(-1, 1, 1) * MAX_UINT8 for values in (self.mean, self.std))
        return (images.float() - mean) / std


@dataclass(frozen=True)
class Grid:
    """Temporal groups, patch rows and patch columns of an image or video."""

    groups: int
    rows: int
    columns: int

    @property
    def tokens_per_group(self) -> int:
        """Merged tokens of one temporal group."""
        return self.rows * self.columns // MERGE**2


@dataclass(frozen=True)
class Pixels:
    """What the backbone reads of one image or video.

    patches: float32 [N, C * FRAMES_PER_GROUP * P * P], N = all of the grid's
    """

    patches: Tensor
    grid: Grid


def fitted_size(height: int, width: int, factor: int, tokens: tuple[float, float] = IMAGE_TOKENS) -> tuple[int, int]:
    """Height and width in multiples of ``factor``, about the same shape, with a count of merged tokens in ``tokens``.

    Raises ValueError for an image over 200 times as long as wide.
    """
    if max(height, width) / min(height, width) > MAX_QWEN_ASPECT_RATIO:
        raise ValueError(f"an image at most {MAX_QWEN_ASPECT_RATIO} times as long as wide, got {height} x {width}")
    least, most = (count * factor**2 for count in tokens)
    fitted = [max(factor, round(side / factor) * factor) for side in (height, width)]
    if fitted[0] * fitted[1] > most:
        scale = math.sqrt(height * width / most)
        fitted = [math.floor(side / scale / factor) * factor for side in (height, width)]
    elif fitted[0] * fitted[1] < least:
        scale = math.sqrt(least / (height * width))
        fitted = [math.ceil(side * scale / factor) * factor for side in (height, width)]
    return fitted[0], fitted[1]


def resized(frame: UInt8Array, height: int, width: int, resample: int = PIL_BICUBIC) -> UInt8Array:
    """uint8 [H, W, 3] -> [height, width, 3], as Pillow resizes; ``resample``: its number of the filter."""
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError('vision-language checkpoints need Pillow: pip install ".[vlm]"') from error
    return np.asarray(Image.fromarray(frame).resize((width, height), Image.Resampling(resample)))


@dataclass(frozen=True)
class QwenImages:
    """Preprocessing for the Qwen backbones.

    patch_px: P
    size_px: height and width that the training run set for every frame; None: each frame's own
    """

    patch_px: int
    normalisation: Normalisation
    size_px: tuple[int, int] | None = None

    def to_config(self) -> dict[str, Any]:
        """The fields of preprocessor_config.json that describe this."""
        return {"patch_size": self.patch_px, **self.normalisation.to_config()}

    def image_grid(self, frames: UInt8Array) -> Grid:
        """Grid of each of the frames [T, H, W, 3] as an image of its own."""
        return self._grid(1, self._image_size(frames))

    def video_grid(self, frames: UInt8Array) -> Grid:
        """Grid of all frames [T, H, W, 3] as one video."""
        return self._grid(math.ceil(len(frames) / FRAMES_PER_GROUP), self._video_sizes(frames)[-1])

    def images(self, frames: UInt8Array) -> list[Pixels]:
        """Each frame [T, H, W, 3] as an image of its own."""
        size = self._image_size(frames)
        return [
            self._pixels(_channels_first(resized(frame, *size)).expand(FRAMES_PER_GROUP, -1, -1, -1))
            for frame in frames
        ]

    def video(self, frames: UInt8Array) -> Pixels:
        """All frames [T, H, W, 3] as one video; an odd count is filled up with the last frame."""
        *first_sizes, last_size = self._video_sizes(frames)
        pictures = []
        for frame in frames:
            for size in first_sizes:
                frame = resized(frame, *size)
            pictures.append(_channels_first(frame))
        stack = torch.cat(pictures + pictures[-1:] * (len(pictures) % FRAMES_PER_GROUP))
        if stack.shape[-2:] != last_size:
            # in float and rounded, as torchvision resizes; torch's own uint8 path differs by up to one
            stack = F.interpolate(stack.float(), last_size, mode="bicubic", antialias=True).clamp(0, MAX_UINT8).round()
        return self._pixels(stack)

    def _image_size(self, frames: UInt8Array) -> tuple[int, int]:
        height, width = self.size_px or frames.shape[1:3]
        return fitted_size(height, width, self.patch_px * MERGE)

    def _video_sizes(self, frames: UInt8Array) -> list[tuple[int, int]]:
        """Height and width to which a video's frames are brought one after the other."""
        factor = self.patch_px * MERGE
        sizes = []
        height, width = frames.shape[1:3]
        fitted_size(height, width, factor)  # refuses slivers, which scaling down would leave without pixels
        if max(height, width) > MAX_VIDEO_SIDE_PX:
            scale = MAX_VIDEO_SIDE_PX / max(height, width)
            height, width = max(int(height * scale), 1), max(int(width * scale), 1)
            sizes.append((height, width))
        sizes.append(fitted_size(*(self.size_px or (height, width)), MERGE * factor))
        if self.size_px:
            return [*sizes, fitted_size(*self.size_px, factor)]
        least, most = VIDEO_TOKENS
        count = math.ceil(len(frames) / FRAMES_PER_GROUP) * FRAMES_PER_GROUP
        most_px = max(
            min(most, VIDEO_TOTAL_TOKENS / count * FRAMES_PER_GROUP) * factor**2, int(least * factor**2 * 1.05)
        )
        return [*sizes, fitted_size(*sizes[-1], factor, (least, most_px / factor**2))]

    def _grid(self, groups: int, size: tuple[int, int]) -> Grid:
        return Grid(groups, size[0] // self.patch_px, size[1] // self.patch_px)

    def _pixels(self, stack: Tensor) -> Pixels:
        """uint8 [T, C, H, W] -> patches, those that are merged next to each other."""
        stack = self.normalisation(stack)
        frames, channels, height, width = stack.shape
        grid = self._grid(frames // FRAMES_PER_GROUP, (height, width))
        patches = stack.reshape(
            grid.groups, FRAMES_PER_GROUP, channels,
            grid.rows // MERGE, MERGE, self.patch_px,
            grid.columns // MERGE, MERGE, self.patch_px,
        )  # fmt: skip
        patches = patches.permute(0, 3, 6, 4, 7, 2, 1, 5, 8)
        return Pixels(patches.flatten(0, 4).flatten(1), grid)


@dataclass(frozen=True)
class SmolImages:
    """Preprocessing for SmolVLM: the longer side to ``size_px``, then a square of it.

    resample: Pillow's number of the filter
    tokens: image tokens that stand for one
    """

    size_px: int
    resample: int
    tokens: int
    normalisation: Normalisation

    def to_config(self) -> dict[str, Any]:
        """The fields of preprocessor_config.json that describe this."""
        return {"resample": self.resample, **self.normalisation.to_config()}

    def images(self, frames: UInt8Array) -> Tensor:
        """float32 [T, C, size_px, size_px] of frames [T, H, W, 3]."""
        squares = []
        for frame in frames:
            size = _scaled_to_longest(frame.shape[0], frame.shape[1], self.size_px)
            square = resized(resized(frame, *size, self.resample), self.size_px, self.size_px, self.resample)
            squares.append(_channels_first(square))
        return self.normalisation(torch.cat(squares))


def _scaled_to_longest(height: int, width: int, longest: int) -> tuple[int, int]:
    """The longer side ``longest``, the other in proportion and even."""
    if width >= height:
        scaled = int(longest / (width / height))
        return max(scaled + scaled % 2, 1), longest
    scaled = int(longest * (width / height))
    return longest, max(scaled + scaled % 2, 1)


def _channels_first(picture: UInt8Array) -> Tensor:
    """uint8 [H, W, C] -> [1, C, H, W]."""
    return torch.from_numpy(np.array(picture)).permute(2, 0, 1).unsqueeze(0)
