# SPDX-License-Identifier: MIT
"""Recognise truncated video files by the sizes and end marks of the containers.

Sizes are exact; durations are not, because they depend on frame rate and sound. A live recording may lack sizes and end
marks, and counts as whole, like files in other formats.
"""

from __future__ import annotations

import os
from typing import BinaryIO

_EBML, _SEGMENT, _CLUSTER = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67", b"\x1f\x43\xb6\x75"  # Matroska, WebM (RFC 9559)
_ELEMENT_BYTES = 12  # longest element header: 4 bytes of ID, 8 bytes of size (RFC 8794)

_BOX_BYTES = 8  # header of an MP4 box: size and kind (ISO 14496-12)
_BIG = 1  # this size means that the next 8 bytes hold the size
_FRAMES = b"mdat"
_BOXES = (b"ftyp", b"styp", b"free", b"skip", b"wide", b"moov", b"moof", b"sidx", b"uuid", b"emsg", b"prft", _FRAMES)

_LIVE_RIFF = (0, 0xFFFFFFFF)  # declared sizes of a live AVI recording
_RIFF_SLACK_BYTES = 16  # writers count the header or padding too; the frames end before the index

_PAGE_BYTES = 27 + 255 + 255 * 255  # longest Ogg page: header, table of segments, segments (RFC 3533)
_LAST_PAGE = 4  # flag of an Ogg page

_HEAD_BYTES = 1024  # enough to recognise MPEG-TS packets, or the padding of a GIF
_SYNC = 0x47  # first byte of an MPEG-TS packet
_TS_PACKETS = ((188, 0), (192, 4))  # length, and offset of the sync byte (ISO 13818-1, Blu-ray)


def broken_off(file: BinaryIO) -> str | None:
    """Describe a truncated file, as text after "expected a whole video file, got"; None if it is whole.

    Knows MP4, Matroska, WebM, AVI, Ogg, GIF and MPEG-TS.
    """
    there = file.seek(0, os.SEEK_END)
    file.seek(0)
    head = file.read(4)
    if head == b"OggS":
        return _ogg(file, there)
    if head == b"GIF8":
        return _gif(file, there)
    declared = {_EBML: _matroska_bytes, b"RIFF": _riff_bytes}.get(head, _mp4_bytes)(file, there)
    if declared is not None and declared > there:
        return f"the first {there} bytes of at least {declared}"
    return _mpeg_ts(file, there)


def _matroska_bytes(file: BinaryIO, there: int) -> int | None:
    """Declared end of a Matroska file, or of the last element if the file has no size; None: unknown."""
    begin = 0
    while begin < there:
        file.seek(begin)
        kind, size, head_bytes = _element(file.read(_ELEMENT_BYTES))
        if not head_bytes:
            return there + 1 if there - begin < _ELEMENT_BYTES else None
        if size is None and kind not in (_SEGMENT, _CLUSTER):
            return None
        begin += head_bytes + (size or 0)
        if kind == _SEGMENT and size is not None:
            return begin
    return begin


def _element(head: bytes) -> tuple[bytes, int | None, int]:
    """ID, size (None: unknown, all bits 1) and header length (0: incomplete) of an EBML element.

    The leading zero bits of ID and size count the bytes that follow.
    """
    id_bytes = 9 - head[0].bit_length()
    size_bytes = 9 - head[id_bytes].bit_length() if id_bytes < len(head) else 9
    if id_bytes > 4 or size_bytes > 8 or id_bytes + size_bytes > len(head):
        return b"", None, 0
    bits = 7 * size_bytes
    size = int.from_bytes(head[id_bytes : id_bytes + size_bytes], "big") & ((1 << bits) - 1)
    return head[:id_bytes], None if size == (1 << bits) - 1 else size, id_bytes + size_bytes


def _riff_bytes(file: BinaryIO, there: int) -> int | None:
    """Declared end of an AVI file, which may have several parts; None: unknown."""
    begin = 0
    while begin < there:
        file.seek(begin)
        kind, size = file.read(4), int.from_bytes(file.read(4), "little")
        if kind != b"RIFF" or size in _LIVE_RIFF:
            return None
        begin += _BOX_BYTES + size + size % 2
    return begin if begin > there + _RIFF_SLACK_BYTES else None


def _mp4_bytes(file: BinaryIO, there: int) -> int | None:
    """Declared end of an MP4 box of frames beyond the end of the file; None: there is no such box.

    Stops at an unknown box, because cameras append notes of their own.
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


def _ogg(file: BinaryIO, there: int) -> str | None:
    file.seek(max(there - 2 * _PAGE_BYTES, 0))
    tail = file.read()
    page = tail[tail.rfind(b"OggS\0") :]
    num_segments = page[26] if len(page) > 26 else 255
    is_whole = len(page) >= 27 + num_segments + sum(page[27 : 27 + num_segments])
    return None if is_whole and page[5] & _LAST_PAGE else "an Ogg file without its last page"


def _gif(file: BinaryIO, there: int) -> str | None:
    file.seek(max(there - _HEAD_BYTES, 0))
    return None if file.read().rstrip(b"\0").endswith(b";") else "a GIF without its end"


def _mpeg_ts(file: BinaryIO, there: int) -> str | None:
    file.seek(0)
    head = file.read(_HEAD_BYTES)
    for num_bytes, first in _TS_PACKETS:
        syncs = head[first::num_bytes]
        if len(syncs) > 3 and set(syncs) == {_SYNC} and there % num_bytes:
            return f"an MPEG transport stream that ends inside a packet ({there} bytes, {num_bytes} each)"
    return None
