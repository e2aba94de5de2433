# SPDX-License-Identifier: MIT
"""What the page asks about videos: the fields of its forms, and uploaded videos -> frames.

Nobody vouches for the videos. So they are read as one of a few formats, by how they begin, and never as what they look
like to the decoder: a play list or a session description names other files or addresses, which the decoder would open.
"""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import numpy.typing as npt
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field, StringConstraints, ValidationError
from starlette.datastructures import UploadFile

from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.samples import MAX_FRAME_STEPS, Trajectory
from rfm_client.data.orientation import Orientation, turned
from rfm_client.data.sampling import Rule, Sampling
from rfm_client.data.video import frame_times_s, read_video
from rfm_gateway.body import Decoded, field_errors, invalid

DEFAULT_FPS = 3.0  # as rfm-client score has it
KINDS = "MP4, MOV, WebM, Matroska, Ogg or AVI"

_BEGINNING_BYTES = 12
_MP4_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
_EBML, _OGG, _RIFF, _AVI = b"\x1a\x45\xdf\xa3", b"OggS", b"RIFF", b"AVI "


@dataclass(frozen=True, eq=False)
class ShownVideo:
    """A video of a task. times_s: float64 [T], when each frame is shown; None: unknown"""

    trajectory: Trajectory
    times_s: npt.NDArray[np.float64] | None


class VideoRequest(BaseModel):
    """How videos are scored: the fields of a form, of which those that are empty count as not there.

    fps: frames a second that are taken of a video
    rule, frames: of each point's prefix; None: as the checkpoint was trained
    resize: frames are made as small as the checkpoint reads them
    orient: how frames are turned before
    """

    task: Annotated[str, StringConstraints(strip_whitespace=True)]
    model: str
    fps: Annotated[float, Field(gt=0, allow_inf_nan=False)] = DEFAULT_FPS
    rule: Rule | None = Field(None, alias="sampling")
    frames: Annotated[int, Field(ge=1, le=MAX_FRAME_STEPS)] | None = None
    resize: bool = False
    orient: Orientation = "none"

    @classmethod
    def of(cls, fields: Mapping[str, str], default_model: str) -> VideoRequest:
        """The question of a form. Raises RequestValidationError for a field that is not allowed."""
        given = {name: text for name, text in fields.items() if text.strip()}
        try:
            return cls.model_validate({"model": default_model, **given})
        except ValidationError as error:
            raise RequestValidationError(field_errors(error)) from None

    def sampling(self, info: ModelInfo) -> Sampling:
        """The rule with its frames. Raises RequestValidationError for a number that the rule does not take."""
        try:
            return Sampling.of(self.rule, self.frames, info.max_frames, trained_padding=info.trained_padding)
        except ValueError as error:
            where, _, message = str(error).partition(": ")
            raise invalid((where,), message) from None

    async def video(self, uploads: Mapping[str, UploadFile], name: str, decoded: Decoded) -> ShownVideo:
        """The video of this name. Raises RequestValidationError, HTTPException as ``decoded``."""
        if name not in uploads:
            raise invalid((name,), "expected a video file, got none")
        try:
            return await asyncio.to_thread(self._read, uploads[name], decoded)
        except InvalidSampleError as error:
            where, _, message = error.message.partition(": ")
            raise invalid((name if where == "video" else where,), message) from None

    def _read(self, upload: UploadFile, decoded: Decoded) -> ShownVideo:
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
                frames = read_video(file, self.fps, take=decoded.take, container=container)
                times_s = frame_times_s(file, len(frames), container=container)
            except InvalidSampleError as error:
                raise InvalidSampleError(str(error).replace(str(file), name)) from None
        return ShownVideo(Trajectory(frames=turned(frames, self.orient), task=self.task), times_s)


def _container(beginning: bytes) -> str | None:
    """FFmpeg's name of the format of a video that begins so; None: it is none of KINDS."""
    if beginning[4:8] in _MP4_BOXES:
        return "mov"
    if beginning.startswith(_EBML):
        return "matroska"
    if beginning.startswith(_OGG):
        return "ogg"
    return "avi" if beginning[:4] == _RIFF and beginning[8:12] == _AVI else None
