# SPDX-License-Identifier: MIT
"""Frames of made-up films."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from rfm_client.contract.samples import UInt8Array

TOP, WRIST = "observation.images.top", "observation.images.wrist"


def write_video(file: Path, frames: UInt8Array, times: list[int] | None = None, *, shown_from: int = 0) -> None:
    """A video of 10 fps, or of frames at these tenths of a second; frames before ``shown_from`` are not to be shown."""
    with av.open(str(file), "w", options={"avoid_negative_ts": "disabled"} if shown_from else {}) as container:
        stream = container.add_stream("libx264", rate=Fraction(10), options={"bf": "0", "crf": "1"})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv444p"
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
    """Grey frames [count, 32, 32, 3], each of its own brightness; ``numbers`` reads them back."""
    grey = (np.arange(count) * 240 // count).astype(np.uint8)
    return np.ascontiguousarray(np.broadcast_to(grey[:, None, None, None], (count, 32, 32, 3)))


def numbers(frames: UInt8Array, count: int) -> list[int]:
    """Which of ``numbered(count)`` the frames are."""
    means = frames.mean(axis=(1, 2, 3))
    return np.abs(means[:, None] - numbered(count)[:, 0, 0, 0]).argmin(axis=1).tolist()
