# SPDX-License-Identifier: MIT
"""Writes a video in AV1: ``python av1_video.py FILE FRAMES.npy``, frames uint8 [T, H, W, 3] at 10 a second.

A program of its own, since the encoder SVT-AV1, where root runs it, gives the thread that calls it a real-time priority
for good: whatever that thread did or started later would keep all else from the processors.
"""

from __future__ import annotations

import sys

import av
import numpy as np

FPS = 10
OPTIONS = {"crf": "20", "g": "2", "svtav1-params": "lp=1"}


def write(file: str, frames: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> None:
    with av.open(file, "w") as container:
        stream = container.add_stream("libsvtav1", rate=FPS, options=OPTIONS)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], "yuv420p"
        for image in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


if __name__ == "__main__":
    write(sys.argv[1], np.load(sys.argv[2]))
