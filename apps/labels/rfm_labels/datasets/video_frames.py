# SPDX-License-Identifier: MIT
"""Frames of a video at T given times, found by their time stamps, each exactly once. Needs PyAV.

Seconds are the video's, whose first frame need not be at 0.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client import InvalidSampleError, UInt8Array
from rfm_client.frames import (
    DAMAGED,
    UNDAMAGED,
    Packets,
    Upright,
    import_av,
    judged,
    read_packets,
    video_stream,
)
from rfm_labels.datasets.protocol import DatasetError

Times = npt.NDArray[np.float64]

_READ_BYTES = 2**20
_DIGESTS_AT_A_TIME = 2**16


def video_identity(file: Path, *, verify: bool, revision: str | None = None) -> str:
    """Return a text that identifies a video: its size and modification time, or with ``verify`` its SHA-256.

    revision: commit on the Hub; replaces the time, which differs on every machine

    Raises DatasetError.
    """
    try:
        status = file.stat()
        if verify:
            return _sha256(file, status.st_size, status.st_ctime_ns)
    except FileNotFoundError as error:
        raise DatasetError.at(file, "a video file", "none") from error
    except OSError as error:
        raise DatasetError.at(file, "a readable video file", error.strerror) from error
    return f"{status.st_size} {revision or status.st_mtime_ns}"


@lru_cache(_DIGESTS_AT_A_TIME)
def _sha256(file: Path, _size: int, _changed_ns: int) -> str:
    digest = hashlib.sha256()
    with file.open("rb") as opened:
        while content := opened.read(_READ_BYTES):
            digest.update(content)
    return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class Span:
    """The frames of one episode in a video.

    times_s: float64 [T], rising time stamps in the video
    tolerance_s: half the time between frames
    where: episode and camera, for messages
    container: FFmpeg's name of the file's format; None: FFmpeg guesses it
    """

    file: Path
    times_s: Times
    tolerance_s: float
    where: str
    container: str | None = None

    def error(self, expected: str, got: str) -> DatasetError:
        """Return the error of this span's video."""
        return DatasetError.at(f"{self.where}: {self.file}", expected, got)


def video_packets(file: Path, container: str | None = None) -> Packets:
    """Return the packets of a video. Raises DatasetError for a missing or broken file, or several videos in a file."""
    av = import_av()
    try:
        with file.open("rb") as opened:
            packets = read_packets(opened, container)
    except InvalidSampleError as error:
        raise DatasetError.like(error, where=str(file)) from error
    except FileNotFoundError as error:
        raise DatasetError.at(file, "a video file", "none") from error
    except (av.FFmpegError, OSError) as error:
        raise DatasetError.at(file, "a whole video file", error.strerror or error) from error
    return packets


def decode(span: Span) -> Iterator[UInt8Array]:
    """Yield the T frames, uint8 [H, W, 3], upright. Raises DatasetError for a missing or damaged frame."""
    av = import_av()
    num_given, upright = 0, Upright()
    try:
        with av.open(str(span.file), format=span.container) as container:
            for frame, is_damaged in _within(span, judged(_decoded(container, span))):
                if is_damaged:
                    raise DatasetError.at(f"{span.where}: {span.file}: frame {num_given}", UNDAMAGED, DAMAGED)
                yield upright(frame)
                num_given += 1
    except InvalidSampleError as error:
        raise DatasetError.like(error, where=f"{span.where}: {span.file}") from error
    except (av.FFmpegError, OSError) as error:
        raise span.error(f"frame {num_given} to be decoded", error.strerror or str(error)) from error


def _decoded(container: Any, span: Span) -> Iterator[Any]:
    """Frames from before the span on, in order of time."""
    stream = video_stream(container)  # with PyAV's default of threads: thread_type AUTO loses some marks of damage
    first_s = float(span.times_s[0])
    # a frame earlier, because time stamps are rounded
    container.seek(max(int((first_s - 2 * span.tolerance_s) / stream.time_base), 0), stream=stream)
    frames = container.decode(stream)
    first = next(frames, None)
    if first is None or first.time > first_s + span.tolerance_s:  # the video's index led too far
        container.seek(0, stream=stream)
        frames = container.decode(stream)
        first = next(frames, None)
    if first is not None:
        yield first
    yield from frames


def _within(span: Span, frames: Iterator[tuple[Any, bool]]) -> Iterator[tuple[Any, bool]]:
    for t, time_s in enumerate(span.times_s.tolist()):
        found = next((each for each in frames if each[0].time > time_s - span.tolerance_s), None)
        if found is None or found[0].time > time_s + span.tolerance_s:
            got = "none" if found is None else f"the next at {found[0].time:.4f} s"
            raise span.error(f"frame {t} at {time_s:.4f} s", got)
        yield found
