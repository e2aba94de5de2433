# SPDX-License-Identifier: MIT
"""Stored frames: how to identify their files, and how to report faults with the place. H x W pixels."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client import UInt8Array
from rfm_client.frames import FrameFileError, Picture, Video
from rfm_labels.datasets.faults import DatasetError

Times = npt.NDArray[np.float64]


def digest_of(parts: Iterable[bytes]) -> str:
    """Hash the parts, including where one ends and the next begins."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


def file_identity(file: Path, revision: str | None = None, what: str = "video") -> str:
    """Return a text that identifies a file: size and modification time.

    revision: commit on the Hub; replaces the time, which differs between machines
    what: kind of file, for messages

    Raises DatasetError.
    """
    try:
        status = file.stat()
    except FileNotFoundError as error:
        raise DatasetError.at(file, f"a {what} file", "none") from error
    except OSError as error:
        raise DatasetError.at(file, f"a readable {what} file", error.strerror) from error
    return f"{status.st_size} {revision or status.st_mtime_ns}"


def colours_fault(pixels: Any) -> str:
    """Return why an array is no frames, uint8 [T, H, W, 3]; empty if it is."""
    shape = pixels.shape if len(pixels.shape) == 4 else (0, 0, 0, 0)
    what = "a depth map, a mask or another form: no colours as uint8 [T, H, W, 3]"
    if shape[3] == 3:
        is_empty = "no pixels" if 0 in shape[1:] else ""
        what = is_empty if pixels.dtype == np.uint8 else "not uint8: store colours as 0..255"
    elif shape[3] == 4:
        what = "RGBA: store its first three channels, if they are uint8 RGB"
    elif shape[1] in (3, 4):
        what = "channels first: store it as uint8 [T, H, W, 3]"
    return what and f"{pixels.dtype} {list(pixels.shape)}, {what}"


def turn_mark(picture: bytes | Path) -> str:
    """Return a mark for ``Dataset.identity`` if EXIF data turn a picture, which earlier labels ignored; else ""."""
    turn = Picture(picture).exif_turn
    return "" if turn is None else f" EXIF {turn}"


@contextmanager
def faults_at(where: object) -> Iterator[None]:
    """Turn a FrameFileError in the block into a DatasetError at this place."""
    try:
        yield
    except FrameFileError as error:
        place = f"{where}: {error.where}" if error.where else str(where)
        raise DatasetError.like(error, where=place) from error


def check_pictures(pictures: Iterable[bytes | Path], where: str = "") -> None:
    """Raise DatasetError unless the headers of these files are those of pictures. where: of contents, for messages"""
    for place, picture in _placed(pictures, where):
        with faults_at(place):
            picture.check()


def picture_frames(pictures: Iterable[bytes | Path], where: str = "") -> Iterator[UInt8Array]:
    """Yield the pixels of these files, uint8 [H, W, 3] each. Raises DatasetError. where: as in ``check_pictures``"""
    for place, picture in _placed(pictures, where):
        with faults_at(place):
            yield picture.pixels()


def _placed(pictures: Iterable[bytes | Path], where: str) -> Iterator[tuple[object, Picture]]:
    for t, picture in enumerate(pictures):
        yield picture if isinstance(picture, Path) else f"{where}: frame {t}", Picture(picture)


@dataclass(frozen=True, eq=False)
class Span:
    """One episode's T frames in a video.

    times_s: float64 [T], rising time stamps in the video
    tolerance_s: half the time between frames
    where: episode and camera, for messages
    """

    video: Video
    times_s: Times
    tolerance_s: float
    where: str

    def frames(self) -> Iterator[UInt8Array]:
        """Yield the T frames, uint8 [H, W, 3], upright. Raises DatasetError for a missing or damaged frame."""
        with faults_at(f"{self.where}: {self.video.file}"):
            yield from self.video.frames_at(self.times_s, self.tolerance_s)

    def error(self, expected: str, got: object) -> DatasetError:
        """Return an error that names this span's video."""
        return DatasetError.at(f"{self.where}: {self.video.file}", expected, got)
