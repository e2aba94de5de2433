# SPDX-License-Identifier: MIT
"""Find blank frames: black or single-coloured. T frames, H x W pixels."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from rfm_client.contract.samples import UInt8Array

FRAMES_IN_A_ROW = 10  # consecutive blank frames that make a camera blank

# Measured: noise from a covered sensor reaches 9, or 2 in a video; barely visible scenes, dimmed to 5 % of the
# light, reach 11 and more.
_BLACK = 8  # highest value in a black frame; also above floats in 0..1 and class numbers
_FLOATS = 2  # highest value when floats in 0..1 were cast to uint8
_RANGE = 4  # widest range in a flat channel: JPEG, H.264 and AV1 spread a flat picture by up to 4
_PROBED_PX = 16  # the coarse grid, which rules out almost all frames, has at least this many rows and columns


def is_blank(frame: UInt8Array) -> bool:
    """True if a frame, uint8 [H, W, 3], is black or single-coloured."""
    step = max(min(frame.shape[:2]) // _PROBED_PX, 1)
    return _is_flat(frame[::step, ::step]) and _is_flat(frame)


class BlankFrames:
    """Find out if a camera is blank in an episode: ten frames in a row, or all in a shorter episode, show nothing.

    Frames are blank if they look black or have a single colour. Add frames one by one, then read ``told``, a
    description such as "black pictures" for a warning, or ``highest``, a number for statistics. No frame is kept.

    frames: the first frames, uint8 [H, W, 3] each
    """

    def __init__(self, frames: Iterable[UInt8Array] = ()) -> None:
        self._num_frames = self._in_a_row = self._most_in_a_row = self._highest = 0
        for frame in frames:
            self.add(frame)

    def add(self, frame: UInt8Array) -> None:
        """Count the next frame, uint8 [H, W, 3]."""
        self._num_frames += 1
        if not is_blank(frame):
            self._in_a_row = 0
            return
        self._in_a_row += 1
        self._most_in_a_row = max(self._most_in_a_row, self._in_a_row)
        self._highest = max(self._highest, int(frame.max()))

    @property
    def highest(self) -> int | None:
        """Highest value in the blank frames; None if the camera is not blank.

        A camera is blank if FRAMES_IN_A_ROW consecutive frames are blank, or all frames in a shorter episode.
        """
        enough = min(self._num_frames, FRAMES_IN_A_ROW)
        return self._highest if 0 < enough <= self._most_in_a_row else None

    @property
    def told(self) -> str:
        """The blank frames' description, from ``described``; empty if the camera is not blank."""
        return "" if self.highest is None else self.described(self.highest)

    @staticmethod
    def described(highest: int) -> str:
        """Describe blank frames. highest: the highest value in them."""
        if highest == 0:
            return "black pictures"
        if highest > _BLACK:
            return "pictures that are black or of one colour"
        text = f"black pictures, no value above {highest}"
        remedy = " (multiply floats in 0..1 by 255 before they become uint8)"
        return text + remedy * (highest <= _FLOATS)


def _is_flat(pixels: UInt8Array) -> bool:
    return int(pixels.max()) <= _BLACK or all(int(np.ptp(pixels[..., channel])) <= _RANGE for channel in range(3))
