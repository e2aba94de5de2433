# SPDX-License-Identifier: MIT
"""Read frames from video files and URLs. Needs PyAV: ``pip install "./client[video]"``."""

from __future__ import annotations

import itertools
import math
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from http.client import HTTPException
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO, TypeAlias
from urllib.error import HTTPError

import numpy as np
import numpy.typing as npt

from rfm_client.contract.addresses import open_url
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
    check_is_one_episode,
    import_av,
    judged,
    read_packets,
    video_stream,
)

DOWNLOAD_TIMEOUT_S = 60.0

Take: TypeAlias = Callable[[int], object]

_EXPECTED = "a file with a video stream"
_LOST = (
    f"the decoder loses the others, as without a key frame before them: {DOWNLOAD}; or name a part: start_s of "
    "load_trajectory"
)
_REMUX = "extract the stream and encode it: ffmpeg -i IN -c copy RAW.h264; ffmpeg -framerate FPS -i RAW.h264 OUT.mp4"
_RGB_BYTES = 3  # bytes per pixel


def frame_indices(total: int, native_fps: float, fps: float) -> npt.NDArray[np.int64]:
    """Return int64 [T], which frames to show from a video with ``total`` frames at ``fps``.

    As in upstream's example client: T = round(total * fps / native_fps), at least 1 and at most ``total``, evenly
    spaced from first to last, rounded down.
    """
    count = min(max(round(total * fps / native_fps), 1), total)
    return _spread(total, count)


def is_url(source: str | Path) -> bool:
    """True if ``read_video`` downloads the source."""
    return isinstance(source, str) and source.lower().startswith(("http://", "https://"))


def read_video(
    source: str | Path,
    fps: float | None = None,
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    timeout_s: float = DOWNLOAD_TIMEOUT_S,
    take: Take | None = None,
    container: str | None = None,
) -> UInt8Array:
    """Return uint8 [T, H, W, 3], the frames at ``fps`` from a video file or http(s) URL; None: all frames.

    Frames are counted, not timed: at a variable frame rate, T follows the average rate, and frames are evenly spaced in
    number, not in time. Colours equal ``ffmpeg -pix_fmt rgb24`` with any PyAV. Frames are turned and mirrored as the
    file says. Only the returned frames stay in memory. A URL is downloaded once, to a temporary file.

    start_s, end_s: part from ``start_s`` to before ``end_s``, in seconds since the first frame;
        None: from the start, to the end
    timeout_s: how long a URL's server may stay silent
    take: called with the byte count before each frame takes memory; an error in it ends the reading
    container: FFmpeg's name for the file format; None: FFmpeg guesses. Name it for untrusted files, because some
        formats make FFmpeg open other files or addresses

    Raises InvalidSampleError for a missing file, for no video, several videos or depth maps, if there are fewer frames
    than packets, and if the decoder marks a returned frame as damaged. Also for a file with several LeRobot episodes
    (v3.0) without both ``start_s`` and ``end_s``.
    """
    import_av()
    _check_numbers(fps, start_s, end_s, timeout_s)
    take = take or (lambda num_bytes: None)
    with _errors_of(source):
        if start_s is None or end_s is None:
            check_is_one_episode(source)
        with _opened(source, timeout_s) as file:
            is_part = (start_s, end_s) != (None, None)
            packets = read_packets(file, container)
            if not packets.fps and (is_part or fps is not None):
                raise FrameFileError.of("a frame rate", "none")
            if is_part:
                frames = _part(file, packets, _within(packets, start_s, end_s), fps, take, container)
            else:
                frames = _whole(file, packets, fps, take, container)
        if not frames:
            raise FrameFileError.of("at least one frame", "none")
        if len({frame.shape for frame in frames}) > 1:
            raise FrameFileError.of("frames of one size", "several")
        take(sum(frame.nbytes for frame in frames))
        return np.stack(frames)


def frame_times_s(file: str | Path, num_frames: int, *, container: str | None = None) -> npt.NDArray[np.float64] | None:
    """Return float64 [T], frame times from 0 for ``read_video``; None: unknown.

    num_frames: T
    container: as in ``read_video``
    """
    with _errors_of(file), Path(file).open("rb") as opened:
        packets = read_packets(opened, container)
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
    except (import_av().FFmpegError, OSError, ValueError) as error:
        located = InvalidSampleError.at("video", _EXPECTED, _read_instead(error))
        if isinstance(error, FileNotFoundError):
            located = InvalidSampleError.at("video", "a video file", "no file of this name")
        raise InvalidSampleError.like(located, source=str(source)) from error


def _read_instead(error: Exception) -> object:
    """Say what was there instead of a video, without quoting FFmpeg or urllib."""
    if isinstance(error, import_av().InvalidDataError):
        return "a file of another kind, or a damaged one"
    reason = getattr(error, "reason", None)  # from a URL
    fault = reason if isinstance(reason, OSError) else error
    return getattr(fault, "strerror", None) or fault


