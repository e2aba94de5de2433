# SPDX-License-Identifier: MIT
"""Write frames as a video file that browsers play."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av

from toy_world.render import UInt8Array

FPS = 3  # the client's default sampling rate for videos


def write_video(file: Path, frames: UInt8Array, fps: int = FPS) -> None:
    """Write uint8 [T, H, W, 3], RGB, H and W even, as H.264."""
    with av.open(str(file), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps), options={"crf": "1"})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for image in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
