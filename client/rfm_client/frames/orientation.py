# SPDX-License-Identifier: MIT
"""Convert stored frames to upright RGB, per camera: turn them, and swap red and blue.

Also the functions that fuse scores from several cameras. H x W pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from rfm_client.contract.checks import require
from rfm_client.contract.samples import UInt8Array
from rfm_client.contract.settings import ConfigError

Orientation: TypeAlias = Literal["none", "rotate180", "flip-vertical", "flip-horizontal", "rotate90", "rotate270"]
ChannelOrder: TypeAlias = Literal["rgb", "bgr"]


@dataclass(frozen=True)
class Correction:
    """How to turn a camera's stored frames into upright RGB. Raises ValueError for an unknown value.

    orient: rotation or flip that makes them upright. ``rotate90`` is a quarter turn clockwise; ``flip-vertical`` swaps
        top and bottom
    channels: stored channel order
    """

    orient: Orientation = "none"
    channels: ChannelOrder = "rgb"

    def __post_init__(self) -> None:
        for name, kind in (("orient", Orientation), ("channels", ChannelOrder)):
            value, values = getattr(self, name), get_args(kind)
            require(name, value in values, f"one of {', '.join(values)}", repr(value), ConfigError)

    @classmethod
    def of(
        cls,
        camera: str,
        orient: Orientation | Mapping[str, Orientation] = "none",
        channels: ChannelOrder | Mapping[str, ChannelOrder] = "rgb",
    ) -> Correction:
        """Return a camera's correction. orient, channels: one value for all cameras, or a dict by camera."""
        return cls(
            orient if isinstance(orient, str) else orient.get(camera, "none"),
            channels if isinstance(channels, str) else channels.get(camera, "rgb"),
        )

    def applied(self, frames: UInt8Array) -> UInt8Array:
        """Return stored frames, uint8 [..., H, W, 3], as upright RGB."""
        if self == Correction():
            return frames
        rgb = frames if self.channels == "rgb" else frames[..., ::-1]
        turned = {
            "none": rgb,
            "rotate180": rgb[..., ::-1, ::-1, :],
            "flip-vertical": rgb[..., ::-1, :, :],
            "flip-horizontal": rgb[..., ::-1, :],
            "rotate90": np.swapaxes(rgb[..., ::-1, :, :], -3, -2),
            "rotate270": np.swapaxes(rgb, -3, -2)[..., ::-1, :, :],
        }
        return np.ascontiguousarray(turned[self.orient])


Fuse: TypeAlias = Literal["mean", "min", "max"]
FUSES: dict[Fuse, Callable[..., npt.NDArray[np.float32]]] = {"mean": np.mean, "min": np.min, "max": np.max}
