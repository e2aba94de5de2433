# SPDX-License-Identifier: MIT
"""Frames as a caller hands them over."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.samples import UInt8Array, as_array
from rfm_client.data.orientation import Orient, Orientation


def orientations_of(orient: Orientation | Mapping[str, Orientation], cameras: Sequence[str]) -> list[Orientation]:
    """How frames are turned: those of each camera, or those of the only one, which has no name. Raises ValueError."""
    said = Orient(cameras=orient) if isinstance(orient, Mapping) else Orient(orient)
    unknown = [camera for camera in said.cameras if camera not in cameras]
    if unknown:
        expected = f"some of the cameras {list(cameras)}" if cameras else "one orientation, as cameras names none"
        raise ValueError(f"orient: expected {expected}, got {', '.join(map(repr, unknown))}")
    return [said.cameras.get(camera, said.default or "none") for camera in cameras or ("",)]


def checked_frame(frame: Any, where: str = "frame") -> UInt8Array:
    """A copy of a frame: an environment may draw into the same array again. Raises InvalidSampleError."""
    kept = np.array(as_array(frame))
    if kept.dtype != np.uint8 or kept.ndim != 3 or kept.shape[2] != 3 or 0 in kept.shape:
        raise InvalidSampleError.at(where, "uint8 [H, W, 3]", f"{kept.dtype} {list(kept.shape)}")
    return kept


def copied(frame: Any) -> Any:
    """A copy of a frame, or of such by camera, that may be scored later."""
    if isinstance(frame, Mapping):
        return {camera: np.array(as_array(each)) for camera, each in frame.items()}
    return np.array(as_array(frame))
