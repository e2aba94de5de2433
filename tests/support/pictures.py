# SPDX-License-Identifier: MIT
"""Frames of synthetic videos."""

from __future__ import annotations

import struct
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from rfm_client import UInt8Array

TOP, WRIST = "observation.images.top", "observation.images.wrist"

Matrix = tuple[int, int, int, int]

# The display matrix of a track: (a, b, c, d) of x' = a x + c y, y' = b x + d y, y downwards (ISO 14496-12), and what it
# makes of an image.
TURNS: dict[str, tuple[Matrix, Callable[[UInt8Array], UInt8Array]]] = {
    "clockwise": ((0, 1, -1, 0), lambda image: np.rot90(image, -1)),
    "upside down": ((-1, 0, 0, -1), lambda image: np.rot90(image, 2)),
    "counter-clockwise": ((0, -1, 1, 0), np.rot90),
    "mirrored": ((-1, 0, 0, 1), np.fliplr),
    "mirrored upside down": ((1, 0, 0, -1), np.flipud),
    "mirrored, then clockwise": ((0, -1, -1, 0), lambda image: np.rot90(np.fliplr(image), -1)),
    "mirrored, then counter-clockwise": ((0, 1, 1, 0), lambda image: np.rot90(np.fliplr(image))),
    "without a matrix": ((0, 0, 0, 0), lambda image: image),
}


def write_video(
    file: Path, frames: UInt8Array, times: list[int] | None = None, *, shown_from: int = 0, codec: str = "libx264"
) -> None:
    """Write a video at 10 fps, or with frames at these tenths of a second, to be shown from ``shown_from`` on."""
    with av.open(str(file), "w", options={"avoid_negative_ts": "disabled"} if shown_from else {}) as container:
        options = {"bf": "0", "crf": "1"} if codec == "libx264" else {"b": "9M"}
        stream = container.add_stream(codec, rate=Fraction(10), options=options)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv444p" if codec == "libx264" else "yuv420p"
        packets = []
        for time, image in zip(times or range(len(frames)), frames, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 10)
            packets += stream.encode(frame)
        for packet in [*packets, *stream.encode()]:
            packet.pts -= shown_from
            packet.dts -= shown_from
            container.mux(packet)


def numbered(count: int) -> UInt8Array:
    """Return grey frames [count, 32, 32, 3] of increasing brightness; ``numbers`` reads them back."""
    grey = (np.arange(count) * 240 // count).astype(np.uint8)
    return np.ascontiguousarray(np.broadcast_to(grey[:, None, None, None], (count, 32, 32, 3)))


def numbers(frames: UInt8Array, count: int) -> list[int]:
    """Return the frames' numbers in ``numbered(count)``."""
    means = frames.mean(axis=(1, 2, 3))
    return np.abs(means[:, None] - numbered(count)[:, 0, 0, 0]).argmin(axis=1).tolist()


def turn(file: Path, matrix: Matrix) -> None:
    """Set the matrix of an MP4 file's track to an entry of TURNS."""
    content = file.read_bytes()
    a, b, c, d = (value << 16 for value in matrix)
    start = content.index(b"tkhd") + 4 + 40  # version 0: the matrix follows 40 bytes of other fields
    turned = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    file.write_bytes(content[:start] + turned + content[start + len(turned) :])
