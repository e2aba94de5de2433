# SPDX-License-Identifier: MIT
"""What all readers of films keep to: a file that breaks off is refused, frames are upright, damaged ones are known.

The frames and packets are PyAV's.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from typing import Any, BinaryIO

import numpy as np

from rfm_client.contract.samples import UInt8Array

UNDAMAGED = "an undamaged frame"
DAMAGED = "one that the decoder marks, or is made from such a one"

_EBML, _SEGMENT = 0x1A45DFA3, 0x18538067  # how Matroska and WebM begin (RFC 8794, RFC 9559)
_BOX_BYTES = 8  # size and kind of an MP4 box (ISO 14496-12)
_BIG = 1  # a size that says that 8 more bytes tell it
_FRAMES = b"mdat"
_BOXES = (b"ftyp", b"styp", b"free", b"skip", b"wide", b"moov", b"moof", b"sidx", b"uuid", b"emsg", b"prft", _FRAMES)


def broken_off(file: BinaryIO) -> str | None:
    """What is there of an MP4, Matroska or WebM file that is shorter than it says itself; None: nothing is missing.

    The container's sizes tell it, not its duration: they are exact whatever the frame rate and the sound. A file that
    does not know its size, as live recordings do not, is believed; so is any other format.
    """
    there = file.seek(0, os.SEEK_END)
    file.seek(0)
    declared = _matroska_bytes(file) if file.read(4) == _EBML.to_bytes(4, "big") else _mp4_bytes(file, there)
    return f"the first {there} bytes of at least {declared}" if declared is not None and declared > there else None


def upright(frame: Any) -> UInt8Array:
    """uint8 [H, W, 3], a decoded frame in RGB as it is to be shown: turned as phones film, not mirrored."""
    image = frame.to_ndarray(format="rgb24")
    return np.ascontiguousarray(np.rot90(image, round(frame.rotation / 90)))  # both count counter-clockwise


def judged(frames: Iterable[Any]) -> Iterator[tuple[Any, bool]]:
    """Each decoded frame, and whether it is damaged: the decoder marks it, or one that it may be made from."""
    is_damaged = False
    for frame in frames:
        is_damaged = frame.is_corrupt or (is_damaged and not frame.key_frame)
        yield frame, is_damaged


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
