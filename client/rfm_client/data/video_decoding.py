# SPDX-License-Identifier: MIT
"""Decoding that all readers of videos share: choice of the stream, colours, orientation, damaged frames, broken files.

The containers, streams, packets and frames are PyAV's.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from rfm_client.contract.samples import UInt8Array

UNDAMAGED = "an undamaged frame"
DAMAGED = "one that the decoder marks, or is made from such a one"

_MATRICES = (1, 4, 5, 7, 9)  # from YUV to RGB, as libswscale numbers them; the frame's numbers (ITU-T H.273) are equal
_BT709, _BT601, _BT2020 = 1, 5, 9
_SAME_MATRIX = {6: _BT601, 10: _BT2020}  # numbers of H.273 that stand for one of them
_LIMITED, _FULL = 1, 2  # ranges, numbered likewise
_BITS = 8  # of the one channel of a grey video; depth maps have more
_NEARLY = math.tan(math.radians(1))  # how far FFmpeg lets a display matrix be from quarter turns

_EBML, _SEGMENT = 0x1A45DFA3, 0x18538067  # how Matroska and WebM begin (RFC 8794, RFC 9559)
_BOX_BYTES = 8  # size and kind of an MP4 box (ISO 14496-12)
_BIG = 1  # a size that says that 8 more bytes tell it
_FRAMES = b"mdat"
_BOXES = (b"ftyp", b"styp", b"free", b"skip", b"wide", b"moov", b"moof", b"sidx", b"uuid", b"emsg", b"prft", _FRAMES)


class VideoError(Exception):
    """A file that cannot be read as one video: what was expected, and what is there."""

    def __init__(self, expected: str, got: str) -> None:
        super().__init__(expected, got)
        self.expected = expected
        self.got = got


def import_av() -> Any:
    """The module ``av``. Raises ImportError that names the extra."""
    try:
        import av
    except ImportError as error:
        raise ImportError('video files need PyAV: pip install "./client[video]"') from error
    return av


def decoder() -> str:
    """PyAV with its version, and those of the libraries in it that decide what a decoded frame looks like."""
    av = import_av()
    libraries = (f"{name} {'.'.join(map(str, av.library_versions[name]))}" for name in ("libswscale", "libavcodec"))
    return f"PyAV {av.__version__}, {', '.join(libraries)}"


def video_stream(container: Any) -> Any:
    """The video stream of an opened file that is the video. Attached pictures, such as cover art, are none.

    Raises VideoError if there is none, or more than one, and for depth maps.
    """
    attached = import_av().stream.Disposition.attached_pic
    videos = {n: stream for n, stream in enumerate(container.streams.video) if not stream.disposition & attached}
    if not videos:
        raise VideoError("a file with a video stream", "none")
    if len(videos) > 1:
        codecs = {n: stream.codec_context for n, stream in videos.items()}
        told = ", ".join(f"0:v:{n} ({codec.name}, {codec.width}x{codec.height})" for n, codec in codecs.items())
        raise VideoError("one video stream (take one: ffmpeg -i IN -map 0:v:N -c copy OUT)", f"{len(videos)}: {told}")
    (stream,) = videos.values()
    _check_colours(stream.codec_context.format)
    return stream


@dataclass(frozen=True, eq=False)
class Packets:
    """What a video holds, read without decoding it.

    count: of its frames that are shown, as far as each has a packet of its own
    times_s: float64 [N], rising, of those that have a time stamp
    num_bytes: how many bytes each of these has
    corrupt: numbers of the packets that are broken
    tick_s: what times are multiples of
    fps: frames a second on average; 0: the file does not say it
    """

    count: int
    times_s: npt.NDArray[np.float64]
    num_bytes: tuple[int, ...]
    corrupt: tuple[int, ...]
    tick_s: float
    fps: float


def read_packets(file: BinaryIO, container: str | None = None) -> Packets:
    """The packets of a video. Counts them, since what the container says may be wrong.

    container: FFmpeg's name of the format that the file is read as; None: whatever it looks like

    Raises VideoError, as for a file that breaks off, and what PyAV raises.
    """
    missing = _broken_off(file)
    if missing is not None:
        raise VideoError("a whole video file", missing)
    file.seek(0)
    timed: list[tuple[float, int]] = []
    corrupt: list[int] = []
    count = 0
    with import_av().open(file, format=container) as opened:
        stream = video_stream(opened)
        for packet in opened.demux(stream):
            if not packet.size or packet.is_discard:  # not shown, as a video that was cut without encoding has them
                continue
            if packet.pts is not None:
                timed.append((float(packet.pts * packet.time_base), packet.size))
            if packet.is_corrupt:
                corrupt.append(count)
            count += 1
        tick_s, fps = float(stream.time_base), float(stream.average_rate or 0)
    timed.sort()
    times_s = np.array([time_s for time_s, _ in timed])
    return Packets(count, times_s, tuple(size for _, size in timed), tuple(corrupt), tick_s, fps)


def upright(frame: Any) -> UInt8Array:
    """uint8 [H, W, 3], a decoded frame in RGB as it is to be shown, turned and mirrored as FFmpeg does.

    Raises VideoError for a frame that is to be shown aslant.
    """
    image, matrix = _rgb(frame), frame.side_data.get("DISPLAYMATRIX")
    return image if matrix is None else np.ascontiguousarray(_shown(image, np.frombuffer(bytes(matrix), np.int32)))


def judged(frames: Iterable[Any]) -> Iterator[tuple[Any, bool]]:
    """Each decoded frame, and whether it is damaged: the decoder marks it, or one that it may be made from."""
    is_damaged = False
    for frame in frames:
        is_damaged = frame.is_corrupt or (is_damaged and not frame.key_frame)
        yield frame, is_damaged


def _check_colours(pixels: Any) -> None:
    """Raises VideoError for pixels as depth maps have them: of one channel, but for transparency, or of floats."""
    if pixels is None:
        return
    has_one = len(pixels.components) <= 2 and max(component.bits for component in pixels.components) > _BITS
    if has_one or "f16" in pixels.name or "f32" in pixels.name:
        remedy = "leave a depth camera out (--cameras), or convert the video: ffmpeg -i IN -pix_fmt yuv420p OUT"
        raise VideoError(f"a video of colours ({remedy})", f"{pixels.name}, as depth maps have")


def _rgb(frame: Any) -> UInt8Array:
    """uint8 [H, W, 3], equal to what ``ffmpeg -pix_fmt rgb24`` makes of the frame.

    Matrix and range are passed, since PyAV before 17 takes each video for one of BT.601 and limited range. It also does
    so where source and target are equal: they differ here, which means nothing for RGB.
    """
    options: dict[str, int] = {}
    if not frame.format.is_rgb:
        matrix = _SAME_MATRIX.get(frame.colorspace, frame.colorspace)
        matrix = matrix if matrix in _MATRICES else _BT601
        is_full = frame.color_range == _FULL or frame.format.name.startswith("yuvj")
        options["src_colorspace"] = matrix
        options["dst_colorspace"] = _BT601 if matrix == _BT709 else _BT709
        options["src_color_range"] = _FULL if is_full else _LIMITED
        options["dst_color_range"] = _FULL
    image: UInt8Array = frame.reformat(format="rgb24", interpolation="BICUBIC", **options).to_ndarray()
    return image


def _shown(image: UInt8Array, matrix: npt.NDArray[np.int32]) -> UInt8Array:
    """The image by a display matrix: x' = a x + c y, y' = b x + d y, y downwards (ISO 14496-12)."""
    a, b, _, c, d = (float(value) for value in matrix[:5])
    is_turned = max(abs(a), abs(d)) < _NEARLY * min(abs(b), abs(c))
    if not is_turned and max(abs(b), abs(c)) > _NEARLY * min(abs(a), abs(d)):
        got = f"one that is turned by {abs(math.degrees(math.atan2(b, a))):.0f} degrees, or skewed"
        raise VideoError("a video that is shown upright or by quarter turns (turn it: ffmpeg -i IN OUT)", got)
    across, down = (c, b) if is_turned else (a, d)
    image = image.swapaxes(0, 1) if is_turned else image
    return image[:: -1 if down < 0 else 1, :: -1 if across < 0 else 1]


def _broken_off(file: BinaryIO) -> str | None:
    """What is there of an MP4, Matroska or WebM file that is shorter than it says itself; None: nothing is missing.

    The container's sizes tell it, not its duration: they are exact whatever the frame rate and the sound. A file that
    does not know its size, as live recordings do not, is believed; so is any other format.
    """
    there = file.seek(0, os.SEEK_END)
    file.seek(0)
    declared = _matroska_bytes(file) if file.read(4) == _EBML.to_bytes(4, "big") else _mp4_bytes(file, there)
    return f"the first {there} bytes of at least {declared}" if declared is not None and declared > there else None


def _matroska_bytes(file: BinaryIO) -> int | None:
    """Where a Matroska file ends by its own account. The file is read from behind its first 4 bytes on."""
    header_bytes = _ebml_number(file)
    if header_bytes is None:
        return None
    file.seek(header_bytes, os.SEEK_CUR)
    if file.read(4) != _SEGMENT.to_bytes(4, "big"):
        return None
    segment_bytes = _ebml_number(file)
    return None if segment_bytes is None else file.tell() + segment_bytes


def _ebml_number(file: BinaryIO) -> int | None:
    """The size of an element; None: unknown. Leading zero bits count its further bytes; all ones stand for unknown."""
    first = file.read(1)
    if not first or not first[0]:
        return None
    num_more = 8 - first[0].bit_length()
    bits = 7 * (num_more + 1)
    number = int.from_bytes(first + file.read(num_more), "big") & ((1 << bits) - 1)
    return None if number == (1 << bits) - 1 else number


def _mp4_bytes(file: BinaryIO, there: int) -> int | None:
    """Where the box of frames that reaches furthest out of an MP4 file would end; None: none does.

    What follows an unknown box is not judged: cameras append notes of their own.
    """
    begin = 0
    while begin < there:
        file.seek(begin)
        size, kind = int.from_bytes(file.read(4), "big"), file.read(4)
        if size == _BIG:
            size = int.from_bytes(file.read(8), "big")
        if kind not in _BOXES or size < _BOX_BYTES:
            return None
        begin += size
        if kind == _FRAMES and begin > there:
            return begin
    return None
