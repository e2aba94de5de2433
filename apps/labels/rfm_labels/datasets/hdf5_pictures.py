# SPDX-License-Identifier: MIT
"""Frames in HDF5 arrays: pixels, or one JPEG or PNG file per frame. Needs h5py; files need Pillow.

A frame's file is a zero-padded byte row, a fixed-length text, or an array with its own length.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from rfm_client import UInt8Array
from rfm_client.frames import Picture
from rfm_labels.datasets.dataset import LEAST_SIZE_PX
from rfm_labels.datasets.faults import require
from rfm_labels.datasets.hdf5_layouts import members_of
from rfm_labels.datasets.stored_files import faults_at

_STARTS = (b"\xff\xd8\xff", b"\x89PNG")  # first bytes in JPEG and PNG files
_RAW_SIZES_PX = ((480, 640), (720, 1280))  # RoboMIND's cameras, which store some frames as pixels between JPEG files
_RGB_MARK = b"\xff\xfe\x00\x0aXPL-RGB1"  # comment in RoboTwin's JPEG files whose red is red


class EncodedFrames:
    """One camera's frames as T files. Pixels between the files are read as OpenCV stores them: blue first.

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
        marked = []
        for t, file in enumerate(self.files()):
            if self._raw_size(file) is None:
                self._require_end(t, file)
                with faults_at(self._at(t)):
                    Picture(file).check()
                marked.append(has_rgb_mark(file))
        got = "both: write the episode again"
        require(self._where, len(set(marked)) < 2, "JPEG files all with RoboTwin's mark of RGB, or all without", got)

    def pixels(self) -> Iterator[UInt8Array]:
        """Yield the T frames, uint8 [H, W, 3]. Raises DatasetError with the frame number."""
        shape: tuple[int, ...] = ()
        for t, file in enumerate(self.files()):
            size = self._raw_size(file)
            if size is None:
                self._require_end(t, file)
            with faults_at(self._at(t)):
                frame = (
                    Picture(file).pixels()
                    if size is None
                    else np.frombuffer(file, np.uint8).reshape(*size, 3)[..., ::-1]
                )
            shape = shape or frame.shape
            require(self._at(t), frame.shape == shape, f"a frame of {_size(shape)}, as the first", _size(frame.shape))
            yield frame

    def _require_end(self, t: int, file: bytes) -> None:
        """Raise DatasetError for a truncated JPEG file. Pillow would decode the zeros behind it as pixels."""
        is_whole = not file.startswith(_STARTS[0]) or file.rfind(b"\xff\xd9") > file.rfind(b"\xff\xda")
        require(
            self._at(t), is_whole, "a whole JPEG file", "one without an end: leave the episode out, or write it again"
        )

    def _raw_size(self, file: bytes) -> tuple[int, int] | None:
        """Height and width if a frame is stored as pixels; None: it is a file."""
        if file.startswith(_STARTS):
            return None
        return next((size for size in self._sizes if len(file) == size[0] * size[1] * 3), None)

    @cached_property
    def _sizes(self) -> tuple[tuple[int, int], ...]:
        """The first readable picture's size; RoboMIND's sizes if all frames are pixels."""
        for t, file in enumerate(self.files()):
            if file.startswith(_STARTS):
                with faults_at(self._at(t)):
                    height, width, _ = Picture(file).pixels().shape
                return ((height, width),)
        return _RAW_SIZES_PX

    def _at(self, t: int) -> str:
        return f"{self._where}: frame {t}"


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[0]} x {shape[1]} pixels"


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
    if shape[3] == 3:
        what = (
            "no pixels" if 0 in shape[1:] else "" if value.dtype == np.uint8 else "not uint8: store colours as 0..255"
        )
    elif shape[3] == 4:
        what = "RGBA: store its first three channels, if they are uint8 RGB"
    elif shape[1] in (3, 4):
        what = "channels first: store it as uint8 [T, H, W, 3]"
    else:
        what = "a depth map, a mask or another form: no colours as uint8 [T, H, W, 3]"
    return what and f"{form_of(value)}, {what}"


def _is_picture(value: Any, are_pictures: bool) -> bool:
    """True if an observation may be pictures, even in an unsupported form."""
    if value is None:  # it may have been one
        return True
    if not hasattr(value, "shape"):
        held = value.visititems(lambda _, each: (hasattr(each, "shape") and _is_picture(each, False)) or None)
        return bool(held)
    if len(value.shape) == 3:
        return all(size >= LEAST_SIZE_PX for size in value.shape[1:])
    return len(value.shape) > 3 or is_encoded(value, are_pictures)


def is_encoded(value: Any, are_pictures: bool) -> bool:
    """True for an array of files. are_pictures: False: the first frame must begin like a JPEG or PNG file."""
    kinds = {1: "OSV", 2: "u"}
    if not value.shape or not value.shape[0] or value.dtype.kind not in kinds.get(len(value.shape), ""):
        return False
    return are_pictures or _first_file(value).startswith(_STARTS)


def _first_file(value: Any) -> bytes:
    """The first frame's file; empty if it cannot be read, which is an error when all are read."""
    try:
        return np.asarray(value[0]).tobytes()
    except (OSError, RuntimeError):
        return b""


def pictures_in(demos: Mapping[int, tuple[str, Any]], are_pictures: bool) -> Mapping[str, Mapping[int, str]]:
    """Return faults by picture and demonstration; "" means no fault."""
    observations = {number: (name, _observations(demo)) for number, (name, demo) in demos.items()}
    values = [(name, value) for _, stored in observations.values() for name, value in stored.items()]
    found = {name: None for name, value in values if _is_picture(value, are_pictures)}
    return {
        picture: {
            number: fault_of(stored[picture], are_pictures)
            if stored.get(picture) is not None
            else _missing(picture, demos[number])
            for number, (name, stored) in observations.items()
        }
        for picture in found
    }


def forms_in(demos: Mapping[int, tuple[str, Any]]) -> Mapping[int, str]:
    """Describe the observations by demonstration, for messages."""
    found = {number: _observations(demo) for number, (_, demo) in demos.items()}
    return {
        n: ", ".join(f"{name} {form_of(value)}" for name, value in each.items()) or "none" for n, each in found.items()
    }


def first_files(
    demos: Mapping[int, tuple[str, Any]], pictures: Mapping[str, Mapping[int, str]], are_pictures: bool
) -> Mapping[str, bytes]:
    """Return the first file for each camera whose frames are files."""
    stored = (
        (camera, demo["obs"][camera])
        for n, (_, demo) in demos.items()
        for camera in pictures
        if not pictures[camera][n]
    )
    return {camera: _first_file(each) for camera, each in stored if is_encoded(each, are_pictures)}


def _missing(picture: str, demo: tuple[str, Any]) -> str:
    """Why a demonstration lacks a picture."""
    name, stored = demo
    if stored is None:
        return f"{name} is a broken link"
    return f"{name} has a broken link or no array" if picture in _observations(stored) else f"missing in {name}"


def _observations(demo: Any) -> Mapping[str, Any]:
    observations: Any = demo.get("obs") if hasattr(demo, "keys") else None
    return {name: value if _is_known(value) else None for name, value in members_of(observations).items()}


def _is_known(value: Any) -> bool:
    """True for a group, or an array with numbers or texts that NumPy knows."""
    try:
        return hasattr(value, "keys") or (getattr(value, "shape", None) is not None and bool(value.dtype.kind))
    except (TypeError, OSError, RuntimeError):
        return False
