# SPDX-License-Identifier: MIT
"""Decoding shared by all video readers: stream, colours, orientation, damaged frames, broken files.

Containers, streams, packets and frames are PyAV's.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from rfm_client.contract.checks import git_lfs_pointer
from rfm_client.contract.samples import UInt8Array
from rfm_client.frames.pictures import FrameFileError

UNDAMAGED = "an undamaged frame"
DAMAGED = "one that the decoder marks, or is made from such a one"
DOWNLOAD = "download it again"
_HEADLESS = ("an HEVC video that begins with a key frame (cut it there: ffmpeg -ss SECONDS -i IN OUT)", "another frame")

_NO_MATRIX, _BT601, _BT2020 = 0, 5, 9  # from YUV to RGB, as numbered by ITU-T H.273
_MATRICES = (1, 4, _BT601, 7, _BT2020)  # known to libswscale, which replaces others by BT.601
_SAME_MATRIX = {6: _BT601, 10: _BT2020}  # other numbers for the same matrix
_BITS = 8  # most bits in a grey video's only channel; depth maps have more
_TS_SYNC, _TS_PACKETS = 0x47, ((188, 0), (192, 4))  # first byte, its offset by packet length (ISO 13818-1, Blu-ray)
_PICTURES = (b"\xff\xd8\xff", b"\x89PNG", b"II*\0", b"MM\0*")  # first bytes: JPEG, PNG, TIFF
_RAW_PICTURES = "mjpeg"  # FFmpeg's name for JPEG files in one, also for a tar of them
_NO_VIDEO = (
    "a video file (make one of pictures: ffmpeg -i IN OUT.mp4)",
    "a picture file, or several in one (raw Motion JPEG, animated PNG, a tar)",
)
_WEBP = slice(8, 12)  # where a WebP file says so
_HEAD_BYTES = 1024  # enough to recognise MPEG-TS packets, or a GIF's padding
_NEARLY = math.tan(math.radians(1))  # FFmpeg's tolerance for quarter turns in a display matrix


def import_av() -> Any:
    """Return the module ``av``. Raises ImportError, naming the extra to install."""
    try:
        import av
    except ImportError as error:
        raise ImportError('video files need PyAV: pip install "./client[video]"') from error
    return av


def video_stream(container: Any) -> Any:
    """Return an opened container's only video stream. Attached pictures, such as cover art, do not count.

    Raises FrameFileError for no stream, several streams, or depth maps.
    """
    attached = import_av().stream.Disposition.attached_pic
    videos = {n: stream for n, stream in enumerate(container.streams.video) if not stream.disposition & attached}
    if not videos:
        raise FrameFileError.of("a file with a video stream", "none")
    if len(videos) > 1:
        codecs = {n: stream.codec_context for n, stream in videos.items()}
        streams = ", ".join(f"0:v:{n} ({codec.name}, {codec.width}x{codec.height})" for n, codec in codecs.items())
        expected = "one video stream (take one: ffmpeg -i IN -map 0:v:N -c copy OUT)"
        raise FrameFileError.of(expected, f"{len(videos)}: {streams}")
    (stream,) = videos.values()
    _check_colours(stream.codec_context.format)
    return stream


@dataclass(frozen=True, eq=False)
class Packets:
    """A video's frame packets, read without decoding.

    count: packets whose frames are shown; equals the frame count unless a packet holds several frames
    times_s: float64 [N], sorted time stamps; packets without a time stamp are left out
    num_hidden: packets that are not shown, as in videos cut without encoding
    tick_s: time stamp unit, in seconds
    fps: average frames per second, the file's or from its time stamps; 0: unknown
    """

    count: int
    times_s: npt.NDArray[np.float64]
    num_hidden: int
    tick_s: float
    fps: float

    @property
    def since_first_s(self) -> npt.NDArray[np.float64]:
        """Return float64 [N], time stamps relative to the first frame."""
        return self.times_s - self.times_s[:1]


def read_packets(file: BinaryIO, container: str | None = None) -> Packets:
    """Return a video's packets. They are counted, because the container's own count may be wrong.

    container: FFmpeg's name for the file format; None: FFmpeg guesses it

    Raises FrameFileError, also for broken packets, and PyAV's errors. A Matroska or Ogg file that ends too early
    is read as far as possible.
    """
    _check_kind(file)
    times_s: list[float] = []
    count = num_hidden = 0
    with import_av().open(file, format=container) as opened:
        if opened.format.name == _RAW_PICTURES:
            raise FrameFileError.of(*_NO_VIDEO)
        stream = video_stream(opened)
        unit = stream.time_base
        for packet in opened.demux(stream):
            if (
                packet.size
                and not count + num_hidden
                and not packet.is_keyframe
                and stream.codec_context.name == "hevc"
            ):
                raise FrameFileError.of(*_HEADLESS)  # FFmpeg 7 makes pictures up to the first key frame, unmarked
            if not packet.size or packet.is_discard:
                num_hidden += bool(packet.size)
                continue
            if packet.is_corrupt:
                raise FrameFileError.of("a whole video file", f"one whose packet {count} is broken ({DOWNLOAD})")
            if packet.pts is not None:
                times_s.append(packet.pts * unit.numerator / unit.denominator)  # rounded as the fraction is
            count += 1
        tick_s, fps = float(stream.time_base), float(stream.average_rate or 0)
    times = np.sort(np.array(times_s, np.float64))
    if not fps and len(times) > 1 and times[-1] > times[0]:  # Ogg states no average
        fps = (len(times) - 1) / float(times[-1] - times[0])
    return Packets(count, times, num_hidden, tick_s, fps)


def _check_kind(file: BinaryIO) -> None:
    """Raise FrameFileError for Git LFS's pointer to a video, for pictures, and for a truncated GIF or MPEG-TS file.

    Releases of PyAV turn pictures in different ways. Decoders for GIF and MPEG-TS may return part of a picture.
    """
    num_bytes = file.seek(0, os.SEEK_END)
    file.seek(max(num_bytes - _HEAD_BYTES, 0))
    tail = file.read()
    file.seek(0)
    head = file.read(_HEAD_BYTES)
    file.seek(0)
    if pointer := git_lfs_pointer(head):
        raise FrameFileError.of("a video file", pointer)
    if head.startswith(_PICTURES) or head[_WEBP] == b"WEBP":
        raise FrameFileError.of(*_NO_VIDEO)
    is_cut = head.startswith(b"GIF8") and not tail.rstrip(b"\0").endswith(b";")
    for length, offset in _TS_PACKETS:
        syncs = head[offset::length]
        is_cut |= len(syncs) > 3 and set(syncs) == {_TS_SYNC} and num_bytes % length != 0
    if is_cut:
        raise FrameFileError.of("a whole video file", f"one that ends inside a picture, after {num_bytes} bytes")


class Upright:
    """Convert decoded frames to RGB, turned and mirrored as FFmpeg shows them.

    FFmpeg's converter is kept from frame to frame, so create one object per video.
    """

    def __init__(self) -> None:
        self._kind = ""
        self._graph: Any = None

    def __call__(self, frame: Any) -> UInt8Array:
        """Return uint8 [H, W, 3]. Raises FrameFileError for a frame that FFmpeg would show aslant."""
        try:
            image, matrix = self._rgb(frame), frame.side_data.get("DISPLAYMATRIX")
        except ValueError as error:  # PyAV 17.1 to 18.1 fail on a Motion JPEG video's EXIF data
            remedy = "encode it anew: ffmpeg -i IN -c:v libx264 -crf 12 OUT.mp4"
            expected = f"frames without EXIF data, which PyAV cannot read ({remedy})"
            raise FrameFileError.of(expected, error) from error
        return image if matrix is None else np.ascontiguousarray(_shown(image, np.frombuffer(bytes(matrix), np.int32)))

    def _rgb(self, frame: Any) -> UInt8Array:
        """Return uint8 [H, W, 3], equal to the output of ``ffmpeg -pix_fmt rgb24``.

        The filter does what the program does. PyAV's ``reformat`` differs from release to release.
        """
        frame.colorspace = _known_matrix(frame)
        kind = f"{frame.width}x{frame.height}:pix_fmt={frame.format.name}:time_base=1/1"
        kind += f":colorspace={int(frame.colorspace)}:range={int(frame.color_range)}"
        if kind != self._kind:
            self._kind, self._graph = kind, _rgb_graph(kind)
        self._graph.push(frame)
        image: UInt8Array = self._graph.pull().to_ndarray()
        return image


def judged(frames: Iterable[Any]) -> Iterator[tuple[Any, bool]]:
    """Yield decoded frames with True if the decoder marked the frame, or one before it since the last key frame."""
    is_damaged = False
    for frame in frames:
        is_damaged = frame.is_corrupt or (is_damaged and not frame.key_frame)
        yield frame, is_damaged


def _check_colours(pixels: Any) -> None:
    """Refuse depth map pixels: floats, or a single deep channel besides transparency."""
    if pixels is None:
        return
    has_one = len(pixels.components) <= 2 and max(component.bits for component in pixels.components) > _BITS
    if has_one or "f16" in pixels.name or "f32" in pixels.name:
        remedy = "leave a depth camera out (--cameras), or convert the video: ffmpeg -i IN -pix_fmt yuv420p OUT"
        raise FrameFileError.of(f"a video of colours ({remedy})", f"{pixels.name}, as depth maps have")


def _known_matrix(frame: Any) -> int:
    """Return the frame's matrix, or FFmpeg's replacement if it does not know the matrix."""
    if frame.format.is_rgb:
        return _NO_MATRIX
    matrix = _SAME_MATRIX.get(frame.colorspace, frame.colorspace)
    return int(matrix if matrix in _MATRICES else _BT601)


def _rgb_graph(kind: str) -> Any:
    graph = import_av().filter.Graph()
    filters = (("buffer", f"video_size={kind}"), ("scale", "flags=bicubic"), ("format", "rgb24"), ("buffersink", None))
    graph.link_nodes(*(graph.add(name, options) for name, options in filters)).configure()
    return graph


def _shown(image: UInt8Array, matrix: npt.NDArray[np.int32]) -> UInt8Array:
    """Turn the image by a display matrix: x' = a x + c y, y' = b x + d y, y downwards (ISO 14496-12)."""
    a, b, _, c, d = (float(value) for value in matrix[:5])
    is_turned = max(abs(a), abs(d)) < _NEARLY * min(abs(b), abs(c))
    if not is_turned and max(abs(b), abs(c)) > _NEARLY * min(abs(a), abs(d)):
        got = f"one that is turned by {abs(math.degrees(math.atan2(b, a))):.0f} degrees, or skewed"
        raise FrameFileError.of("a video that is shown upright or by quarter turns (turn it: ffmpeg -i IN OUT)", got)
    across, down = (c, b) if is_turned else (a, d)
    image = image.swapaxes(0, 1) if is_turned else image
    return image[:: -1 if down < 0 else 1, :: -1 if across < 0 else 1]
