# SPDX-License-Identifier: MIT
"""A short clip to score: a gripper puts a red block into a bowl."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np

from rfm_client import UInt8Array

TASK = "put the red block in the bowl"
NUM_FRAMES = 32
FPS = 10
SIZE_PX = 96

_TABLE = (196, 180, 152)
_BLOCK = (200, 40, 40)
_BOWL = (60, 90, 170)
_GRIPPER = (50, 50, 55)
# Where the gripper is (x, y as shares of the image) when: above the block, at it, lifted, above the bowl, in it, away.
_WAYPOINTS = ((0.25, 0.15), (0.25, 0.72), (0.25, 0.30), (0.75, 0.30), (0.75, 0.62), (0.75, 0.15))
_GRASPED, _RELEASED = 1, 4  # waypoints between which the block moves with the gripper


def render() -> UInt8Array:
    """uint8 [NUM_FRAMES, SIZE_PX, SIZE_PX, 3]."""
    return np.stack([_frame(time) for time in np.linspace(0, len(_WAYPOINTS) - 1, NUM_FRAMES)])


def write(file: Path, frames: UInt8Array | None = None, fps: int = FPS) -> None:
    """Writes the clip, or other frames, as a video file."""
    from encoding import encode_here

    encode_here(file, render() if frames is None else frames, rate=Fraction(fps))


def _frame(time: float) -> UInt8Array:
    """The scene at a time counted in waypoints."""
    gripper = _position(time)
    block = _position(min(max(time, _GRASPED), _RELEASED))
    image = np.full((SIZE_PX, SIZE_PX, 3), _TABLE, np.uint8)
    _fill(image, _WAYPOINTS[_RELEASED][0], 0.80, 0.30, 0.16, _BOWL)
    _fill(image, block[0], block[1] + 0.08, 0.12, 0.12, _BLOCK)
    holds = _GRASPED <= time <= _RELEASED
    for side in (-1, 1):  # fingers, closed around the block or open
        _fill(image, gripper[0] + side * (0.08 if holds else 0.11), gripper[1] + 0.05, 0.03, 0.14, _GRIPPER)
    _fill(image, gripper[0], gripper[1] - 0.05, 0.26, 0.06, _GRIPPER)
    _fill(image, gripper[0], (gripper[1] - 0.05) / 2, 0.05, gripper[1], _GRIPPER)
    return image


def _position(time: float) -> tuple[float, float]:
    times = np.arange(len(_WAYPOINTS))
    x, y = (float(np.interp(time, times, [waypoint[axis] for waypoint in _WAYPOINTS])) for axis in range(2))
    return x, y


def _fill(image: UInt8Array, x: float, y: float, width: float, height: float, colour: tuple[int, int, int]) -> None:
    """A rectangle given by centre and size as shares of the image."""
    left, top, right, bottom = (
        round(max(share, 0) * SIZE_PX) for share in (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
    )
    image[top:bottom, left:right] = colour
