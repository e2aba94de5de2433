# SPDX-License-Identifier: MIT
"""Read frames from video files. Needs PyAV: ``pip install "./client[video]"``."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from rfm_client.contract.checks import checked_finite, checked_positive, require
from rfm_client.contract.errors import InvalidSampleError, InvalidValueError
from rfm_client.contract.samples import UInt8Array
from rfm_client.frames.pictures import FrameFileError
from rfm_client.frames.video_decoding import (
    DAMAGED,
    DOWNLOAD,
    UNDAMAGED,
    Packets,
    Upright,
    import_av,
    judged,
)
from rfm_client.frames.video_file import Video

Take: TypeAlias = Callable[[int], object]

_LOST = (
    f"the decoder loses the others, as without a key frame before them: {DOWNLOAD}; or name a part: start_s of "
    "load_trajectory"
)
_REMUX = "extract the stream and encode it: ffmpeg -i IN -c copy RAW.h264; ffmpeg -framerate FPS -i RAW.h264 OUT.mp4"
_RGB_BYTES = 3  # bytes per pixel


def read_video(
    file: str | Path,
    fps: float | None = None,
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    take: Take | None = None,
    container: str | None = None,
) -> UInt8Array:
    """Return uint8 [T, H, W, 3], the frames at ``fps`` from a video file; None: all frames.

    Frames are counted, not timed: at a variable frame rate, T follows the average rate, and frames are evenly spaced in
    number, not in time. Colours equal ``ffmpeg -pix_fmt rgb24`` with any PyAV. Frames are turned and mirrored as the
    file says. Only the returned frames stay in memory.

    start_s, end_s: part from ``start_s`` to before ``end_s``, in seconds since the first frame;
        None: from the start, to the end
    take: called with the byte count before each frame takes memory; an error in it ends the reading
    container: FFmpeg's name for the file format; None: FFmpeg guesses. Name it for untrusted files, because some
        formats make FFmpeg open other files or addresses

    Raises InvalidSampleError for a missing file, for no video, several videos or depth maps, if there are fewer frames
    than packets, and if the decoder marks a returned frame as damaged. Also for a file with several LeRobot episodes
    (v3.0) without both ``start_s`` and ``end_s``.
    """
    import_av()
    _check_numbers(fps, start_s, end_s)
    take = take or (lambda num_bytes: None)
    with _errors_of(file):
        if is_url(file):
            raise FrameFileError.at("", "a video file", "a URL", "download it first: curl -LO URL")
        video = Video(Path(file), container)
        if start_s is None or end_s is None:
            video.check_is_one_episode()
        is_part = (start_s, end_s) != (None, None)
        if not video.packets.fps and (is_part or fps is not None):
            raise FrameFileError.of("a frame rate", "none")
        if is_part:
            frames = _part(video, _within(video.packets, start_s, end_s), fps, take)
        else:
            frames = _whole(video, fps, take)
        if not frames:
            raise FrameFileError.of("at least one frame", "none")
        if len({frame.shape for frame in frames}) > 1:
            raise FrameFileError.of("frames of one size", "several")
        take(sum(frame.nbytes for frame in frames))
        return np.stack(frames)


def is_url(source: str | Path) -> bool:
    """True for an address instead of a file."""
    return str(source).lower().startswith(("http:/", "https:/"))  # Path drops a slash


def frame_times_s(file: str | Path, num_frames: int, *, container: str | None = None) -> npt.NDArray[np.float64] | None:
    """Return float64 [T], frame times from 0 for ``read_video``; None: unknown.

    num_frames: T
    container: as in ``read_video``
    """
    with _errors_of(file):
        packets = Video(Path(file), container).packets
    if len(packets.times_s) < max(num_frames, packets.count):
        return None
    return packets.since_first_s[_spread(packets.count, num_frames)]


@contextmanager
def _errors_of(source: str | Path) -> Iterator[None]:
    """Turn errors in the block into InvalidSampleError with the source."""
    try:
        yield
    except FrameFileError as error:
        raise InvalidSampleError.like(error, where="video", source=str(source)) from error
    except InvalidSampleError as error:
        raise InvalidSampleError.like(error, source=str(source)) from error
    except (import_av().FFmpegError, OSError) as error:
        located = InvalidSampleError.at("video", "a whole video file", error.strerror or error)
        raise InvalidSampleError.like(located, source=str(source)) from error


def _check_numbers(fps: float | None, start_s: float | None, end_s: float | None) -> None:
    try:
        for where, number in (("fps", fps), ("end_s", end_s)):
            if number is not None:
                checked_positive(where, number)
        if start_s is not None:
            require("start_s", checked_finite("start_s", start_s) >= 0, "0 or more", start_s)
    except InvalidValueError as error:
        raise InvalidSampleError.like(error) from None


def _spread(total: int, count: int) -> npt.NDArray[np.int64]:
    """int64 [count], evenly spaced from first to last of ``total``, rounded down."""
    return np.linspace(0, total - 1, count).astype(np.int64)


def _within(packets: Packets, start_s: float | None, end_s: float | None) -> tuple[int, int]:
    """Return the first frame numbers at or after ``start_s`` and ``end_s``, within half the time to the next frame."""
    times_s = packets.since_first_s
    latest_s = times_s + 0.5 * np.minimum(1 / packets.fps, np.diff(times_s, append=math.inf))
    first, end = np.searchsorted(latest_s, [start_s or 0.0, math.inf if end_s is None else end_s]).tolist()
    if first >= end:
        got = f"{start_s} to {end_s} of {times_s[-1] if len(times_s) else 0.0:g} s"
        raise InvalidSampleError.at("start_s to end_s", "a part with frames", got)
    return first, end


def _picked(first: int, end: int, packets: Packets, fps: float | None) -> npt.NDArray[np.int64]:
    """Return int64 [T], which frames from ``first`` to before ``end`` to show at ``fps``.

    As in upstream's example client: T = round(total * fps / native_fps), at least 1 and at most ``total``, evenly
    spaced from first to last, rounded down.
    """
    total = end - first
    return first + _spread(total, total if fps is None else min(max(round(total * fps / packets.fps), 1), total))


def _whole(video: Video, fps: float | None, take: Take) -> Sequence[UInt8Array]:
    """Return the frames at ``fps``, found by number, because some videos have no time stamps."""
    packets = video.packets
    wanted = set(_picked(0, packets.count, packets, fps).tolist())
    frames, times_s = _decoded(video, lambda number, _: number in wanted, take)
    total = len(times_s)
    if packets.num_hidden and not _rises(times_s):  # the hidden frames are not the ones meant
        expected = f"{packets.count + packets.num_hidden} frames ({_REMUX})"
        raise FrameFileError.of(expected, f"{total}, and time stamps in another order than the frames")
    if total < packets.count:
        raise FrameFileError.of(f"{packets.count} frames, one for each packet", f"{total} ({_LOST})")
    if total > packets.count:  # a packet may hold several frames
        wanted = set(_picked(0, total, packets, fps).tolist())
        frames, _ = _decoded(video, lambda number, _: number in wanted, take)
    return frames


def _part(video: Video, part: tuple[int, int], fps: float | None, take: Take) -> Sequence[UInt8Array]:
    """Return a part's frames at ``fps``, found by time stamp, because frames before it may be lost."""
    packets = video.packets
    wanted_s = set(packets.times_s[_picked(*part, packets, fps)].tolist())
    begin_s, last_s = packets.times_s[part[0]], packets.times_s[part[1] - 1]
    frames, times_s = _decoded(video, lambda _, time_s: time_s in wanted_s, take)
    if packets.count != len(packets.times_s) or None in times_s:
        raise FrameFileError.of(f"{packets.count} frames with time stamps", f"{len(packets.times_s)}")
    if not _rises(times_s):
        raise FrameFileError.of(f"frames in the order of their time stamps ({_REMUX})", "another order")
    expected, total = part[1] - part[0], sum(begin_s <= time_s <= last_s for time_s in times_s if time_s is not None)
    if total != expected:
        raise FrameFileError.of(f"{expected} frames in this part, one for each packet", f"{total} ({_LOST})")
    return frames


