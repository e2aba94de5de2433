# SPDX-License-Identifier: MIT
"""One episode cut out of the film of a dataset, as a small MP4 file. Nothing is encoded anew: the frames are equal.

A cut must begin with a frame that needs no other. Frames before the episode are there if others need them, and an edit
list tells players and decoders to leave them out.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av

from rfm_client.data.datasets.films import Span
from rfm_client.data.film_files import FilmError, film_stream

MEDIA_TYPE = "video/mp4"

_CONTAINER = "mov"  # FFmpeg's name of MP4; a play list would be read as what it names
_BOX = struct.Struct(">I4s")


def cut(span: Span, target: Path, take: Callable[[int], object]) -> None:
    """Writes the frames of the span to ``target``. Its first frame is at 0 s.

    take: told how many bytes of memory are taken, before they are
    Raises DatasetError, and what ``take`` raises.
    """
    try:
        with av.open(str(span.file), format=_CONTAINER) as film:
            stream = film_stream(film)
            _write(target, stream, _packets(film, stream, span, take))
    except FilmError as error:
        raise span.error(error.expected, error.got) from error
    except (av.FFmpegError, OSError) as error:
        raise span.error("a film of the episode", error.strerror or str(error)) from error
    modified = span.file.stat()
    os.utime(target, ns=(modified.st_atime_ns, modified.st_mtime_ns))  # by which browsers know it again


@dataclass(frozen=True)
class _Packets:
    """The packets of an episode, in the order of decoding.

    zero, end: when its first frame is shown, and when its last one is over, in ticks of the film
    """

    packets: list[Any]
    zero: int
    end: int


def _packets(film: Any, stream: Any, span: Span, take: Callable[[int], object]) -> _Packets:
    tick_s = float(stream.time_base)

    def ticks(time_s: float) -> int:
        return round(time_s / tick_s)

    first, end = ticks(span.times_s[0] - span.tolerance_s), ticks(span.times_s[-1] + span.tolerance_s)
    entry = ticks(span.times_s[0] + span.tolerance_s / 2)  # where the decoder may begin at the latest
    film.seek(max(first, 0), stream=stream)
    needed: list[Any] = []
    later: list[Any] = []  # shown after the end: needed only if one of the episode's follows
    for packet in film.demux(stream):
        if packet.pts is None or packet.dts is None:
            continue
        if packet.dts > end:
            break
        take(packet.size)
        if packet.is_keyframe and packet.pts <= entry:
            needed, later = [], []  # the episode does not need what is before
        later.append(packet)
        if packet.pts <= end:
            needed += later
            later = []
    shown = [packet.pts for packet in needed if first <= packet.pts <= end]
    if len(shown) != len(span.times_s) or not needed[0].is_keyframe:
        raise span.error(f"{len(span.times_s)} frames from {span.times_s[0]:.4f} s on", f"{len(shown)}")
    return _Packets(needed, min(shown), end)


def _write(target: Path, stream: Any, episode: _Packets) -> None:
    options = {"movflags": "+faststart", "fflags": "+bitexact"}  # the same cut is the same file
    with av.open(str(target), "w", format="mp4", options=options) as copy:
        written = copy.add_stream_from_template(stream, opaque=True)  # no encoder is needed
        for packet in episode.packets:
            packet.pts -= episode.zero
            packet.dts -= episode.zero
            packet.stream = written
            copy.mux(packet)
    if any(packet.pts + episode.zero > episode.end for packet in episode.packets):
        _end(target, float((episode.end - episode.zero) * stream.time_base))


def _end(target: Path, duration_s: float) -> None:
    """Ends the edit of a file that FFmpeg has written, so that later frames that others need are not shown."""
    with target.open("r+b") as file:
        scale = _found(file, (b"moov", b"mvhd"))
        file.seek(scale + 12)  # version and flags, times of creation and change
        ticks_per_s = int.from_bytes(file.read(4), "big")
        file.seek(_found(file, (b"moov", b"trak", b"edts", b"elst")) + 8)  # version and flags, number of edits
        file.write(round(duration_s * ticks_per_s).to_bytes(4, "big"))


def _found(file: Any, path: tuple[bytes, ...]) -> int:
    """Where the content of a box begins."""
    position = 0
    for name in path:
        while True:
            file.seek(position)
            size, kind = _BOX.unpack(file.read(_BOX.size))
            if kind == name:
                position += _BOX.size
                break
            position += size
    return position
