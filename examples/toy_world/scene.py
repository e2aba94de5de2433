# SPDX-License-Identifier: MIT
"""Where things stand before anything moves.

Positions are shares of the image: x to the right, y downwards, seen from the side. A block's position is its centre,
the gripper's is the point between its fingertips.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from toy_world.tasks import COLOURS, TARGETS, Task

Float64Array = npt.NDArray[np.float64]

BLOCK_SIZE = 0.12
TABLE_Y = 0.88
REST_Y = TABLE_Y - BLOCK_SIZE / 2  # height when a block lies on the table
IN_TARGET_Y = REST_Y - 0.03  # height when a block lies in the bowl or on the plate
TARGET_REACH = 0.07  # a block this close to a target's middle is in it
_SLOT_SHARES = (0.12, 0.31, 0.5, 0.69, 0.88)
_SLOT_JITTER = 0.025


@dataclass(frozen=True, eq=False)
class Scene:
    """Initial positions and shades.

    blocks: x in COLOURS order, NaN where there is none; targets: x in TARGETS order; gripper: (x, y)
    shades: float64 [3], how light wall, table and the whole picture are
    """

    blocks: Float64Array
    targets: Float64Array
    gripper: Float64Array
    shades: Float64Array

    def has_block(self, index: int) -> bool:
        """True if the COLOURS[index] block is present."""
        return not np.isnan(self.blocks[index])


def random_scene(task: Task, random: np.random.Generator) -> Scene:
    """Place bowl, plate and two or three blocks, including the task's, side by side in random order."""
    slots = random.permutation(_SLOT_SHARES) + random.uniform(-_SLOT_JITTER, _SLOT_JITTER, len(_SLOT_SHARES))
    blocks = slots[len(TARGETS) :]
    if random.random() < 0.4:
        others = [index for index in range(len(COLOURS)) if index != task.block_index]
        blocks[random.choice(others)] = np.nan
    gripper = np.array([random.uniform(0.1, 0.9), random.uniform(0.12, 0.3)])
    shades = np.array([random.uniform(0.85, 1.0), random.uniform(0.85, 1.0), random.uniform(0.85, 1.05)])
    return Scene(blocks, slots[: len(TARGETS)], gripper, shades)
