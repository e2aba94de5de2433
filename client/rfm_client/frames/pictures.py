# SPDX-License-Identifier: MIT
"""Decode 8-bit pictures, upright by EXIF orientation, like ``datasets`` and LeRobot. Needs Pillow.

H x W pixels.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client.contract.checks import git_lfs_pointer
from rfm_client.contract.errors import InvalidValueError
from rfm_client.contract.samples import UInt8Array

_UPRIGHT = {  # Pillow's name by EXIF orientation
    2: "FLIP_LEFT_RIGHT",
    3: "ROTATE_180",
    4: "FLIP_TOP_BOTTOM",
    5: "TRANSPOSE",
    6: "ROTATE_270",
    7: "TRANSVERSE",
    8: "ROTATE_90",
}
_HEAD_BYTES = 2**13  # EXIF and XMP data begin within these bytes
_MARKS = (b"Exif", b"eXIf", b"type exif", b"adobe", b"WEBP")  # JPEG, PNG, older PNG, XMP; WebP has EXIF at its end
_COLOURS = ("1", "L", "LA", "P", "RGB", "RGBA")  # Pillow's modes with at most 8 bits per channel
_BROKEN = (OSError, SyntaxError, ValueError)  # Pillow's errors for broken pixels, headers and EXIF data
_DEEP = ";16"  # Pillow's mark for 16 bits per channel, which it cuts to 8


class FrameFileError(InvalidValueError):
    """A file that is not one readable video or picture. where: place in it, such as ``frame 3``; empty: the file."""

    @classmethod
    def of(cls, expected: str, got: object) -> FrameFileError:
        """Return the error for the whole file."""
        return cls.at("", expected, got)


class Picture:
    """A picture of 8-bit colours. Needs Pillow.

    stored: file content, file path, or a picture that Pillow has opened
    """

    def __init__(self, stored: Any) -> None:
        self._stored = stored

    @staticmethod
    def decoder() -> str:
        """Return Pillow's name and version. Raises ImportError, naming the extra to install."""
        try:
            import PIL
        except ImportError as error:
            raise ImportError("pictures need Pillow: pip install ./client ./apps/labels") from error
        return f"Pillow {PIL.__version__}"

    def check(self) -> None:
        """Raise FrameFileError unless the colours have 8 bits. Only the header is read."""
        self._opened().close()

    def pixels(self) -> UInt8Array:
        """Return uint8 [H, W, 3], upright by EXIF. Raises FrameFileError."""
        with self._opened() if isinstance(self._stored, bytes | Path) else self._stored as picture:
            try:
                return np.asarray(upright_picture(picture).convert("RGB"))
            except _BROKEN as error:
                raise FrameFileError.of("an image", error) from error

    def _opened(self) -> Any:
        """Open a picture of 8-bit colours, and read only the header. Raises FrameFileError."""
        self.decoder()
        from PIL import Image, UnidentifiedImageError

        try:
            opened = Image.open(_file_of(self._stored))
        except UnidentifiedImageError as error:
            raise FrameFileError.of("an image", git_lfs_pointer(self._stored) or error) from error
        except (*_BROKEN, Image.DecompressionBombError) as error:
            raise FrameFileError.of("an image", error) from error
        is_deep = _DEEP in str(opened.tile)
        if is_deep or opened.mode not in _COLOURS:
            opened.close()
            expected = "a picture of 8-bit colours (convert it, or leave a depth camera out: --cameras)"
            raise FrameFileError.of(expected, f"{opened.format} of {'16-bit ' * is_deep}{opened.mode}")
        return opened

    @property
    def exif_turn(self) -> int | None:
        """The EXIF orientation, read without decoding; None: it changes nothing, or cannot be read."""
        self.decoder()
        from PIL import Image

        head = self._stored[:_HEAD_BYTES] if isinstance(self._stored, bytes) else _head(self._stored)
        if not any(mark in head for mark in _MARKS):
            return None
        try:
            with Image.open(_file_of(self._stored)) as opened:
                orientation = _orientation(opened)
        except (*_BROKEN, Image.DecompressionBombError):  # ``check`` reports what is wrong
            return None
        return orientation if orientation in _UPRIGHT else None


def upright_picture(picture: Any) -> Any:
    """Return a picture, turned and mirrored according to the EXIF orientation.

    ``ImageOps.exif_transpose`` gives the same pixels, but fails if it cannot write the other EXIF data again.
    """
    from PIL import Image

    picture.load()  # which turns a TIFF file's picture
    name = _UPRIGHT.get(_orientation(picture))
    return picture if name is None else picture.transpose(Image.Transpose[name])


def _file_of(picture: bytes | Path) -> Any:
    return picture if isinstance(picture, Path) else io.BytesIO(picture)


def _head(file: Path) -> bytes:
    with file.open("rb", buffering=0) as opened:
        return opened.read(_HEAD_BYTES)


def _orientation(picture: Any) -> int:
    from PIL import ExifTags

    orientation = picture.getexif().get(ExifTags.Base.Orientation)
    return orientation if isinstance(orientation, int) else 1
