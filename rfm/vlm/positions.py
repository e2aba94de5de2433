# SPDX-License-Identifier: MIT
"""Where the tokens of a conversation stand, in time and in the plane: the Qwen backbones' multimodal rotary positions.

L tokens. Text goes on by one in all three coordinates. An image or a video is a box: each of its tokens stands where it
is in it, and what follows goes on behind the box's largest coordinate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Box:
    """An image or video among the tokens.

    start: its first token
    groups, rows, columns: of its merged tokens
    step: coordinates from one temporal group to the next
    """

    start: int
    groups: int
    rows: int
    columns: int
    step: int = 1

    @property
    def num_tokens(self) -> int:
        """How many tokens it takes."""
        return self.groups * self.rows * self.columns


def positions(length: int, boxes: Sequence[Box]) -> npt.NDArray[np.int64]:
    """int64 [3, L]: time, row and column of each token; ``boxes`` in the order in which they stand."""
    found = np.empty((3, length), np.int64)
    read = following = 0  # tokens that have their positions; the coordinate of the next one
    for box in boxes:
        text = box.start - read
        found[:, read : box.start] = np.arange(following, following + text)
        inside = np.indices((box.groups, box.rows, box.columns)).reshape(3, -1)
        inside[0] *= box.step
        read = box.start + box.num_tokens
        found[:, box.start : read] = inside + following + text
        following += text + 1 + max((box.groups - 1) * box.step, box.rows - 1, box.columns - 1)
    found[:, read:] = np.arange(following, following + length - read)
    return found
