# SPDX-License-Identifier: MIT
"""Writes videos: ``python encoding.py FILE FRAMES.npy CODEC OPTIONS.json``, frames uint8 [T, H, W, 3] at 10 a second.

A separate program, since the encoder SVT-AV1, where root runs it, gives the calling thread a real-time priority
for good: whatever that thread did or started later would keep all else from the processors.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

FPS = 10


def encode(file: Path, frames: Sequence[np.ndarray[Any, Any]], codec: str, options: Mapping[str, str]) -> None:
    """Writes a video of frames uint8 [H, W, 3] with this program."""
    with tempfile.TemporaryDirectory() as folder:
        array = Path(folder, "frames.npy")
        np.save(array, np.stack(frames))
        subprocess.run([sys.executable, __file__, file, array, codec, json.dumps(options)], check=True)


def encode_here(
    target: Any,
    frames: Sequence[np.ndarray[Any, Any]] | np.ndarray[Any, Any],
    codec: str = "libx264",
    options: Mapping[str, str] | None = None,
    *,
    pixels: str = "yuv420p",
    rate: Fraction = Fraction(FPS),
    of_container: Mapping[str, str] | None = None,
    format: str | None = None,
) -> None:
    """Write a video in this process, for other encoders. target: a path, or an object with ``write``"""
    target = str(target) if isinstance(target, Path) else target
    with av.open(target, "w", format=format, options=dict(of_container or {})) as container:
        stream: Any = container.add_stream(codec, rate=rate, options=dict(options or {}))
        stream.height, stream.width, stream.pix_fmt = *frames[0].shape[:2], pixels
        for image in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


if __name__ == "__main__":
    encode_here(sys.argv[1], np.load(sys.argv[2]), sys.argv[3], json.loads(sys.argv[4]))
