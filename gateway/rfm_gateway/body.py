# SPDX-License-Identifier: MIT
"""From the body of a request to samples: JSON, or multipart with arrays as files. Nothing beyond the limits is read."""

from __future__ import annotations

import re
import reprlib
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from fastapi import HTTPException, Request
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from pydantic_core import ErrorDetails, from_json
from python_multipart.multipart import parse_options_header
from starlette.datastructures import FormData, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.types import Message

from rfm_client.transport.deadline import Deadline
from rfm_client.transport.off_loop import off_loop
from rfm_gateway import schema
from rfm_gateway.memory import Memory, Share
from rfm_gateway.npy import Upload, read_npy

NPY_ENDPOINT = "/evaluate_batch_npy"
SCORE_ENDPOINT, COMPARE_ENDPOINT = "/viewer/score", "/viewer/compare"  # of the page
MULTIPART_ENDPOINTS = (NPY_ENDPOINT, SCORE_ENDPOINT, COMPARE_ENDPOINT)
MAX_PARTS = 10_000  # files, and fields, of one multipart request
MAX_SAMPLES = 10_000  # of one request
MAX_JSON_BYTES = 32 * 2**20  # arrays have a better way
READ_JSON_GROWTH = 5  # times as large as its text is JSON usually when it is read: what waits for room before that
CHARSETS = ("utf-8", "utf8", "us-ascii", "ascii", "iso-8859-1", "iso8859-1", "latin-1", "latin1")

_NUMBER_BYTES, _LIST_BYTES, _TEXT_BYTES, _OBJECT_BYTES = 48, 88, 96, 208  # what Python takes for one, at the most
ERROR_BYTES = 2048  # of a field, as the error shows it
_PART_BYTES, _HEADER_BYTES = 2560, 384  # what a part of a multipart body takes besides its content, and a header of it

_ANY_SAMPLE_FIELD = re.compile(r"sample_[0-9]+")
_SAMPLE_FIELD = re.compile(r"sample_(0|[1-9][0-9]{0,5})")
_STEPS_FIELD = "use_frame_steps"
_FLAGS = {"true": True, "1": True, "false": False, "0": False, "": False}
_FORM_FLAGS = {**_FLAGS, "1": False}  # as the evaluation server reads forms
_TAG_ERRORS = ("union_tag_invalid", "union_tag_not_found")
_EXPECTED = {  # pydantic's kind of error, and what a field of it is
    "string_type": "text",
    "dict_type": "an object",
    "model_type": "an object",
    "model_attributes_type": "an object",
}


@dataclass(frozen=True)
class Batch:
    """The samples of one request, at least one.

    use_frame_steps: whether progress samples are scored frame by frame
    """

    samples: list[schema.Sample]
    use_frame_steps: bool


def invalid(loc: tuple[str | int, ...], message: str, kind: str = "value_error") -> RequestValidationError:
    """The error at a field of the body, in the form of FastAPI's own errors."""
    return RequestValidationError([{"type": kind, "loc": ["body", *loc], "msg": message}])


@dataclass(frozen=True)
class Admitted:
    """A request whose body is read within the limits, and what it holds of the memory for all."""

    request: Request
    share: Share

    async def wait_for_room(self, deadline: Deadline) -> None:
        """Waits until there is memory for the announced body. Raises HTTPException 503."""
        announced = self.request.headers.get("content-length", "")
        growth = 1 if _is_multipart(self.request) else READ_JSON_GROWTH
        await self.share.reserve(int(announced) * growth if announced.isdecimal() else 0, deadline)


async def read_json(admitted: Admitted) -> Batch:
    """The samples of a JSON request. Raises RequestValidationError, HTTPException."""
    body = await admitted.request.body()
    return await off_loop(len(body), _of_json, body, admitted.share)


async def read_multipart(admitted: Admitted) -> Batch:
    """The samples of a multipart request, whose files lie on disk, but for small ones, until they are arrays.

    Raises RequestValidationError, HTTPException.
    """
    async with parts_of(admitted) as (fields, uploads):
        for name in uploads:
            if name == _STEPS_FIELD or _ANY_SAMPLE_FIELD.fullmatch(name):
                raise invalid((name,), "expected a form field, got a file")
        json_bytes = sum(map(len, fields.values()))
        if json_bytes > MAX_JSON_BYTES:
            raise HTTPException(413, f"body: expected at most {MAX_JSON_BYTES} bytes of JSON, got more")
        num_bytes = json_bytes + sum(upload.size or 0 for upload in uploads.values())
        return await off_loop(num_bytes, _of_form, fields, uploads, admitted.share)


