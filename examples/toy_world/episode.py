# SPDX-License-Identifier: MIT
"""An episode's states over T moments, and how far each task has come at each moment."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from toy_world.scene import IN_TARGET_Y, REST_Y, TARGET_REACH, Float64Array, Scene
from toy_world.tasks import Task

NOTHING = -1  # in `held`
CARRY_Y = 0.45  # height at which a block is carried
RETREAT = 0.3  # how far the gripper withdraws at the end
_LOW_Y = IN_TARGET_Y - 0.02  # a block below this height lies on something
_NEAR = 0.15  # this close to the target, a block need not be lifted any more
_GRASPED, _PLACED = 0.3, 0.9  # progress when the block is grasped, and when it is released in its target


@dataclass(frozen=True, eq=False)
class Episode:
    """The world's state over time.

    gripper: float64 [T, 2]; is_closed: bool [T]
    blocks: float64 [T, 3, 2], in COLOURS order, NaN where there is none; held: int64 [T], the block in the gripper or
        NOTHING
    """

    scene: Scene
    gripper: Float64Array
    is_closed: npt.NDArray[np.bool_]
    blocks: Float64Array
    held: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.gripper)

    def at(self, moments: npt.NDArray[np.int64]) -> Episode:
        """Return an episode with these moments in this order."""
        return replace(
            self,
            gripper=self.gripper[moments],
            is_closed=self.is_closed[moments],
            blocks=self.blocks[moments],
            held=self.held[moments],
        )

    def success(self, task: Task) -> npt.NDArray[np.bool_]:
        """bool [T]: the block lies in its target and is not held."""
        block = self.blocks[:, task.block_index]
        away = np.abs(block[:, 0] - self.scene.targets[task.target_index])
        return (away < TARGET_REACH) & (block[:, 1] > _LOW_Y) & (self.held != task.block_index)

    def progress(self, task: Task) -> Float64Array:
        """float64 [T], 0..1: how much is done. Depends on the state alone: it falls when things are undone.

        Up to 0.3 the gripper approaches the block, up to 0.9 it carries the block to its target, up to 1 it withdraws.
        A missing block, or another one in the gripper, gives 0.
        """
        if not self.scene.has_block(task.block_index):
            return np.zeros(len(self))
        block = self.blocks[:, task.block_index]
        to_block = np.abs(self.gripper - block).sum(axis=1)
        start = np.abs(self.scene.gripper - (self.scene.blocks[task.block_index], REST_Y)).sum()
        approached = np.where(self.held == NOTHING, _share(1 - to_block / start), 0.0)
        withdrawn = _share((block[:, 1] - self.gripper[:, 1]) / RETREAT)
        done = np.where(self.success(task), _PLACED + (1 - _PLACED) * withdrawn, _GRASPED * approached)
        carried = _GRASPED + (_PLACED - _GRASPED) * self._carried(task)
        return np.where(self.held == task.block_index, carried, done)

    def _carried(self, task: Task) -> Float64Array:
        """float64 [T], 0..1: how much of the block's way up, across and down is done."""
        target = self.scene.targets[task.target_index]
        left = _way_left(self.blocks[:, task.block_index], target)
        whole = _way_left(np.array([[self.scene.blocks[task.block_index], REST_Y]]), target)
        return _share(1 - left / whole)


def _way_left(block: Float64Array, target: float) -> Float64Array:
    """Map block positions, [T, 2], to distances that remain, [T]."""
    away = np.abs(block[:, 0] - target)
    far = np.minimum(away / _NEAR, 1)
    up = np.maximum(block[:, 1] - CARRY_Y, 0) * far
    down = (IN_TARGET_Y - CARRY_Y) * far + np.maximum(IN_TARGET_Y - block[:, 1], 0) * (1 - far)
    return up + away + down


def _share(values: Float64Array) -> Float64Array:
    return np.clip(values, 0.0, 1.0)
