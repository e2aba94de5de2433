# SPDX-License-Identifier: MIT
"""Normalise pixels on the network's device: frames travel as uint8."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from rfm.files import MAX_UINT8


@dataclass(frozen=True)
class Normalisation:
    """Normalisation of each channel's pixels: (value - 255 mean) / (255 std)."""

    mean: tuple[float, ...]
    std: tuple[float, ...]

    def to_config(self) -> dict[str, Any]:
        """Return the corresponding fields of preprocessor_config.json."""
        return {"image_mean": self.mean, "image_std": self.std, "rescale_factor": 1 / MAX_UINT8}

    def __call__(self, frames: Tensor) -> Tensor:
        """Normalise pixels: uint8 or float [..., H, W, C] -> float32 [..., C, H, W]."""
        mean, std = (_channels(values, frames.device) for values in (self.mean, self.std))
        return frames.movedim(-1, -3).to(torch.float32, copy=True).sub_(mean).div_(std)


@lru_cache
def _channels(values: tuple[float, ...], device: torch.device) -> Tensor:
    """Return values from 0 to 1 as grey levels, float32 [C, 1, 1], cached on the device."""
    return (torch.tensor(values).view(-1, 1, 1) * MAX_UINT8).to(device)
