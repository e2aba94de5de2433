# SPDX-License-Identifier: MIT
"""Raw frames -> the crops that ReWiND's image encoder reads. N images, C = 3 channels, H x W pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from rfm.checkpoint.preprocessor import MAX_UINT8, PIL_BICUBIC
from rfm_client.contract.frame_size import FrameSize


@dataclass(frozen=True)
class ImagePreprocessor:
    """uint8 images -> normalised crops, bit for bit as the "fast" (torchvision) Bit image processor makes them.

    Shortest edge to ``resize_px`` (bicubic, antialiased, on uint8), centre crop to ``crop_px`` = (height, width),
    then per channel (value - 255 mean) / (255 std).
    """

    resize_px: int
    crop_px: tuple[int, int]
    mean: tuple[float, ...]
    std: tuple[float, ...]

    @property
    def frame_size(self) -> FrameSize:
        """What becomes of a frame before it is cropped."""
        return FrameSize("shortest", (self.resize_px,))

    @classmethod
    def from_config(cls, config: Mapping[str, Any], where: str) -> ImagePreprocessor:
        """The preprocessing that preprocessor_config.json describes. Raises ValueError for other steps."""
        size: Any = config.get("size")
        crop: Any = config.get("crop_size")
        if _is_count(size) and str(config.get("image_processor_type", "Bit")).startswith(("Bit", "CLIP")):
            size = {
                "shortest_edge": size
            }  # as transformers wrote it, and reads it, for processors that keep proportions
        if _is_count(crop):
            crop = {"height": crop, "width": crop}
        required = {
            "do_resize": True,
            "do_center_crop": True,
            "do_rescale": True,
            "do_normalize": True,
            "resample": PIL_BICUBIC,
        }
        for name, value in required.items():
            if config.get(name) != value:
                raise ValueError(f"{where}: {name}: expected {value}, got {config.get(name)}")
        if abs(config.get("rescale_factor", 0.0) - 1 / MAX_UINT8) > 1e-9:
            raise ValueError(f"{where}: rescale_factor: expected 1/255, got {config.get('rescale_factor')}")
        if not (_has_counts(size, "shortest_edge") and _has_counts(crop, "height", "width")):
            expected = "size {shortest_edge} and crop_size {height, width}"
            raise ValueError(f"{where}: expected {expected}, got {config.get('size')} and {config.get('crop_size')}")
        for name in ("image_mean", "image_std"):
            values = config.get(name)
            if not (isinstance(values, list) and len(values) == 3 and all(type(value) is float for value in values)):
                raise ValueError(f"{where}: {name}: expected three numbers, got {values}")
        return cls(
            resize_px=size["shortest_edge"],
            crop_px=(crop["height"], crop["width"]),
            mean=tuple(config["image_mean"]),
            std=tuple(config["image_std"]),
        )

    def to_config(self) -> dict[str, Any]:
        """The fields of preprocessor_config.json from which ``from_config`` makes this."""
        return {
            "do_resize": True,
            "size": {"shortest_edge": self.resize_px},
            "resample": PIL_BICUBIC,
            "do_center_crop": True,
            "crop_size": dict(zip(("height", "width"), self.crop_px, strict=True)),
            "do_rescale": True,
            "rescale_factor": 1 / MAX_UINT8,
            "do_normalize": True,
            "image_mean": self.mean,
            "image_std": self.std,
            "image_processor_type": "BitImageProcessor",
        }

    def __call__(self, images: Tensor) -> Tensor:
        """uint8 [N, H, W, C] -> float32 [N, C, *crop_px], on the CPU."""
        crops = self._crop(self._resize(images.permute(0, 3, 1, 2))).float()
        mean, std = (torch.tensor(values).view(-1, 1, 1) * MAX_UINT8 for values in (self.mean, self.std))
        return (crops - mean) / std

    def _resize(self, images: Tensor) -> Tensor:
        height, width = images.shape[-2:]
        short, long = min(height, width), max(height, width)
        resized = (self.resize_px, int(self.resize_px * long / short))
        size = resized if height <= width else resized[::-1]
        if size == (height, width):
            return images
        return F.interpolate(images, size, mode="bicubic", antialias=True)

    def _crop(self, images: Tensor) -> Tensor:
        height, width = images.shape[-2:]
        crop_height, crop_width = self.crop_px
        pad_height, pad_width = max(crop_height - height, 0), max(crop_width - width, 0)
        if pad_height or pad_width:
            sides = (pad_width // 2, (pad_width + 1) // 2, pad_height // 2, (pad_height + 1) // 2)
            images = F.pad(images, sides)
            height, width = images.shape[-2:]
        top, left = round((height - crop_height) / 2), round((width - crop_width) / 2)
        return images[..., top : top + crop_height, left : left + crop_width]


def _is_count(value: Any) -> bool:
    return type(value) is int and value > 0


def _has_counts(value: Any, *names: str) -> bool:
    """Whether it is a mapping of just these names to numbers of pixels."""
    return isinstance(value, dict) and set(value) == set(names) and all(map(_is_count, value.values()))
