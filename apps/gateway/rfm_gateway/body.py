# SPDX-License-Identifier: MIT
"""Read samples from a request body, JSON or multipart with arrays as files, within limits."""

from __future__ import annotations

import re
import reprlib
from collections import Counter
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from functools import cache, partial
from tokenize import TokenError
from typing import Any, TypeAlias

import anyio
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
from rfm_gateway.field_errors import STEPS_FIELD, Path, field_errors, invalid

DECODED_PER_BODY = 2  # limit for decoded files, as a multiple of the body's limit
MAX_PARTS = 2000  # per multipart request: even an empty part takes memory
IN_MEMORY_BYTES = 32 * 2**20  # per file; larger files lie on disk
MAX_SAMPLES = 10_000  # per request
MAX_JSON_BYTES = 32 * 2**20  # large arrays come as files
AS_FILES = "send arrays as .npy files, to /evaluate_batch_npy"
LARGER = "send less in one request, or start the gateway with --max-body-mib (rfm serve: --gateway-max-body-mib)"

_format: Any = np.lib.format  # numpy declares no types for it
_BROKEN_NPY = (ValueError, TypeError, LookupError, SyntaxError, TokenError, MemoryError, RecursionError)  # numpy errors
_ANY_SAMPLE_FIELD = re.compile(r"sample_[0-9]+")
_SAMPLE_FIELD = re.compile(r"sample_(0|[1-9][0-9]{0,5})")
_CHARSETS = ("utf-8", "utf8", "us-ascii")
_FLAGS = {"true": True, "1": True, "false": False, "0": False, "": False}
_FORM_FLAGS = {**_FLAGS, "1": False}  # as the evaluation server reads forms

Take: TypeAlias = Callable[[int], object]  # takes bytes from a budget, or raises


@dataclass(frozen=True)
class Batch:
    """The samples in one request, at least one.

    paths: each sample's path in the body, for errors
    use_frame_steps: True: progress samples are scored frame by frame; None: the request does not say
    num_bytes: body size
    """

    samples: list[schema.Sample]
    paths: Sequence[Path]
    use_frame_steps: bool | None
    num_bytes: int = 0


@dataclass(frozen=True)
class BodyLimits:
    """Limits on a request body: size, at most MAX_JSON_BYTES for JSON, and time to arrive.

    Reading raises HTTPException 413 as soon as the announced or received size is too large, and TimeoutError.
    """

    max_bytes: int
    timeout_s: float

    async def read_json(self, request: Request) -> bytes:
        """Return the whole body."""
        limit = min((self.max_bytes, LARGER), (MAX_JSON_BYTES, AS_FILES))
        with anyio.fail_after(self.timeout_s):
            return b"".join([chunk async for chunk in self._chunks(request, *limit)])

    @contextmanager
    def decoding(self) -> Iterator[Take]:
        """Yield a function that takes bytes from one request's budget for decoded files, before they are decoded.

        The function raises HTTPException 413 if too few are left, and always after the context, so that threads stop
        decoding.
        """
        most_bytes = DECODED_PER_BODY * self.max_bytes
        left_bytes: float = most_bytes

        def take(num_bytes: int) -> None:
            nonlocal left_bytes
            left_bytes -= num_bytes
            if left_bytes < 0:
                limit = f"files of at most {most_bytes} bytes in one request, when they are decoded"
                raise HTTPException(413, f"body: expected {limit}, got more; {LARGER}")

        try:
            yield take
        finally:
            left_bytes = float("-inf")

    @asynccontextmanager
    async def form(self, request: Request) -> AsyncIterator[tuple[dict[str, str], dict[str, UploadFile]]]:
        """Yield a multipart request's fields and files by name. The files exist until the context ends.

        Raises RequestValidationError for two parts with the same name, HTTPException 415 for another content type and
        400 for a malformed or incomplete body, which may lack a sample.
        """
        kind, options = parse_options_header(request.headers.get("content-type", ""))
        if kind != b"multipart/form-data" or not options.get(b"boundary"):
            expected = "content-type: expected multipart/form-data with a boundary"
            raise HTTPException(415, f"{expected}, got {kind.decode('latin-1') or 'none'}")
        charset = options.get(b"charset", b"utf-8").decode("latin-1")
        if charset.lower() not in _CHARSETS:  # some of Python's codecs fail, others change the text
            raise HTTPException(415, f"content-type: expected the charset utf-8, got {reprlib.repr(charset)}")
        most: Any = {"max_files": MAX_PARTS, "max_fields": MAX_PARTS, "max_part_size": MAX_JSON_BYTES}
        parser = _Form(request.headers, self._chunks(request, self.max_bytes, LARGER), **most)
        try:
            with anyio.fail_after(self.timeout_s):
                form = await parser.parse()
        except (MultiPartException, ValueError) as error:  # python_multipart raises ValueError
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

    async def _chunks(self, request: Request, max_bytes: int, remedy: str) -> AsyncGenerator[bytes, None]:
        coding = request.headers.get("content-encoding", "identity")
        if coding.lower() != "identity":
            expected = "content-encoding: expected none, since the gateway unpacks no body"
            raise HTTPException(415, f"{expected}, got {reprlib.repr(coding)}; send the body as it is")
        too_large = HTTPException(413, f"body: expected at most {max_bytes} bytes, got more; {remedy}")
        announced, num_bytes = request.headers.get("content-length", ""), 0
        if announced.isdecimal() and int(announced) > max_bytes:
            raise too_large
        async for chunk in request.stream():
            num_bytes += len(chunk)
            if num_bytes > max_bytes:
                raise too_large
            yield chunk


