# SPDX-License-Identifier: MIT
"""Turn stored frames upright, for each camera. H x W pixels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias, get_args

import numpy as np

from rfm_client.contract.samples import UInt8Array

Orientation: TypeAlias = Literal["none", "rotate180", "flip-vertical", "flip-horizontal", "rotate90", "rotate270"]
ORIENTATIONS: tuple[Orientation, ...] = get_args(Orientation)


def turned(frames: UInt8Array, orientation: Orientation) -> UInt8Array:
    """Return frames, uint8 [..., H, W, 3], turned.

    ``rotate90`` is a quarter turn clockwise; ``flip-vertical`` swaps top and bottom.

    Raises ValueError for an unknown orientation.
    """
    check_orientation(orientation)
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


def check_orientation(orientation: str) -> None:
    """Raise ValueError for an unknown orientation."""
    if orientation not in ORIENTATIONS:
        raise ValueError(f"orient: expected one of {', '.join(ORIENTATIONS)}, got {orientation!r}")


@dataclass(frozen=True)
class Orient:
    """The caller's orientations. Raises ValueError for an unknown orientation.

    default: for every camera that ``cameras`` does not name; None: not given
    """

    default: Orientation | None = None
    cameras: Mapping[str, Orientation] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for orientation in (self.default, *self.cameras.values()):
            if orientation is not None:
                check_orientation(orientation)

    @classmethod
    def parse(cls, texts: Iterable[str]) -> Orient:
        """Return the orientations in texts: ``rotate180``, or ``agentview_rgb=rotate180`` for one camera.

        Raises ValueError for a repeated camera or default.
        """
        default: str | None = None
        cameras: dict[str, str] = {}
        for text in texts:
            camera, is_named, orientation = text.rpartition("=")
            if (camera in cameras) if is_named else default is not None:
                raise ValueError(f"orient: expected each camera once, got {text!r} again")
            if is_named:
                cameras[camera] = orientation
            else:
                default = orientation
        return cls(default, cameras)  # type: ignore[arg-type]  # Orient checks them
