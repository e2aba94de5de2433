# SPDX-License-Identifier: MIT
"""Read the samples of a request's body, JSON or multipart with arrays as files, within limits."""

from __future__ import annotations

import re
import reprlib
from collections import Counter
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from functools import cache, partial
from tokenize import TokenError
from typing import Any, TypeAlias

import numpy as np
from fastapi import HTTPException, Request
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from pydantic_core import from_json
from python_multipart.multipart import parse_options_header
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from rfm_client.serving import off_loop
from rfm_gateway import schema
from rfm_gateway.admission import Turn, arriving

DECODED_PER_BODY = 2  # limit of decoded files, as a multiple of the body's limit
MAX_PARTS = 2000  # of one multipart request: each takes memory, also if it is empty
IN_MEMORY_BYTES = 32 * 2**20  # of a file; larger files lie on disk
MAX_SAMPLES = 10_000  # of one request
MAX_JSON_BYTES = 32 * 2**20  # large arrays come as files
MAX_ERRORS = 1000  # listed in an answer

_format: Any = np.lib.format  # numpy declares no types for it
_BROKEN_NPY = (ValueError, TypeError, LookupError, SyntaxError, TokenError, MemoryError, RecursionError)  # its errors
_ANY_SAMPLE_FIELD = re.compile(r"sample_[0-9]+")
_SAMPLE_FIELD = re.compile(r"sample_(0|[1-9][0-9]{0,5})")
_STEPS_FIELD = "use_frame_steps"
_CHARSETS = ("utf-8", "utf8", "us-ascii")
_FLAGS = {"true": True, "1": True, "false": False, "0": False, "": False}
_FORM_FLAGS = {**_FLAGS, "1": False}  # as the evaluation server reads forms
_EXPECTED = {  # the expected value, by pydantic's kind of error
    "string_type": "text",
    "dict_type": "an object",
    "model_type": "an object",
    "model_attributes_type": "an object",
    "missing": "a value",
    "extra_forbidden": "no such field",
    "union_tag_invalid": "progress, preference or similarity",
    "union_tag_not_found": "progress, preference or similarity",
}
_AROUND_EXPECTED = re.compile("^.*?should (be|have|match) | after validation.*|, unable to .*")  # in its messages

Take: TypeAlias = Callable[[int], object]  # takes bytes from a budget, or raises


@dataclass(frozen=True)
class Batch:
    """The samples of one request, at least one.

    use_frame_steps: True: progress samples are scored frame by frame; None: the request does not say
    num_bytes: size of the body
    """

    samples: list[schema.Sample]
    use_frame_steps: bool | None
    num_bytes: int = 0


def invalid(loc: tuple[str | int, ...], message: str, kind: str = "value_error") -> RequestValidationError:
    """Return an error at a field of the body, in the form of FastAPI's own errors."""
    return RequestValidationError([{"type": kind, "loc": ["body", *loc], "msg": message}])


def field_errors(error: ValidationError) -> list[dict[str, Any]]:
    """Return pydantic's errors in the gateway's form, ``expected X, got Y`` at a path.

    Raises RequestValidationError with only their number if there are more than MAX_ERRORS.
    """
    if error.error_count() > MAX_ERRORS:
        raise invalid((), f"expected no faulty fields, got {error.error_count()}")
    return [_field_error(each) for each in error.errors(include_url=False)]


