# SPDX-License-Identifier: MIT
"""From the body of a request to samples: JSON, or multipart with arrays as files. Nothing beyond the limits is read."""

from __future__ import annotations

import re
import reprlib
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any

from fastapi import HTTPException, Request
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from pydantic_core import ErrorDetails, from_json
from starlette.datastructures import UploadFile
from starlette.types import Message

from rfm_client.gateway import schema
from rfm_client.gateway.npy import Upload
from rfm_client.off_loop import off_loop

MAX_PARTS = 10_000  # files, and fields, of one multipart request
TOO_LARGE = 413
UNREADABLE = 400

_LAST_BOUNDARY = b"--"  # of multipart, behind its name
_TAIL_BYTES = 16

_SAMPLE_FIELD = re.compile(r"sample_(0|[1-9][0-9]{0,5})")
_STEPS_FIELD = "use_frame_steps"
_TAG_ERRORS = ("union_tag_invalid", "union_tag_not_found")
_EXPECTED = {  # pydantic's kind of error, and what a field of it is
    "string_type": "text",
    "dict_type": "an object",
    "model_type": "an object",
    "model_attributes_type": "an object",
}


class Batch:
    """samples: at least one; use_frame_steps: whether progress samples are scored frame by frame."""

    def __init__(self, samples: list[schema.Sample], *, use_frame_steps: bool) -> None:
        self.samples = samples
        self.use_frame_steps = use_frame_steps


def invalid(loc: tuple[str | int, ...], message: str, kind: str = "value_error") -> RequestValidationError:
    """The error at a field of the body, as FastAPI tells its own."""
    return RequestValidationError([{"type": kind, "loc": ["body", *loc], "msg": message}])


async def read_json(request: Request, max_bytes: int) -> Batch:
    """The samples of a JSON request. Raises RequestValidationError, HTTPException."""
    body = await _limited(request, max_bytes).body()
    document, num_bytes = await off_loop(len(body), _parsed, body), len(body)
    samples, use_frame_steps = _unwrapped(document)
    return Batch(await off_loop(num_bytes, _checked, samples, {}), use_frame_steps=use_frame_steps)


@asynccontextmanager
async def read_multipart(request: Request, max_bytes: int) -> AsyncIterator[Batch]:
    """The samples of a multipart request; its files are on disk, but for small ones, as long as the context lasts.

    Raises RequestValidationError, HTTPException.
    """
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "multipart/form-data":
        raise HTTPException(415, f"content-type: expected multipart/form-data, got {kind or 'none'}")
    limited = _limited(request, max_bytes, ending=_LAST_BOUNDARY)
    async with limited.form(max_files=MAX_PARTS, max_fields=MAX_PARTS, max_part_size=max_bytes) as form:
        uploads: dict[str, Upload] = {}
        fields: dict[str, str] = {}
        for name, value in form.multi_items():
            if isinstance(value, UploadFile):
                uploads[name] = value
            else:
                fields[name] = value
        samples = [_field(fields, name) for name in _sample_fields(fields)]
        num_bytes = sum(upload.size or 0 for upload in uploads.values())
        checked = await off_loop(num_bytes, _checked, samples, uploads)
        yield Batch(checked, use_frame_steps=fields.get(_STEPS_FIELD, "").strip().lower() == "true")


def _limited(request: Request, max_bytes: int, *, ending: bytes = b"") -> Request:
    """The request, which raises 413 as soon as more than ``max_bytes`` are announced or have come, and 400 if it does
    not end as it must: what is left out of it may be a sample.
    """
    announced = request.headers.get("content-length", "")
    too_large = HTTPException(TOO_LARGE, f"body: expected at most {max_bytes} bytes, got more")
    if announced.isdecimal() and int(announced) > max_bytes:
        raise too_large
    come, tail = 0, b""

    async def receive() -> Message:
        nonlocal come, tail
        message = await request.receive()
        part = message.get("body", b"")
        come += len(part)
        if come > max_bytes:
            raise too_large
        tail = (tail + part[-_TAIL_BYTES:])[-_TAIL_BYTES:]
        is_last = message["type"] == "http.request" and not message.get("more_body", False)
        if is_last and not tail.rstrip(b"\r\n").endswith(ending):
            raise HTTPException(UNREADABLE, "body: expected its last boundary at its end, got none")
        return message

    return Request(request.scope, receive)


def _parsed(body: bytes) -> Any:
    try:
        return from_json(body)
    except ValueError as error:
        raise invalid((), f"expected JSON, got: {error}", "json_invalid") from None


def _unwrapped(document: Any) -> tuple[list[Any], bool]:
    """The samples of each form that the evaluation server took or was said to take, and use_frame_steps."""
    use_frame_steps = False
    if isinstance(document, dict):
        steps = document.get(_STEPS_FIELD, False)
        use_frame_steps = steps is True or str(steps).lower() == "true"
        others = [value for key, value in document.items() if key != _STEPS_FIELD]
        if "sample_type" in document:
            document = [document]
        elif "samples" in document:
            document = document["samples"]
        elif len(others) == 1 and isinstance(others[0], list):
            document = others[0]
        else:
            document = others
    if not isinstance(document, list):
        raise invalid(("samples",), f"expected a list of samples, got {type(document).__name__}", "list_type")
    return document, use_frame_steps


def _sample_fields(fields: Mapping[str, str]) -> list[str]:
    """``sample_0``, ``sample_1`` and so on, without a gap: one left out would shift the answers of the others."""
    numbers = sorted(int(match[1]) for match in map(_SAMPLE_FIELD.fullmatch, fields) if match)
    for expected, number in enumerate(numbers):
        if number != expected:
            raise invalid((f"sample_{expected}",), f"expected a sample, got none, but sample_{number}", "missing")
    return [f"sample_{number}" for number in numbers]


def _field(fields: Mapping[str, str], name: str) -> Any:
    try:
        return from_json(fields[name])
    except ValueError as error:
        raise invalid((name,), f"expected JSON, got: {error}", "json_invalid") from None


def _checked(samples: list[Any], uploads: Mapping[str, Upload]) -> list[schema.Sample]:
    if not samples:
        raise invalid(("samples",), "expected at least one sample, got none", "too_short")
    try:
        return schema.SAMPLES.validate_python(samples, context=uploads)
    except ValidationError as error:
        raise RequestValidationError(
            [_field_error(each) for each in error.errors(include_url=False, include_context=False)]
        ) from None


def _field_error(error: ErrorDetails) -> dict[str, Any]:
    """As this gateway tells its own: ``expected X, got Y`` at a path without the sample's type, which pydantic puts
    behind its index.
    """
    kind, given, loc = error["type"], error["input"], [*error["loc"][:1], *error["loc"][2:]]
    message = error["msg"].removeprefix("Value error, ")
    if kind in _TAG_ERRORS:
        loc.append("sample_type")
        message = f"expected progress, preference or similarity, got {reprlib.repr(given.get('sample_type'))}"
    elif kind == "missing":
        message = "expected a value, got none"
    elif kind in _EXPECTED:
        message = f"expected {_EXPECTED[kind]}, got {type(given).__name__}"
    return {"type": kind, "loc": ["body", "samples", *loc], "msg": message}
