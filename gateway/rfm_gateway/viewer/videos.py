# SPDX-License-Identifier: MIT
"""Uploaded videos -> frames.

Nobody vouches for them. So they are read as one of a few formats, by how they begin, and never as what they look like
to the decoder: a play list or a session description names other files or addresses, which the decoder would open.
"""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from starlette.datastructures import UploadFile

from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.samples import UInt8Array
from rfm_client.data.orientation import Orientation, turned
from rfm_client.data.video import frame_times_s, read_video

Times: TypeAlias = npt.NDArray[np.float64]

KINDS = "MP4, MOV, WebM, Matroska, Ogg or AVI"
_BEGINNING_BYTES = 12
_MP4_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
_EBML, _OGG, _RIFF, _AVI = b"\x1a\x45\xdf\xa3", b"OggS", b"RIFF", b"AVI "


@dataclass(frozen=True, eq=False)
class Video:
    """The frames of a video: uint8 [T, H, W, 3]. times_s: when each is shown; None: unknown."""

    frames: UInt8Array
    times_s: Times | None


async def read_upload(
    upload: UploadFile, fps: float, take: Callable[[int], object], orient: Orientation = "none"
) -> Video:
    """The frames at ``fps`` of an uploaded video. Raises InvalidSampleError, and what ``take`` raises.

    take: told how many bytes of memory are taken, before they are
    orient: how frames are turned
    """
    video = await asyncio.to_thread(_read, upload, fps, take)
    if orient == "none":
        return video
    take(video.frames.nbytes)  # both are there for a moment
    return replace(video, frames=await asyncio.to_thread(turned, video.frames, orient))


def _read(upload: UploadFile, fps: float, take: Callable[[int], object]) -> Video:
    name = upload.filename or "the video"
    upload.file.seek(0)
    container = _container(upload.file.read(_BEGINNING_BYTES))
    if container is None:
        raise InvalidSampleError.at("video", f"a file of the kind {KINDS}", f"another kind ({name})")
    with TemporaryDirectory(prefix="rfm-gateway-") as folder:
        file = Path(folder) / "video"
        upload.file.seek(0)
        with file.open("wb") as copy:
            shutil.copyfileobj(upload.file, copy)
        try:
            frames = read_video(file, fps, take=take, container=container)
            return Video(frames, frame_times_s(file, len(frames), container=container))
        except InvalidSampleError as error:
            raise InvalidSampleError(str(error).replace(str(file), name)) from None


def _container(beginning: bytes) -> str | None:
    """FFmpeg's name of the format of a video that begins so; None: it is none of KINDS."""
    if beginning[4:8] in _MP4_BOXES:
        return "mov"
    if beginning.startswith(_EBML):
        return "matroska"
    if beginning.startswith(_OGG):
        return "ogg"
    return "avi" if beginning[:4] == _RIFF and beginning[8:12] == _AVI else None