def _check_numbers(fps: float | None, start_s: float | None, end_s: float | None, timeout_s: float) -> None:
    try:
        checked_positive("timeout_s", timeout_s)
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


@contextmanager
def _opened(source: str | Path, timeout_s: float) -> Iterator[BinaryIO]:
    if not is_url(source):
        with Path(source).open("rb") as file:
            yield file
        return
    with TemporaryFile() as copy:  # read twice, and an MP4's index may be at its end
        _download(str(source), copy, timeout_s)
        yield copy


def _download(url: str, file: BinaryIO, timeout_s: float) -> None:
    try:
        with open_url(url, timeout_s) as response:
            shutil.copyfileobj(response, file)
            length = response.headers.get("Content-Length")
        if length and file.tell() != int(length):  # urllib takes a broken connection for the end
            raise OSError(f"{file.tell()} of {length} bytes came")
    except (OSError, HTTPException, ValueError) as error:
        if isinstance(error, HTTPError):
            error.close()  # an HTTPError holds the connection
        raise FrameFileError.of(_EXPECTED, _read_instead(error)) from error


def _within(packets: Packets, start_s: float | None, end_s: float | None) -> tuple[int, int]:
    """Return the first frame numbers at or after ``start_s`` and ``end_s``, within half a frame."""
    half_s, times_s = 0.5 / packets.fps, packets.since_first_s
    bounds_s = [(start_s or 0.0) - half_s, (math.inf if end_s is None else end_s) - half_s]
    first, end = np.searchsorted(times_s, bounds_s).tolist()
    if first >= end:
        got = f"{start_s} to {end_s} of {times_s[-1] if len(times_s) else 0.0:g} s"
        raise InvalidSampleError.at("start_s to end_s", "a part with frames", got)
    return first, end


def _picked(first: int, end: int, packets: Packets, fps: float | None) -> npt.NDArray[np.int64]:
    own_fps, fps = (1.0, 1.0) if fps is None else (packets.fps, fps)
    return first + frame_indices(end - first, own_fps, fps)


def _whole(
    file: BinaryIO, packets: Packets, fps: float | None, take: Take, container: str | None
) -> Sequence[UInt8Array]:
    """Return the frames at ``fps``, found by number, because some videos have no time stamps."""
    wanted = set(_picked(0, packets.count, packets, fps).tolist())
    frames, times_s = _decoded(file, lambda number, _: number in wanted, take, container)
    total = len(times_s)
    if packets.num_hidden and not _rises(times_s):  # the hidden frames are not the ones meant
        expected = f"{packets.count + packets.num_hidden} frames ({_REMUX})"
        raise FrameFileError.of(expected, f"{total}, and time stamps in another order than the frames")
    if total < packets.count:
        raise FrameFileError.of(f"{packets.count} frames, one for each packet", f"{total} ({_LOST})")
    if total > packets.count:  # a packet may hold several frames
        wanted = set(_picked(0, total, packets, fps).tolist())
        frames, _ = _decoded(file, lambda number, _: number in wanted, take, container)
    return frames


def _part(
    file: BinaryIO, packets: Packets, part: tuple[int, int], fps: float | None, take: Take, container: str | None
) -> Sequence[UInt8Array]:
    """Return a part's frames at ``fps``, found by time stamp, because frames before it may be lost."""
    wanted_s = set(packets.times_s[_picked(*part, packets, fps)].tolist())
    begin_s, last_s = packets.times_s[part[0]], packets.times_s[part[1] - 1]
    frames, times_s = _decoded(file, lambda _, time_s: time_s in wanted_s, take, container)
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
    file: BinaryIO, is_wanted: Callable[[int, float | None], bool], take: Take, container: str | None
) -> tuple[Sequence[UInt8Array], Sequence[float | None]]:
    """Return the frames wanted by number and time, and the times of all frames; None: no time stamp."""
    picked: list[UInt8Array] = []
    times_s: list[float | None] = []
    upright = Upright()
    file.seek(0)
    with import_av().open(file, format=container) as opened:
        for number, (frame, is_damaged) in enumerate(_judged(opened.decode(video_stream(opened)))):
            times_s.append(None if frame.pts is None else float(frame.pts * frame.time_base))
            is_picked = is_wanted(number, times_s[-1])
            take(frame.width * frame.height * _RGB_BYTES if is_picked else 0)
            if is_picked:
                if is_damaged:
                    raise InvalidSampleError.at(f"video: frame {number}", UNDAMAGED, DAMAGED)
                picked.append(upright(frame))
    return picked, times_s


def _judged(frames: Iterable[Any]) -> Iterator[tuple[Any, bool]]:
    """Yield from ``judged``; if a frame fails, the error names its number."""
    num_given = 0
    try:
        for each in judged(frames):
            yield each
            num_given += 1
    except import_av().FFmpegError as error:
        raise FrameFileError.of(f"frame {num_given} to be decoded ({DOWNLOAD})", str(error.strerror)) from error