@asynccontextmanager
async def parts_of(admitted: Admitted) -> AsyncIterator[tuple[dict[str, str], dict[str, UploadFile]]]:
    """Fields and files of a multipart request by name; the files are there as long as the context lasts.

    Raises RequestValidationError for two of one name, HTTPException.
    """
    form = await _Form(admitted).parse()
    try:
        uploads: dict[str, UploadFile] = {}
        fields: dict[str, str] = {}
        for name, value in form.multi_items():
            if name in uploads or name in fields:
                raise invalid((name,), "expected one part of this name, got several")
            if isinstance(value, UploadFile):
                uploads[name] = value
            else:
                fields[name] = value
        yield fields, uploads
    finally:
        await form.close()


class _Form(MultiPartParser):
    """Starlette's parser, which here counts what parts take besides their content."""

    def __init__(self, admitted: Admitted) -> None:
        request = admitted.request
        limits = {"max_files": MAX_PARTS, "max_fields": MAX_PARTS, "max_part_size": MAX_JSON_BYTES}
        super().__init__(request.headers, request.stream(), **limits)
        self._share = admitted.share

    def on_part_begin(self) -> None:
        self._share.take(_PART_BYTES)
        super().on_part_begin()

    def on_header_end(self) -> None:
        self._share.take(_HEADER_BYTES)
        super().on_header_end()

    async def parse(self) -> FormData:
        """The fields of the form. Raises HTTPException (400) for a malformed body."""
        try:
            return await super().parse()
        except MultiPartException as error:
            raise HTTPException(400, error.message) from None


def parsed_bytes(json: bytes) -> int:
    """The most memory that JSON becomes, arrays included. Counting is quicker than reading, and safe."""
    is_narrow = json.isascii() and b"\\u" not in json  # else one letter may make a whole text four bytes wide
    return (
        len(json) * (1 if is_narrow else 4)
        + json.count(b",") * _NUMBER_BYTES
        + json.count(b"[") * _LIST_BYTES
        + json.count(b'"') // 2 * _TEXT_BYTES
        + json.count(b"{") * _OBJECT_BYTES
    )


def _of_json(body: bytes, share: Share) -> Batch:
    share.take(parsed_bytes(body))
    samples, use_frame_steps = _unwrapped(_parsed(body))
    return Batch(_checked(samples, {}, share), use_frame_steps)


def _of_form(fields: Mapping[str, str], uploads: Mapping[str, Upload], share: Share) -> Batch:
    share.take(sum(parsed_bytes(field.encode(errors="surrogatepass")) for field in fields.values()))
    samples = [_field(fields, name) for name in _sample_fields(fields)]
    arrays = {name: cache(partial(read_npy, upload)) for name, upload in uploads.items()}  # of each one, however often
    return Batch(_checked(samples, arrays, share), _flag(fields.get(_STEPS_FIELD, False), _FORM_FLAGS))