@dataclass(frozen=True)
class BodyLimits:
    """Limits of a request's body: its size, of JSON at most MAX_JSON_BYTES, and its time of arrival.

    Reading raises HTTPException 413 and 503, and TimeoutError, as ``arriving`` and ``Turn`` do.
    """

    max_bytes: int
    timeout_s: float

    async def read(self, request: Request, max_bytes: int = MAX_JSON_BYTES) -> bytes:
        """Return the whole body."""
        return b"".join([chunk async for chunk in self._chunks(request, min(self.max_bytes, max_bytes))])

    @contextmanager
    def decoding(self) -> Iterator[Take]:
        """Yield a function that takes bytes from one request's budget for decoded files, before they are decoded.

        It raises HTTPException 413 if too few are left, and always after the context, so that threads stop decoding.
        """
        most_bytes = DECODED_PER_BODY * self.max_bytes
        left_bytes: float = most_bytes

        def take(num_bytes: int) -> None:
            nonlocal left_bytes
            left_bytes -= num_bytes
            if left_bytes < 0:
                limit = f"files of at most {most_bytes} bytes in one request, when they are decoded"
                raise HTTPException(413, f"body: expected {limit}, got more")

        try:
            yield take
        finally:
            left_bytes = float("-inf")

    @asynccontextmanager
    async def form(self, request: Request) -> AsyncIterator[tuple[dict[str, str], dict[str, UploadFile]]]:
        """Yield fields and files of a multipart request by name. The files exist until the context ends.

        Raises RequestValidationError for two parts of the same name, HTTPException 415 for another content type and 400
        for a malformed or incomplete body, which may lack a sample.
        """
        kind, options = parse_options_header(request.headers.get("content-type", ""))
        if kind != b"multipart/form-data" or not options.get(b"boundary"):
            expected = "content-type: expected multipart/form-data with a boundary"
            raise HTTPException(415, f"{expected}, got {kind.decode('latin-1') or 'none'}")
        charset = options.get(b"charset", b"utf-8").decode("latin-1")
        if charset.lower() not in _CHARSETS:  # some of Python's codecs fail, others change the text
            raise HTTPException(415, f"content-type: expected the charset utf-8, got {reprlib.repr(charset)}")
        most: Any = {"max_files": MAX_PARTS, "max_fields": MAX_PARTS, "max_part_size": MAX_JSON_BYTES}
        parser = _Form(request.headers, self._chunks(request, self.max_bytes), **most)
        try:
            form = await parser.parse()
        except (MultiPartException, ValueError) as error:  # ValueError: of python_multipart
            raise HTTPException(400, f"body: expected multipart/form-data, got: {error}") from None
        try:
            if not parser.has_ended:
                raise HTTPException(400, "body: expected its last boundary at its end, got none")
            for name, count in Counter(name for name, _ in form.multi_items()).items():
                if count > 1:
                    raise invalid((name,), "expected one part of this name, got several")
            uploads = {name: value for name, value in form.items() if isinstance(value, UploadFile)}
            yield {name: value for name, value in form.items() if isinstance(value, str)}, uploads
        finally:
            await form.close()

    def _chunks(self, request: Request, max_bytes: int) -> AsyncGenerator[bytes, None]:
        chunks = arriving(request, max_bytes, self.timeout_s)
        turn: Turn | None = request.state.turn
        return chunks if turn is None else turn.admitted(chunks)


class _Form(MultiPartParser):
    """Starlette's parser, with a bound for parts and a flag for the last boundary."""

    spool_max_size = IN_MEMORY_BYTES
    has_ended = False
    num_parts = 0

    def on_part_begin(self) -> None:
        self.num_parts += 1
        if self.num_parts > MAX_PARTS:
            expected = f"body: expected at most {MAX_PARTS} parts, fields and files together"
            raise HTTPException(413, f"{expected}, got more; send the samples in several requests")
        super().on_part_begin()

    def on_end(self) -> None:
        self.has_ended = True


async def read_json(limits: BodyLimits, request: Request) -> Batch:
    """Return the samples of a JSON request. Raises RequestValidationError and the errors of ``limits``."""
    body = await limits.read(request)
    return await off_loop(len(body), _of_json, body)


async def read_multipart(limits: BodyLimits, request: Request) -> Batch:
    """Return the samples of a multipart request. Large files lie on disk until they are decoded.

    Raises RequestValidationError and the errors of ``limits``.
    """
    async with limits.form(request) as (fields, uploads):
        for name in uploads:
            if name == _STEPS_FIELD or _ANY_SAMPLE_FIELD.fullmatch(name):
                raise invalid((name,), "expected a form field, got a file")
        json_bytes = sum(map(len, fields.values()))
        if json_bytes > MAX_JSON_BYTES:
            raise HTTPException(413, f"body: expected at most {MAX_JSON_BYTES} bytes of JSON, got more")
        num_bytes = json_bytes + sum(upload.size or 0 for upload in uploads.values())
        return await off_loop(num_bytes, _of_form, fields, uploads, num_bytes)


def _of_json(body: bytes) -> Batch:
    samples, use_frame_steps = _unwrapped(_parsed(body, ()))
    return Batch(_checked(samples, {}), use_frame_steps, len(body))


def _of_form(fields: Mapping[str, str], uploads: Mapping[str, UploadFile], num_bytes: int) -> Batch:
    samples = [_parsed(fields[name], (name,)) for name in _sample_fields(fields)]
    arrays = {name: cache(partial(_read_npy, upload)) for name, upload in uploads.items()}  # each file is decoded once
    return Batch(_checked(samples, arrays), _flag(fields.get(_STEPS_FIELD), _FORM_FLAGS), num_bytes)


