# SPDX-License-Identifier: MIT
"""Convert stored frames to upright RGB, per camera: turn them, and swap red and blue. H x W pixels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, TypeAlias, TypeVar, get_args

import numpy as np

from rfm_client.contract.checks import require
from rfm_client.contract.samples import UInt8Array
from rfm_client.contract.settings import ConfigError

if TYPE_CHECKING:
    from typing_extensions import Self

Orientation: TypeAlias = Literal["none", "rotate180", "flip-vertical", "flip-horizontal", "rotate90", "rotate270"]
ORIENTATIONS: tuple[Orientation, ...] = get_args(Orientation)
ChannelOrder: TypeAlias = Literal["rgb", "bgr"]
CHANNEL_ORDERS: tuple[ChannelOrder, ...] = get_args(ChannelOrder)

Value = TypeVar("Value", bound=str)


def turned(frames: UInt8Array, orientation: Orientation) -> UInt8Array:
    """Return frames, uint8 [..., H, W, 3], turned.

    ``rotate90`` is a quarter turn clockwise; ``flip-vertical`` swaps top and bottom.

    Raises ValueError for an unknown orientation.
    """
    check_value("orient", ORIENTATIONS, orientation)
    if orientation == "none":
        return frames
    views = {
        "rotate180": frames[..., ::-1, ::-1, :],
        "flip-vertical": frames[..., ::-1, :, :],
        "flip-horizontal": frames[..., ::-1, :],
        "rotate90": np.swapaxes(frames[..., ::-1, :, :], -3, -2),
        "rotate270": np.swapaxes(frames, -3, -2)[..., ::-1, :, :],
    }
    return np.ascontiguousarray(views[orientation])


def check_value(name: str, values: tuple[str, ...], value: object) -> None:
    """Raise ValueError unless the value is one of the option's values."""
    require(name, value in values, f"one of {', '.join(values)}", repr(value), ConfigError)


@dataclass(frozen=True)
class Correction:
    """How a camera's stored frames become upright RGB. Raises ValueError for an unknown value.

    orient: rotation or flip that makes them upright
    channels: stored channel order
    """

    orient: Orientation = "none"
    channels: ChannelOrder = "rgb"

    def __post_init__(self) -> None:
        check_value("orient", ORIENTATIONS, self.orient)
        check_value("channels", CHANNEL_ORDERS, self.channels)

    def applied(self, frames: UInt8Array) -> UInt8Array:
        """Return stored frames, uint8 [..., H, W, 3], as upright RGB."""
        is_rgb = self.channels == "rgb"
        return turned(frames if is_rgb else np.ascontiguousarray(frames[..., ::-1]), self.orient)


@dataclass(frozen=True)
class PerCamera(Generic[Value]):
    """Values of an option by camera, from the caller. Raises ValueError for an unknown value.

    default: value for all cameras not in ``cameras``; None: not given
    """

    NAME: ClassVar[str]
    VALUES: ClassVar[tuple[str, ...]]

    default: Value | None = None
    cameras: Mapping[str, Value] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for value in (self.default, *self.cameras.values()):
            if value is not None:
                check_value(self.NAME, self.VALUES, value)

    @classmethod
    def of(cls, value: Value | Mapping[str, Value]) -> Self:
        """Return one value for all cameras, or the values of a dict by camera."""
        return cls(cameras=value) if isinstance(value, Mapping) else cls(value)

    @classmethod
    def parse(cls, texts: Iterable[str]) -> Self:
        """Parse values such as ``rotate180``, or ``agentview_rgb=rotate180`` for one camera.

        Raises ValueError for a repeated camera or default.
        """
        default: Any = None
        cameras: dict[str, Any] = {}
        for text in texts:
            camera, is_named, value = text.rpartition("=")
            is_first = camera not in cameras if is_named else default is None
            require(cls.NAME, is_first, "each camera once", f"{text!r} again", ConfigError)
            if is_named:
                cameras[camera] = value
            else:
                default = value
        return cls(default, cameras)


class Orient(PerCamera[Orientation]):
    """Orientations by camera, from the caller."""

    NAME, VALUES = "orient", ORIENTATIONS


class Channels(PerCamera[ChannelOrder]):
    """Stored channel orders by camera, from the caller."""

    NAME, VALUES = "channels", CHANNEL_ORDERS


@dataclass(frozen=True)
class Corrections:
    """Orientations and channel orders from the caller."""

    orient: Orient = field(default_factory=Orient)
    channels: Channels = field(default_factory=Channels)

    def of(self, camera: str) -> Correction:
        """Return the correction of one camera, by its exact name."""
        orient = self.orient.cameras.get(camera, self.orient.default)
        channels = self.channels.cameras.get(camera, self.channels.default)
        return Correction(orient or "none", channels or "rgb")