class BodyLimits:
    """How much the requests may bring.

    max_bytes: of one request's body, of JSON at most MAX_JSON_BYTES; max_memory_bytes: held for all requests together,
    where JSON counts as what it becomes, and copies and files are added
    """

    def __init__(self, max_bytes: int, max_memory_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._memory = Memory(max_memory_bytes)

    @contextmanager
    def admitted(self, request: Request, most_json_bytes: int = MAX_JSON_BYTES) -> Iterator[Admitted]:
        """The request, whose body counts as held as long as the context lasts.

        Reading it raises HTTPException: 413 as soon as too much is announced or has come, 503 if all requests together
        hold too much, 400 if a multipart body does not end as it must (what was cut off may be a sample), 415 if a
        multipart body is required and this is none.
        """
        with self._memory.share() as share:
            yield Admitted(self._limited(request, share, most_json_bytes), share)

    def _limited(self, request: Request, share: Share, most_json_bytes: int) -> Request:
        ending = _ending(request)
        most = self._max_bytes if ending else min(self._max_bytes, most_json_bytes)
        too_large = HTTPException(413, f"body: expected at most {most} bytes, got more")
        announced = request.headers.get("content-length", "")
        if announced.isdecimal() and int(announced) > most:
            raise too_large
        come, tail = 0, b""

        async def receive() -> Message:
            nonlocal come, tail
            message = await request.receive()
            part = message.get("body", b"")
            come += len(part)
            if come > most:
                raise too_large
            share.take(len(part))
            tail = (tail + part[-len(ending) - 2 :])[-len(ending) - 2 :]  # behind it a line may end
            is_last = message["type"] == "http.request" and not message.get("more_body", False)
            if is_last and not tail.rstrip(b"\r\n").endswith(ending):
                raise HTTPException(400, "body: expected its last boundary at its end, got none")
            return message

        return Request(request.scope, receive)


def _ending(request: Request) -> bytes:
    """The bytes with which a multipart body ends; empty for the JSON endpoint."""
    if not _is_multipart(request):
        return b""
    kind, options = parse_options_header(request.headers.get("content-type", ""))
    if kind != b"multipart/form-data" or not options.get(b"boundary"):
        raise HTTPException(
            415, f"content-type: expected multipart/form-data with a boundary, got {kind.decode() or 'none'}"
        )
    charset = options.get(b"charset", b"utf-8").decode("latin-1")
    if charset.lower().replace("_", "-") not in CHARSETS:  # Python has others, some of which do not decode text
        raise HTTPException(
            415, f"content-type: expected a charset of utf-8, us-ascii or iso-8859-1, got {reprlib.repr(charset)}"
        )
    return b"--" + options[b"boundary"] + b"--"


def _is_multipart(request: Request) -> bool:
    return request.url.path.endswith(MULTIPART_ENDPOINTS)


def _flag(value: Any, flags: Mapping[str, bool] = _FLAGS) -> bool:
    """A boolean as JSON or, with its own ``flags``, a form writes it. Raises RequestValidationError."""
    if value is None:
        return False
    if isinstance(value, (bool, int, str)) and str(value).strip().lower() in flags:
        return flags[str(value).strip().lower()]
    raise invalid((_STEPS_FIELD,), f"expected true or false, got {reprlib.repr(value)}")


def _parsed(body: bytes) -> Any:
    try:
        return from_json(body)
    except ValueError as error:
        raise invalid((), f"expected JSON, got: {error}", "json_invalid") from None


def _unwrapped(document: Any) -> tuple[list[Any], bool]:
    """The samples of each form that the evaluation server took or was said to take, and use_frame_steps."""
    use_frame_steps = False
    if isinstance(document, dict):
        use_frame_steps = _flag(document.get(_STEPS_FIELD, False))
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
    """The fields ``sample_0``, ``sample_1`` and so on. A gap is refused: it would shift later answers."""
    numbers = []
    for name in filter(_ANY_SAMPLE_FIELD.fullmatch, fields):
        if not _SAMPLE_FIELD.fullmatch(name):
            raise invalid((name,), "expected sample_0, sample_1 and so on, got another spelling")
        numbers.append(int(name.partition("_")[2]))
    numbers.sort()
    for expected, number in enumerate(numbers):
        if number != expected:
            raise invalid((f"sample_{expected}",), f"expected a sample, got none, but sample_{number}", "missing")
    return [f"sample_{number}" for number in numbers]


def _field(fields: Mapping[str, str], name: str) -> Any:
    try:
        return from_json(fields[name])
    except (ValueError, TypeError) as error:  # of TypeError: letters that no UTF-8 has
        raise invalid((name,), f"expected JSON, got: {error}", "json_invalid") from None


def _checked(
    samples: list[Any], arrays: Mapping[str, Callable[[], np.ndarray[Any, Any]]], share: Share
) -> list[schema.Sample]:
    if not samples:
        raise invalid(("samples",), "expected at least one sample, got none", "too_short")
    if len(samples) > MAX_SAMPLES:
        raise invalid(("samples",), f"expected at most {MAX_SAMPLES} samples, got {len(samples)}", "too_long")
    try:
        return schema.SAMPLES.validate_python(samples, context=arrays)
    except ValidationError as error:
        share.take(error.error_count() * ERROR_BYTES)
        raise RequestValidationError(
            [_field_error(each) for each in error.errors(include_url=False, include_context=False)]
        ) from None


def _field_error(error: ErrorDetails) -> dict[str, Any]:
    """pydantic's error in the form of this gateway's own: ``expected X, got Y`` at a path.

    The path leaves out the sample's type, which pydantic puts behind the sample's index.
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
