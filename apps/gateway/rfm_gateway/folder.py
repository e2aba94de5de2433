# SPDX-License-Identifier: MIT
"""Read the files that requests name: only from a folder that the operator allows, and never pickle."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from zipfile import BadZipFile, ZipFile

import numpy as np

from rfm_client import InvalidSampleError, Trajectory, UInt8Array, load_trajectory
from rfm_client.frames import ARRAY_SUFFIXES, Picture
from rfm_gateway.body import Take

if TYPE_CHECKING:
    from PIL.Image import Image


@dataclass(frozen=True)
class RequestFiles:
    """The files for one request.

    folder: the allowed folder, with links resolved; None: no file is read
    take: called with the decoded size of files before they are read

    Methods raise InvalidSampleError, and what ``take`` raises.
    """

    folder: Path | None
    take: Take

    def frames(self, names: Sequence[str]) -> UInt8Array:
        """Return the T named images as uint8 [T, H, W, 3], RGB, turned upright by EXIF data."""
        with self._image(names[0], "frames.0") as first:
            num_pixels = first.height * first.width
        self.take(len(names) * num_pixels * 3)
        others = InvalidSampleError.at("frames", "images of one size", "different ones")
        frames = np.empty(0, np.uint8)
        for index, name in enumerate(names):
            with self._image(name, f"frames.{index}") as image:
                if image.height * image.width != num_pixels:  # known before it is decoded
                    raise others
                pixels = Picture(image).pixels()
            if index == 0:
                frames = np.empty((len(names), *pixels.shape), np.uint8)
            if pixels.shape != frames.shape[1:]:
                raise others
            frames[index] = pixels
        return frames

    def embeddings(self, name: str) -> Trajectory:
        """Return the embeddings in a .npy or .npz file."""
        file = self._file(name, "embeddings_path")
        if file.suffix.lower() not in ARRAY_SUFFIXES:
            raise InvalidSampleError.at("embeddings_path", " or ".join(ARRAY_SUFFIXES), name)
        try:
            self.take(_unpacked_bytes(file))
            trajectory = load_trajectory(file)
        except (OSError, ValueError, BadZipFile):  # also InvalidSampleError, whose message has the whole path
            raise InvalidSampleError.at("embeddings_path", "a file of embeddings [T, D]", name) from None
        if trajectory.video_embeddings is None:
            raise InvalidSampleError.at("embeddings_path", "a file of embeddings", "frames")
        return trajectory

    @contextmanager
    def _image(self, name: str, where: str) -> Iterator[Image]:
        from PIL import Image

        file = self._file(name, where)
        try:
            with Image.open(file) as image:
                yield image
        except InvalidSampleError:
            raise
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
            raise InvalidSampleError.at(where, "an image file", name) from None

    def _file(self, name: str, where: str) -> Path:
        if self.folder is None:
            raise InvalidSampleError.at(where, "an array (this gateway reads no files)", "the name of a file")
        try:
            file = (self.folder / name).resolve()
            is_in_folder = file.is_relative_to(self.folder) and file.is_file()  # resolve() has followed links
        except (OSError, ValueError, RuntimeError):  # an impossible name, or links in a circle
            is_in_folder = False
        if not is_in_folder:
            raise InvalidSampleError.at(where, "a file in the allowed folder", name)
        return file


def _unpacked_bytes(file: Path) -> int:
    """Return the unpacked size of the arrays in a .npy or .npz file."""
    if file.suffix.lower() == ".npz":
        with ZipFile(file) as archive:
            return sum(entry.file_size for entry in archive.infolist())
    return file.stat().st_size
