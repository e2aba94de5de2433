# SPDX-License-Identifier: MIT
"""What clients report of running episodes: checked to the last field, since nobody vouches for it."""

from __future__ import annotations

import base64
import binascii
import io
import reprlib
from collections.abc import Mapping
from typing import Annotated, Any

from fastapi.exceptions import RequestValidationError
from PIL import Image, UnidentifiedImageError
from pydantic import BaseModel, BeforeValidator, ConfigDict, FailFast, Field, StringConstraints, ValidationError

from rfm_gateway.body import ERROR_BYTES
from rfm_gateway.memory import Share
from rfm_gateway.viewer.live import News

MOST_BODY_BYTES = 4 * 2**20
MOST_FRAME_BYTES = 128 * 2**10
MOST_FRAME_PX = 1024  # on each side
_MOST_FRAMES = 64
_MOST_STEPS = 2000  # of one report of our client; so each of its episodes has so many at most, too
_MOST_LETTERS = 2000
_MOST_ERRORS = 20  # that one answer tells
_MOST_NUMBER = 10**9  # a chart's axis goes further than to whole numbers
_PREFIXES = ("should be ", "should have ", "should match ")  # of what pydantic expects
_KINDS = {"missing": "a value", "extra_forbidden": "no such field"}


def _jpeg(text: Any) -> bytes:
    """The file in a text of base64. Raises ValueError. Only its head is read here: it is not decoded."""
    if not isinstance(text, str):
        raise ValueError(f"expected base64, got {type(text).__name__}")
    if len(text) > MOST_FRAME_BYTES * 4 // 3:
        raise ValueError(f"expected at most {MOST_FRAME_BYTES} bytes, got more")
    try:
        content = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise ValueError("expected base64, got other text") from None
    expected = f"expected a JPEG file of at most {MOST_FRAME_PX}x{MOST_FRAME_PX} pixels"
    try:
        with Image.open(io.BytesIO(content), formats=["JPEG"]) as image:
            size = image.size
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        raise ValueError(f"{expected}, got another file") from None
    if max(size) > MOST_FRAME_PX:
        raise ValueError(f"{expected}, got {size[0]}x{size[1]}")
    return content


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


_Id = Annotated[str, StringConstraints(pattern="^[0-9a-f]{32}$")]
_Text = Annotated[str, StringConstraints(max_length=_MOST_LETTERS)]
_Count = Annotated[int, Field(ge=0, le=_MOST_NUMBER)]


class _Step(_Strict):
    step: _Count
    progress: float | None
    success: float | None
    succeeded: bool
    ms: Annotated[float, Field(ge=0)]


class _Episode(_Strict):
    id: _Id
    name: _Text
    env: _Count
    task: _Text
    threshold: float | None
    ended: bool
    steps: Annotated[list[_Step], FailFast(), Field(max_length=_MOST_STEPS)]

    @property
    def news(self) -> News:
        about = {"name": self.name, "env": self.env, "task": self.task, "threshold": self.threshold}
        return News(self.id, about, self.ended, [step.model_dump() for step in self.steps])


class _Report(_Strict):
    episodes: Annotated[list[_Episode], FailFast(), Field(max_length=_MOST_STEPS)]
    frames: Annotated[dict[_Id, Annotated[bytes, BeforeValidator(_jpeg)]], Field(max_length=_MOST_FRAMES)]


def read_report(body: bytes, share: Share) -> tuple[list[News], Mapping[str, bytes]]:
    """What a report says, and the frames in it. Raises RequestValidationError for a field that is not allowed.

    share: takes what errors hold
    """
    try:
        report = _Report.model_validate_json(body)
    except ValidationError as error:
        share.take(error.error_count() * ERROR_BYTES)
        found = error.errors(include_url=False, include_context=False)
        raise RequestValidationError([_field_error(each) for each in found[:_MOST_ERRORS]]) from None
    return [episode.news for episode in report.episodes], report.frames


def _field_error(error: Any) -> dict[str, Any]:
    """pydantic's error in the form of this gateway's own: ``expected X, got Y`` at a path."""
    kind, message, loc = error["type"], error["msg"], [each for each in error["loc"] if each != "[key]"]
    if kind == "json_invalid":
        return {"type": kind, "loc": ["body"], "msg": f"expected JSON, got: {message.removeprefix('Invalid JSON: ')}"}
    if message.startswith("Value error, "):
        return {"type": kind, "loc": ["body", *loc], "msg": message.removeprefix("Value error, ")}
    expected = _KINDS.get(kind) or next(
        (message.partition(prefix)[2] for prefix in _PREFIXES if prefix in message), message
    )
    got = "none" if kind == "missing" else reprlib.repr(error["input"])
    return {"type": kind, "loc": ["body", *loc], "msg": f"expected {expected}, got {got}"}