def _read_npy(upload: UploadFile) -> np.ndarray[Any, Any]:
    """Return the numbers in a .npy file. Raises ValueError, also for pickle and for bytes behind the array."""
    upload.file.seek(0)
    try:
        array: np.ndarray[Any, Any] = _format.read_array(upload.file, allow_pickle=False)
    except _BROKEN_NPY as error:
        raise ValueError(f"expected a .npy file, got: {error}") from None
    if array.dtype.kind not in "biuf":
        raise ValueError(f"expected a .npy file of numbers, got {array.dtype}")
    if upload.file.read(1):
        raise ValueError(f"expected a .npy file of {array.nbytes} bytes behind its header, got more")
    upload.file.close()  # frees its memory
    return array


def _flag(value: Any, flags: Mapping[str, bool] = _FLAGS) -> bool | None:
    """Return a boolean from JSON or, with _FORM_FLAGS, from a form; None: none. Raises RequestValidationError."""
    if value is None:
        return None
    if isinstance(value, (bool, int, str)) and str(value).strip().lower() in flags:
        return flags[str(value).strip().lower()]
    raise invalid((_STEPS_FIELD,), f"expected true or false, got {reprlib.repr(value)}")


def _parsed(text: bytes | str, loc: tuple[str, ...]) -> Any:
    try:
        return from_json(text)
    except (ValueError, TypeError) as error:  # TypeError: text that is no UTF-8
        raise invalid(loc, f"expected JSON, got: {error}", "json_invalid") from None


def _unwrapped(document: Any) -> tuple[list[Any], bool | None]:
    """Return samples and use_frame_steps, from every form that the evaluation server takes or documents."""
    use_frame_steps = None
    if isinstance(document, dict):
        use_frame_steps = _flag(document.get(_STEPS_FIELD))
        others = [value for key, value in document.items() if key != _STEPS_FIELD]
        if "sample_type" in document:
            document = [document]
        elif "samples" in document:
            document = document["samples"]
        elif len(others) == 1 and isinstance(others[0], list):
            document = others[0]
        else:
            document = others
    if isinstance(document, list):
        return document, use_frame_steps
    raise invalid(("samples",), f"expected a list of samples, got {type(document).__name__}", "list_type")


def _sample_fields(fields: Mapping[str, str]) -> list[str]:
    """Return the names ``sample_0``, ``sample_1`` and so on. Raises for a gap, which would shift later answers."""
    names = [name for name in fields if _ANY_SAMPLE_FIELD.fullmatch(name)]
    for name in names:
        if not _SAMPLE_FIELD.fullmatch(name):
            raise invalid((name,), "expected sample_0, sample_1 and so on, got another spelling")
    numbers = sorted(int(name.partition("_")[2]) for name in names)
    for expected, number in enumerate(numbers):
        if number != expected:
            raise invalid((f"sample_{expected}",), f"expected a sample, got none, but sample_{number}", "missing")
    return [f"sample_{number}" for number in numbers]


def _checked(samples: list[Any], arrays: Mapping[str, Callable[[], np.ndarray[Any, Any]]]) -> list[schema.Sample]:
    if not samples:
        raise invalid(("samples",), "expected at least one sample, got none", "too_short")
    if len(samples) > MAX_SAMPLES:
        raise invalid(("samples",), f"expected at most {MAX_SAMPLES} samples, got {len(samples)}", "too_long")
    try:
        return schema.SAMPLES.validate_python(samples, context=arrays)
    except ValidationError as error:
        found = field_errors(error)
        for each in found:  # pydantic puts a sample's type behind its index
            (body, index), path = each["loc"][:2], each["loc"][3:]
            each["loc"] = [body, "samples", index, *(["sample_type"] if "union_tag" in each["type"] else path)]
        raise RequestValidationError(found) from None


def _field_error(error: Any) -> dict[str, Any]:
    kind, message, given = error["type"], error["msg"], error["input"]
    if kind == "value_error":
        message = str(error["ctx"]["error"])
    elif kind == "json_invalid":
        message = f"expected JSON, got: {error['ctx']['error']}"
    else:
        given = given.get("sample_type") if "union_tag" in kind else given
        expected = _EXPECTED.get(kind) or _AROUND_EXPECTED.sub("", message)
        got = {"missing": "none", "too_long": "more"}.get(kind) or reprlib.repr(given)
        message = f"expected {expected}, got {got}"
    return {"type": kind, "loc": ["body", *(each for each in error["loc"] if each != "[key]")], "msg": message}
