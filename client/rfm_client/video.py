# SPDX-License-Identifier: MIT
"""Video files -> frames. Needs PyAV: ``pip install "rfm-client[video]"``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.errors import InvalidSampleError
from rfm_client.samples import UInt8Array


def frame_indices(total: int, native_fps: float, fps: float) -> npt.NDArray[np.int64]:
    """int64 [T], which of ``total`` frames stand for the video at ``fps``.

    As the original example client picks them: round(total * fps / native_fps) frames, at least one and at most
    all, evenly from the first to the last, truncated to whole frames.
    """
    count = min(max(round(total * fps / native_fps), 1), total)
    return np.linspace(0, total - 1, count).astype(np.int64)


def read_video(file: str | Path, fps: float) -> UInt8Array:
    """uint8 [T, H, W, 3], the video's frames at ``fps``. Raises InvalidSampleError for what is no video."""
    try:
        import av
    except ImportError as error:
        raise ImportError('video files need PyAV: pip install "rfm-client[video]"') from error
    try:
        total, native_fps = _length(av, file)
        wanted = set(frame_indices(total, native_fps, fps).tolist())
        with av.open(str(file)) as container:
            frames = [
                frame.to_ndarray(format="rgb24")
                for index, frame in enumerate(container.decode(video=0))
                if index in wanted
            ]
    except (av.FFmpegError, OSError, IndexError) as error:
        raise InvalidSampleError.at("video", "a file with a video stream", f"{file}: {error}") from error
    return np.stack(frames)


def _length(av: Any, file: str | Path) -> tuple[int, float]:
    """Frames that can be decoded (what the container says of it may be wrong), and frames a second."""
    with av.open(str(file)) as container:
        stream = container.streams.video[0]
        total = sum(1 for _ in container.decode(stream))
        if not total or not stream.average_rate:
            raise InvalidSampleError.at("video", "at least one frame", f"{file}: none")
        return total, float(stream.average_rate)
