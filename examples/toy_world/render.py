# SPDX-License-Identifier: MIT
"""Render pictures of the world."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from toy_world.episode import Episode
from toy_world.scene import BLOCK_SIZE, TABLE_Y
from toy_world.tasks import COLOURS

SIZE_PX = 64
UInt8Array = npt.NDArray[np.uint8]

_WALL = np.array([222, 214, 200])
_TABLE = np.array([150, 118, 84])
_BOWL = (120, 72, 150)
_PLATE = (245, 245, 245)
_GRIPPER = (45, 45, 50)
_BLOCKS = {"red": (208, 44, 40), "green": (44, 160, 60), "blue": (40, 84, 208)}
_TARGET_WIDTH = 0.19
_BOWL_HEIGHT = 0.11
_WALL_WIDTH = 0.03
_FINGER_WIDTH, _FINGER_HEIGHT = 0.03, 0.13
_OPEN, _CLOSED = 0.115, 0.075  # from the gripper's middle to a finger's


def render(episode: Episode) -> UInt8Array:
    """Return RGB frames, uint8 [T, SIZE_PX, SIZE_PX, 3]."""
    return np.stack([_picture(episode, moment) for moment in range(len(episode))])


def _picture(episode: Episode, moment: int) -> UInt8Array:
    scene = episode.scene
    wall, table, light = scene.shades
    image = np.empty((SIZE_PX, SIZE_PX, 3))
    image[:] = _WALL * wall
    _fill(image, 0.5, (1 + TABLE_Y) / 2, 1.0, 1 - TABLE_Y, _TABLE * table)
    bowl, plate = scene.targets
    _fill(image, plate, TABLE_Y - 0.02, _TARGET_WIDTH, 0.035, _PLATE)
    for name, (x, y) in zip(COLOURS, episode.blocks[moment], strict=True):
        if not np.isnan(x):
            _fill(image, x, y, BLOCK_SIZE, BLOCK_SIZE, _BLOCKS[name])
    _fill(image, bowl, TABLE_Y - 0.02, _TARGET_WIDTH, 0.035, _BOWL)
    for side in (-1, 1):
        wall_x = bowl + side * (_TARGET_WIDTH - _WALL_WIDTH) / 2
        _fill(image, wall_x, TABLE_Y - _BOWL_HEIGHT / 2, _WALL_WIDTH, _BOWL_HEIGHT, _BOWL)
    _draw_gripper(image, *episode.gripper[moment], _CLOSED if episode.is_closed[moment] else _OPEN)
    return np.clip(image * light, 0, 255).astype(np.uint8)


def _draw_gripper(image: np.ndarray, x: float, y: float, opening: float) -> None:
    palm_y = y - BLOCK_SIZE / 2 - 0.05
    for side in (-1, 1):
        _fill(image, x + side * opening, y - 0.02, _FINGER_WIDTH, _FINGER_HEIGHT, _GRIPPER)
    _fill(image, x, palm_y, 2 * opening + _FINGER_WIDTH, 0.045, _GRIPPER)
    _fill(image, x, palm_y / 2, 0.045, palm_y, _GRIPPER)


def _fill(image: np.ndarray, x: float, y: float, width: float, height: float, colour: object) -> None:
    """Fill a rectangle, given its centre and size as shares of the picture."""
    left, right = (round(max(x + side * width / 2, 0) * SIZE_PX) for side in (-1, 1))
    top, bottom = (round(max(y + side * height / 2, 0) * SIZE_PX) for side in (-1, 1))
    image[top:bottom, left:right] = colour
