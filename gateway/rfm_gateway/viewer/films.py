# SPDX-License-Identifier: MIT
"""Uploaded videos -> frames. Nobody vouches for them: only kinds of files that name no other files are opened."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from starlette.datastructures import UploadFile

from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.samples import UInt8Array
from rfm_client.data.video import frame_times_s, read_video

Times: TypeAlias = npt.NDArray[np.float64]

KINDS = "MP4, MOV, WebM, Matroska, Ogg or AVI"
_BEGINNING_BYTES = 12
_MP4_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")


@dataclass(frozen=True, eq=False)
class Film:
    """The frames of a video: uint8 [T, H, W, 3]. times_s: when each is shown; None: unknown."""

    frames: UInt8Array
    times_s: Times | None


async def read_film(upload: UploadFile, fps: float, take: Callable[[int], object]) -> Film:
    """The frames at ``fps`` of an uploaded video. Raises InvalidSampleError, and what ``take`` raises.

    take: told how many bytes of memory are taken, before they are
    """
    return await asyncio.to_thread(_read, upload, fps, take)


def _read(upload: UploadFile, fps: float, take: Callable[[int], object]) -> Film:
    name = upload.filename or "the video"
    upload.file.seek(0)
    if not _is_film(upload.file.read(_BEGINNING_BYTES)):
        raise InvalidSampleError.at("video", f"a file of the kind {KINDS}", f"another kind ({name})")
    with TemporaryDirectory(prefix="rfm-gateway-") as folder:
        file = Path(folder) / "video"
        upload.file.seek(0)
        with file.open("wb") as copy:
            shutil.copyfileobj(upload.file, copy)
        try:
            frames = read_video(file, fps, take=take)
            return Film(frames, frame_times_s(file, len(frames)))
        except InvalidSampleError as error:
            raise InvalidSampleError(str(error).replace(str(file), name)) from None


def _is_film(beginning: bytes) -> bool:
    """Whether a file that begins so is a video by itself.

    Play lists are text that names other files or addresses, which the decoder would open.
    """
    is_avi = beginning[:4] == b"RIFF" and beginning[8:12] == b"AVI "
    is_other = beginning.startswith((b"\x1a\x45\xdf\xa3", b"OggS"))
    return is_avi or is_other or beginning[4:8] in _MP4_BOXES
