# SPDX-License-Identifier: MIT
"""An episode's frames as an MP4 file for a browser: cut out of a stored video, or encoded. T frames."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from fractions import Fraction
from typing import Any

import av
import numpy as np

from rfm_client import UInt8Array
from rfm_client.frames import FrameFileError, Video
from rfm_labels.datasets import Span

_CODING = {"crf": "12", "g": "10", "preset": "veryfast"}  # for H.264: hardly any loss, and fast seeking
_CODECS, _PIXELS = ("h264", "hevc", "vp9", "av1"), ("yuv420p", "yuvj420p")  # that browsers show in an MP4 file


def is_playable(span: Span) -> bool:
    """True if browsers show a span's video as it is stored; False: no, or it cannot be read as MP4."""
    try:
        with _opened(span) as (video, stream):
            frame = next(video.decode(stream))
    except (FrameFileError, av.FFmpegError, OSError, StopIteration):
        return False
    is_shown = stream.codec.canonical_name in _CODECS and frame.format.name in _PIXELS
    return is_shown and frame.side_data.get("DISPLAYMATRIX") is None  # a copy would lose how it is turned


def _opened(span: Span) -> AbstractContextManager[tuple[Any, Any]]:
    return Video(span.video.file, "mov").opened()  # another format may name other files


def cut(span: Span, take: Callable[[int], object]) -> bytes:
    """Return a span of a video as an MP4 file that begins at 0 s. Packets are copied, so frames stay identical.

    The file also holds earlier frames that decoding needs, marked so that players skip them.
    """
    clip = io.BytesIO()
    try:
        with _opened(span) as (video, stream):
            packets = _packets(video, stream, span, take)
            zero = min(packet.pts for packet in packets if packet.pts * stream.time_base > _begin_s(span))
            with av.open(clip, "w", format="mp4") as copy:
                written = copy.add_stream_from_template(stream, opaque=True)  # no encoder is needed
                for packet in packets:
                    packet.pts -= zero
                    packet.dts -= zero
                    packet.stream = written
                    copy.mux(packet)
    except FrameFileError as error:
        raise span.error(error.expected, error.got) from error
    except (av.FFmpegError, OSError) as error:
        raise span.error("a video of the episode", error.strerror or str(error)) from error
    return clip.getvalue()


def _begin_s(span: Span) -> float:
    return float(span.times_s[0]) - span.tolerance_s


def _packets(video: Any, stream: Any, span: Span, take: Callable[[int], object]) -> list[Any]:
    """Return the packets needed to decode an episode, in decoding order."""
    begin_s, end_s = _begin_s(span), float(span.times_s[-1]) + span.tolerance_s
    video.seek(max(round(begin_s / stream.time_base), 0), stream=stream)
    packets: list[Any] = []
    for packet in video.demux(stream):
        if packet.pts is None or packet.dts is None:
            continue
        if packet.dts * stream.time_base > end_s:
            break
        take(packet.size)
        if packet.is_keyframe and packet.pts * stream.time_base <= begin_s + 1.5 * span.tolerance_s:
            packets = []  # decoding starts at this key frame
        packets.append(packet)
    shown_s = [float(packet.pts * stream.time_base) for packet in packets]
    while shown_s and shown_s[-1] > end_s:
        del packets[-1], shown_s[-1]
    num_shown = len(set(shown_s).intersection(span.times_s.tolist()))  # other frames between them belong to no row
    if num_shown != len(span.times_s) or not packets[0].is_keyframe:
        raise span.error(f"{len(span.times_s)} frames from {span.times_s[0]:.4f} s on", f"{num_shown}")
    if max(shown_s) > end_s:
        remedy = "encode it without frames that need later ones: ffmpeg -i IN -bf 0 OUT"
        raise span.error(
            f"an episode that can be cut out of its video ({remedy})", "one that needs frames behind its end"
        )
    return packets


def encoded(frames: Iterator[UInt8Array], fps: float, take: Callable[[int], object]) -> bytes:
    """Return pictures as an MP4 file with nearly the same colours.

    frames: uint8 [H, W, 3] each
    take: called with a byte count before the bytes are allocated
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