class _Form(MultiPartParser):
    """Starlette's parser, with a part limit and a flag for the last boundary."""

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
    """Return the samples in a JSON request. Raises RequestValidationError and the errors from ``limits``."""
    body = await limits.read_json(request)
    return await off_loop(len(body), _of_json, body)


async def read_multipart(limits: BodyLimits, request: Request) -> Batch:
    """Return the samples in a multipart request. Large files lie on disk until they are decoded.

    Raises RequestValidationError and the errors from ``limits``.
    """
    async with limits.form(request) as (fields, uploads):
        for name in uploads:
            if name == STEPS_FIELD or _ANY_SAMPLE_FIELD.fullmatch(name):
                raise invalid((name,), "expected a form field, got a file")
        json_bytes = sum(map(len, fields.values()))
        if json_bytes > MAX_JSON_BYTES:
            raise HTTPException(413, f"body: expected at most {MAX_JSON_BYTES} bytes of JSON, got more; {AS_FILES}")
        num_bytes = json_bytes + sum(upload.size or 0 for upload in uploads.values())
        return await off_loop(num_bytes, _of_form, fields, uploads, num_bytes)


def _of_json(body: bytes) -> Batch:
    samples, use_frame_steps = _unwrapped(_parsed(body, ()))
    return Batch(_checked(samples, {}), [*samples], use_frame_steps, len(body))


def _of_form(fields: Mapping[str, str], uploads: Mapping[str, UploadFile], num_bytes: int) -> Batch:
    samples: dict[Path, Any] = {(name,): _parsed(fields[name], (name,)) for name in _sample_fields(fields)}
    arrays = {name: cache(partial(_read_npy, upload)) for name, upload in uploads.items()}  # each file is decoded once
    steps = _flag(fields.get(STEPS_FIELD), _FORM_FLAGS)
    return Batch(_checked(samples, arrays), [*samples], steps, num_bytes)


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
    raise invalid((STEPS_FIELD,), f"expected true or false, got {reprlib.repr(value)}")


def _parsed(text: bytes | str, loc: tuple[str, ...]) -> Any:
    try:
        return from_json(text)
    except (ValueError, TypeError) as error:  # TypeError: text that is not UTF-8
        raise invalid(loc, f"expected JSON, got: {error}", "json_invalid") from None


def _unwrapped(document: Any) -> tuple[dict[Path, Any], bool | None]:
    """Return samples by path and use_frame_steps, from every form that the evaluation server takes or documents."""
    if not isinstance(document, dict):
        return _listed((), document), None
    use_frame_steps = _flag(document.get(STEPS_FIELD))
    others = {key: value for key, value in document.items() if key != STEPS_FIELD}
    if "sample_type" in document:
        return {(): document}, use_frame_steps
    if "samples" in document:
        return _listed(("samples",), document["samples"]), use_frame_steps
    if len(others) == 1:
        ((key, value),) = others.items()
        if isinstance(value, list):
            return _listed((key,), value), use_frame_steps
    return {(key,): value for key, value in others.items()}, use_frame_steps


def _listed(path: Path, samples: Any) -> dict[Path, Any]:
    if isinstance(samples, list):
        return {(*path, index): sample for index, sample in enumerate(samples)}
    raise invalid(path, f"expected a list of samples, got {type(samples).__name__}", "list_type")


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


def _checked(
    samples: Mapping[Path, Any], arrays: Mapping[str, Callable[[], np.ndarray[Any, Any]]]
) -> list[schema.Sample]:
    paths = list(samples)
    if not samples:
        raise invalid(("samples",), "expected at least one sample, got none", "too_short")
    if len(samples) > MAX_SAMPLES:
        raise invalid(("samples",), f"expected at most {MAX_SAMPLES} samples, got {len(samples)}", "too_long")
    try:
        return schema.SAMPLES.validate_python(list(samples.values()), context=arrays)
    except ValidationError as error:
        found = field_errors(error)
        for each in found:  # pydantic puts a sample's type behind its index
            (body, index), path = each["loc"][:2], each["loc"][3:]
            each["loc"] = [body, *paths[index], *(["sample_type"] if "union_tag" in each["type"] else path)]
        raise RequestValidationError(found) from None
