# SPDX-License-Identifier: MIT
"""Frames in HDF5 arrays: pixels, or one JPEG or PNG file per frame. Needs h5py; files need Pillow.

A frame's file is a zero-padded byte row, a fixed-length text, or an array with its own length.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from rfm_client import UInt8Array
from rfm_client.frames import Picture
from rfm_labels.datasets.dataset import LEAST_SIZE_PX
from rfm_labels.datasets.faults import require
from rfm_labels.datasets.stored_files import faults_at

_STARTS = (b"\xff\xd8\xff", b"\x89PNG")  # first bytes in JPEG and PNG files
_RAW_SHAPES = ((480, 640, 3), (720, 1280, 3))  # of RoboMIND's cameras, which store some frames as pixels
_RGB_MARK = b"\xff\xfe\x00\x0aXPL-RGB1"  # comment in RoboTwin's JPEG files whose red is red


class EncodedFrames:
    """One camera's frames as T files. RoboMIND stores some frames as pixels, blue first.

    stored: HDF5 dataset with T files
    where: file and path, for messages
    """

    def __init__(self, stored: Any, where: str) -> None:
        self._stored = stored
        self._where = where

    def files(self) -> Iterator[bytes]:
        """Yield the T files. Padding after fixed-length text is dropped."""
        for t in range(len(self._stored)):
            yield np.asarray(self._stored[t]).tobytes()

    def check(self) -> None:
        """Raise DatasetError if a frame's header is not a picture's."""
        marked = set()
        for where, file in self._whole_files():
            if self._raw_shape(file) is None:
                with faults_at(where):
                    Picture(file).check()
                marked.add(has_rgb_mark(file))
        got = "both: write the episode again"
        require(self._where, len(marked) < 2, "JPEG files all with RoboTwin's mark of RGB, or all without", got)

    def pixels(self) -> Iterator[UInt8Array]:
        """Yield the T frames, uint8 [H, W, 3]. Raises DatasetError with the frame number."""
        for where, file in self._whole_files():
            if shape := self._raw_shape(file):
                yield np.frombuffer(file, np.uint8).reshape(shape)[..., ::-1]
                continue
            with faults_at(where):
                yield Picture(file).pixels()

    def _whole_files(self) -> Iterator[tuple[str, bytes]]:
        """Yield each file after its place, for messages.

        Raises DatasetError for a truncated JPEG, whose zeros Pillow would decode.
        """
        for t, file in enumerate(self.files()):
            where = f"{self._where}: frame {t}"
            is_whole = not file.startswith(_STARTS[0]) or file.rfind(b"\xff\xd9") > file.rfind(b"\xff\xda")
            got = "one without an end: leave the episode out, or write it again"
            require(where, is_whole, "a whole JPEG file", got)
            yield where, file

    def _raw_shape(self, file: bytes) -> tuple[int, ...] | None:
        """[H, W, 3] if a frame is stored as pixels; None: it is a file."""
        shapes = () if file.startswith(_STARTS) else self._raw_shapes
        return next((shape for shape in shapes if len(file) == np.prod(shape)), None)

    @cached_property
    def _raw_shapes(self) -> Sequence[tuple[int, ...]]:
        """The first picture's [H, W, 3]; RoboMIND's if all frames are pixels."""
        for where, file in self._whole_files():
            if file.startswith(_STARTS):
                with faults_at(where):
                    return [Picture(file).pixels().shape]
        return _RAW_SHAPES


def has_rgb_mark(file: bytes) -> bool:
    """True if a RoboTwin JPEG file is marked as RGB; files from before September 2026 are BGR."""
    return _RGB_MARK in file[: 2**12]


def form_of(value: Any) -> str:
    """Describe type and shape, for messages."""
    if value is None:
        return "(unreadable)"
    return f"{value.dtype} {list(value.shape)}" if hasattr(value, "shape") else "(a group)"


def fault_of(value: Any, are_pictures: bool) -> str:
    """Return why an observation is not a camera's frames; empty if it is.

    are_pictures: as in ``Layout``
    """
    if not hasattr(value, "shape"):
        return "a group: expected its pictures one level up"
    if value.is_virtual:  # h5py would show zeros for frames missing in another file
        return "a virtual dataset: copy its frames into the file"
    if is_encoded(value, are_pictures):
        return ""
    shape = value.shape if len(value.shape) == 4 else (0, 0, 0, 0)
    if shape[3] == 3 and value.dtype == np.uint8:
        what = "no pixels" if 0 in shape[1:] else ""
    elif shape[3] == 3:
        what = "not uint8: store colours as 0..255"
    elif shape[3] == 4:
        what = "RGBA: store its first three channels, if they are uint8 RGB"
    elif shape[1] in (3, 4):
        what = "channels first: store it as uint8 [T, H, W, 3]"
    else:
        what = "a depth map, a mask or another form: no colours as uint8 [T, H, W, 3]"
    return what and f"{form_of(value)}, {what}"


def may_be_picture(value: Any, are_pictures: bool) -> bool:
    """True if an observation may be pictures, even in an unsupported form."""
    if value is None:  # it may have been one
        return True
    if not hasattr(value, "shape"):
        return bool(value.visititems(lambda _, each: (hasattr(each, "shape") and may_be_picture(each, False)) or None))
    if len(value.shape) == 3:
        return all(size >= LEAST_SIZE_PX for size in value.shape[1:])
    return len(value.shape) > 3 or is_encoded(value, are_pictures)


def is_encoded(value: Any, are_pictures: bool) -> bool:
    """True for an array of files. are_pictures: False: the first frame must begin like a JPEG or PNG file."""
    kinds = {1: "OSV", 2: "u"}
    if not value.shape or not value.shape[0] or value.dtype.kind not in kinds.get(len(value.shape), ""):
        return False
    return are_pictures or first_file(value).startswith(_STARTS)


def first_file(value: Any) -> bytes:
    """Return the first frame's file; empty if it cannot be read, which is an error when all are read."""
    try:
        return np.asarray(value[0]).tobytes()
    except (OSError, RuntimeError):
        return b""
