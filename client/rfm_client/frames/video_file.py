# SPDX-License-Identifier: MIT
"""A video file whose frames are found by time, each decoded once. Needs PyAV.

Seconds follow the file, whose first frame need not be at 0. T frames, H x W pixels.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.samples import UInt8Array
from rfm_client.frames.pictures import FrameFileError
from rfm_client.frames.video_decoding import (
    DAMAGED,
    UNDAMAGED,
    Packets,
    Upright,
    import_av,
    judged,
    read_packets,
    video_stream,
)

_SEVERAL_EPISODES = (
    "a file in the layout of LeRobot v3.0, which holds several: label the dataset with rfm-client label, or name a "
    "part: start_s and end_s of load_trajectory, in seconds since the file's first frame (from_timestamp in "
    "meta/episodes, and length / fps later)"
)
_SHARED_FILE = re.compile(r"/videos/[^/]+/chunk-\d+/file-\d+\.\w+$")  # holds several episodes, in LeRobot v3.0


class Video:
    """A video file, read by time.

    container: FFmpeg's name for the file format; None: FFmpeg guesses it. Name it for untrusted files, because some
        formats make FFmpeg open other files or addresses
    """

    def __init__(self, file: Path, container: str | None = None) -> None:
        self.file = file
        self.container = container

    @staticmethod
    def decoder() -> str:
        """Return the versions of PyAV and the libraries that determine the pixels. Raises ImportError."""
        av = import_av()
        names = ("libswscale", "libavcodec", "libavfilter")
        libraries = (f"{name} {'.'.join(map(str, av.library_versions[name]))}" for name in names)
        return f"PyAV {av.__version__}, {', '.join(libraries)}"

    def check_is_one_episode(self) -> None:
        """Raise InvalidSampleError for a file in which LeRobot v3.0 keeps several episodes."""
        paths = [self.file.absolute().as_posix(), self.file.resolve().as_posix()]  # a download may be a link
        if any(map(_SHARED_FILE.search, paths)):
            raise InvalidSampleError.at("video", "a video of one episode", _SEVERAL_EPISODES)

    @cached_property
    def packets(self) -> Packets:
        """The packets, read without decoding. Raises FrameFileError for a broken file, or several videos in it."""
        try:
            with self.file.open("rb") as opened:
                return read_packets(opened, self.container)
        except (FileNotFoundError, IsADirectoryError) as error:
            got = "a folder: name the videos in it" if self.file.is_dir() else "none"
            raise FrameFileError.of("a video file", got) from error
        except import_av().InvalidDataError as error:
            raise FrameFileError.of("a file with a video stream", "a file of another kind, or a damaged one") from error
        except (import_av().FFmpegError, OSError) as error:
            raise FrameFileError.of("a whole video file", error.strerror or error) from error

    @contextmanager
    def opened(self) -> Iterator[tuple[Any, Any]]:
        """Yield the file as opened by PyAV, and its only video stream. Raises FrameFileError and PyAV's errors."""
        with import_av().open(str(self.file.absolute()), format=self.container) as container:
            # with PyAV's default threading: thread_type AUTO loses some damage marks
            yield container, video_stream(container)

    def frames_at(self, times_s: npt.NDArray[np.float64], tolerance_s: float) -> Iterator[UInt8Array]:
        """Yield the frames at these times, uint8 [H, W, 3], upright.

        times_s: float64 [T], rising time stamps
        tolerance_s: half the time between frames

        Raises FrameFileError for a missing or damaged frame.
        """
        num_given, upright = 0, Upright()
        try:
            with self.opened() as (container, stream):
                frames = _from(container, stream, float(times_s[0]), tolerance_s)
                for frame, is_damaged in _at(times_s, tolerance_s, judged(frames)):
                    if is_damaged:
                        raise FrameFileError.at(f"frame {num_given}", UNDAMAGED, DAMAGED)
                    yield upright(frame)
                    num_given += 1
        except (import_av().FFmpegError, OSError) as error:
            raise FrameFileError.of(f"frame {num_given} to be decoded", error.strerror or error) from error


def _from(container: Any, stream: Any, first_s: float, tolerance_s: float) -> Iterator[Any]:
    """Yield frames in time order, from one before ``first_s`` on."""
    # a frame earlier, because time stamps are rounded
    container.seek(max(int((first_s - 2 * tolerance_s) / stream.time_base), 0), stream=stream)
    frames = container.decode(stream)
    first = next(frames, None)
    if first is None or first.time > first_s + tolerance_s:  # the video's index led too far
        container.seek(0, stream=stream)
        frames = container.decode(stream)
        first = next(frames, None)
    if first is not None:
        yield first
    yield from frames


def _at(
    times_s: npt.NDArray[np.float64], tolerance_s: float, frames: Iterable[tuple[Any, bool]]
) -> Iterator[tuple[Any, bool]]:
    left = iter(frames)
    for t, time_s in enumerate(times_s.tolist()):
        found = next((each for each in left if each[0].time > time_s - tolerance_s), None)
        if found is None or found[0].time > time_s + tolerance_s:
            got = "none" if found is None else f"the next at {found[0].time:.4f} s"
            raise FrameFileError.of(f"frame {t} at {time_s:.4f} s", got)
        yield found
