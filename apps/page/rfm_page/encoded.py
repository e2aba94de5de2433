# SPDX-License-Identifier: MIT
"""Pictures of an episode as a video for the browser."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from typing import Any

import av
import numpy as np

from rfm_client import UInt8Array

_CODING = {"crf": "12", "g": "10", "preset": "veryfast"}  # of H.264: hardly any loss, and quick to move in


def encoded(frames: Iterator[UInt8Array], fps: float, take: Callable[[int], object]) -> bytes:
    """Return pictures as an MP4 file of nearly the same colours.

    frames: uint8 [H, W, 3] each
    take: called with a number of bytes before they are allocated
    """
    video = io.BytesIO()
    with av.open(video, "w", format="mp4") as container:
        stream: Any = None
        for frame in frames:
            even = np.pad(frame, [(0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)], "edge")  # for H.264
            if stream is None:
                stream = container.add_stream("libx264", Fraction(fps).limit_denominator(1000), options=_CODING)
                stream.height, stream.width, stream.pix_fmt = *even.shape[:2], "yuv420p"
                take(even.nbytes)
            _mux(container, stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")), take)
        _mux(container, stream.encode(None), take)
    return video.getvalue()


def _mux(container: Any, packets: Sequence[Any], take: Callable[[int], object]) -> None:
    for packet in packets:
        take(packet.size)
        container.mux(packet)
