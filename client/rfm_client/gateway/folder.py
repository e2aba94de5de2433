# SPDX-License-Identifier: MIT
"""Files that requests name: none, unless the operator allows a folder; then those in it alone, and no pickle."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rfm_client.errors import InvalidSampleError
from rfm_client.inputs import ARRAY_SUFFIXES, load_trajectory
from rfm_client.samples import Trajectory, UInt8Array


class AllowedFolder:
    """The folder that requests may name files of. None: they may name none.

    max_bytes: of the images of one trajectory, when they are decoded
    """

    def __init__(self, folder: Path | None, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._folder = None if folder is None else folder.resolve(strict=True)

    def frames(self, names: Sequence[str]) -> UInt8Array:
        """uint8 [T, H, W, 3], the images of these names. Raises InvalidSampleError."""
        from PIL import Image

        images: list[UInt8Array] = []
        num_bytes = 0
        for index, name in enumerate(names):
            where = f"frames.{index}"
            file = self._file(name, where)
            try:
                with Image.open(file) as image:
                    num_bytes += image.width * image.height * 3
                    if num_bytes > self._max_bytes:
                        break
                    images.append(np.asarray(image.convert("RGB")))
            except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
                raise InvalidSampleError.at(where, "an image file", name) from None
        if num_bytes > self._max_bytes:
            raise InvalidSampleError.at("frames", f"images of at most {self._max_bytes} bytes", "larger ones")
        if len({image.shape for image in images}) > 1:
            raise InvalidSampleError.at("frames", "images of one size", "different ones")
        return np.stack(images)

    def embeddings(self, name: str) -> Trajectory:
        """The embeddings in a .npy or .npz file. Raises InvalidSampleError."""
        file = self._file(name, "embeddings_path")
        if file.suffix.lower() not in ARRAY_SUFFIXES:
            raise InvalidSampleError.at("embeddings_path", " or ".join(ARRAY_SUFFIXES), name)
        try:
            trajectory = load_trajectory(file)
        except InvalidSampleError:  # which tells the whole path
            raise InvalidSampleError.at("embeddings_path", "a file of embeddings [T, D]", name) from None
        if trajectory.video_embeddings is None:
            raise InvalidSampleError.at("embeddings_path", "a file of embeddings", "frames")
        return trajectory

    def _file(self, name: str, where: str) -> Path:
        if self._folder is None:
            raise InvalidSampleError.at(where, "an array (this gateway reads no files)", "the name of a file")
        try:
            file = (self._folder / name).resolve()
            is_in_folder = file.is_relative_to(self._folder) and file.is_file()  # links are followed before
        except (OSError, ValueError, RuntimeError):  # no name of a file, or links in a circle
            is_in_folder = False
        if not is_in_folder:
            raise InvalidSampleError.at(where, "a file in the allowed folder", name)
        return file
