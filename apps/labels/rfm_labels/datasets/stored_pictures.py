# SPDX-License-Identifier: MIT
"""Pictures of datasets, such as PNG and JPEG, with errors that name the place. Needs Pillow. H x W pixels."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rfm_client import InvalidSampleError, UInt8Array
from rfm_client.frames import decoded_picture as pixels_of
from rfm_client.frames import exif_turn, opened_picture
from rfm_labels.datasets.protocol import DatasetError


def decoded_picture(where: str, picture: bytes | Path) -> UInt8Array:
    """Return the pixels of a picture, or of its file, uint8 [H, W, 3], upright by EXIF. Raises DatasetError."""
    with _errors_at(where):
        return pixels_of(opened_picture(picture))


def check_picture(where: str, picture: bytes | Path) -> None:
    """Raise DatasetError unless a picture, or its file, has 8-bit colours. Only the header is read."""
    with _errors_at(where):
        opened_picture(picture).close()


def turn_mark(picture: bytes | Path) -> str:
    """Return a text for ``Dataset.identity`` if EXIF data turn a picture, as earlier labels did not; else ""."""
    orientation = exif_turn(picture)
    return "" if orientation is None else f" EXIF {orientation}"


@contextmanager
def _errors_at(where: str) -> Iterator[None]:
    try:
        yield
    except InvalidSampleError as error:
        raise DatasetError.like(error, where=where) from error