def _rises(times_s: Sequence[float | None]) -> bool:
    known_s = [time_s for time_s in times_s if time_s is not None]
    return all(before < after for before, after in itertools.pairwise(known_s))


def _decoded(
    video: Video, is_wanted: Callable[[int, float | None], bool], take: Take
) -> tuple[Sequence[UInt8Array], Sequence[float | None]]:
    """Return the frames wanted by number and time, and the times of all frames; None: no time stamp."""
    picked: list[UInt8Array] = []
    times_s: list[float | None] = []
    upright = Upright()
    try:
        with video.opened() as (container, stream):
            for number, (frame, is_damaged) in enumerate(judged(container.decode(stream))):
                time_s = None if frame.pts is None else float(frame.pts * frame.time_base)
                is_picked = is_wanted(number, time_s)
                take(frame.width * frame.height * _RGB_BYTES if is_picked else 0)
                if is_picked:
                    if is_damaged:
                        raise InvalidSampleError.at(f"video: frame {number}", UNDAMAGED, DAMAGED)
                    picked.append(upright(frame))
                times_s.append(time_s)
    except import_av().FFmpegError as error:
        raise FrameFileError.of(f"frame {len(times_s)} to be decoded ({DOWNLOAD})", str(error.strerror)) from error
    return picked, times_s
