# SPDX-License-Identifier: MIT
"""The page's requests about videos: form fields, and frames from uploaded videos.

Uploads are not trusted. Their first bytes select one of a few formats. FFmpeg must not select, because it would open
the files and addresses that a playlist or a session description names.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import numpy.typing as npt
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, Field, StringConstraints, ValidationError

from rfm_client import InvalidSampleError, ModelInfo, Trajectory
from rfm_client.frames import ChannelOrder, Correction, Orientation, Rule, Sampling, frame_times_s, read_video
from rfm_client.options import InvalidValueError
from rfm_gateway.mounting import Upload, field_errors, invalid

DEFAULT_FPS = 3.0  # the default in rfm-client score
MOST_FRAMES = 4096  # in a prefix: more than any checkpoint takes
KINDS = "MP4, MOV, WebM, Matroska, Ogg or AVI"

_BEGINNING_BYTES = 12
_MP4_BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
_EBML, _OGG, _RIFF, _AVI = b"\x1a\x45\xdf\xa3", b"OggS", b"RIFF", b"AVI "


@dataclass(frozen=True, eq=False)
class ShownVideo:
    """A video with its task. times_s: float64 [T], time of each frame; None: unknown"""

    trajectory: Trajectory
    times_s: npt.NDArray[np.float64] | None


class VideoRequest(BaseModel):
    """Form fields that say how videos are scored. An empty field counts as missing.

    fps: frames a second to read
    rule, frames: sampling of each prefix; None: the checkpoint's default
    resize: frames are shrunk to the checkpoint's input size
    orient, channels: how frames become upright RGB first
    """

    task: Annotated[str, StringConstraints(strip_whitespace=True)]
    model: str
    fps: Annotated[float, Field(gt=0, allow_inf_nan=False)] = DEFAULT_FPS
    rule: Rule | None = Field(None, alias="sampling")
    frames: Annotated[int, Field(ge=1, le=MOST_FRAMES)] | None = None
    resize: bool = False
    orient: Orientation = "none"
    channels: ChannelOrder = "rgb"

    @classmethod
    def of(cls, fields: Mapping[str, str], default_model: str) -> VideoRequest:
        """Read the fields of a form. Raises RequestValidationError for an invalid field."""
        given = {name: text for name, text in fields.items() if text.strip()}
        try:
            return cls.model_validate({"model": default_model, **given})
        except ValidationError as error:
            raise RequestValidationError(field_errors(error)) from None

    def sampling(self, info: ModelInfo) -> Sampling:
        """Return the sampling.

        Raises RequestValidationError for a frame count that the rule does not accept, and for a rule with a
        checkpoint that needs the whole episode.
        """
        rule = "all" if info.needs_whole_episode and self.rule is None else self.rule
        if info.needs_whole_episode and rule != "all":
            raise invalid(("sampling",), f"expected all: the scores of {info.kind} are relative to the whole episode")
        try:
            return Sampling.of(rule, self.frames, info.max_frames, trained_padding=info.trained_padding)
        except InvalidValueError as error:
            raise invalid((error.where,), error.problem) from None

    async def video(self, uploads: Mapping[str, Upload], name: str, take: Callable[[int], object]) -> ShownVideo:
        """Read the uploaded video with this name. Raises RequestValidationError, and what ``take`` raises.

        take: called with the frames' size in bytes before they are decoded
        """
        if name not in uploads:
            raise invalid((name,), "expected a video file, got none")
        try:
            return await asyncio.to_thread(self._read, uploads[name], take)
        except InvalidSampleError as error:
            raise invalid((name if error.where == "video" else error.where,), error.problem) from None

    def _read(self, upload: Upload, take: Callable[[int], object]) -> ShownVideo:
        name = upload.name or "the video"
        container = _container(upload.content[:_BEGINNING_BYTES].tobytes())
        if container is None:
            raise InvalidSampleError.at("video", f"a file of the kind {KINDS}", f"another kind ({name})")
        with TemporaryDirectory(prefix="rfm-gateway-") as folder:
            file = Path(folder) / "video"
            file.write_bytes(upload.content.data)
            try:
                frames = read_video(file, self.fps, take=take, container=container)
                times_s = frame_times_s(file, len(frames), container=container)
            except InvalidSampleError as error:
                raise InvalidSampleError.like(error, source=name) from None
        frames = Correction(self.orient, self.channels).applied(frames)
        return ShownVideo(Trajectory(frames=frames, task=self.task), times_s)


def _container(beginning: bytes) -> str | None:
    """Return FFmpeg's format name, from a video's first bytes; None: not in KINDS."""
    if beginning[4:8] in _MP4_BOXES:
        return "mov"
    if beginning.startswith(_EBML):
        return "matroska"
    if beginning.startswith(_OGG):
        return "ogg"
    return "avi" if beginning[:4] == _RIFF and beginning[8:12] == _AVI else None
