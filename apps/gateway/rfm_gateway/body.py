# SPDX-License-Identifier: MIT
"""Read samples from a request body, JSON or multipart with arrays as files, within limits."""

from __future__ import annotations

import gc
import io
import re
import reprlib
from collections.abc import AsyncGenerator, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
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

from rfm_client import UInt8Array
from rfm_client.serving import off_loop
from rfm_gateway import schema
from rfm_gateway.field_errors import STEPS_FIELD, Path, field_errors, invalid
from rfm_gateway.form import AS_FILES, MAX_JSON_BYTES, Form, Upload

DECODED_PER_BODY = 2  # limit for decoded files, as a multiple of the body's limit
MAX_SAMPLES = 10_000  # per request
LARGER = "send less in one request, or start the gateway with --max-body-mib (rfm serve: --gateway-max-body-mib)"

_format: Any = np.lib.format  # numpy declares no types for it
_NPY_HEADERS = {(1, 0): _format.read_array_header_1_0, (2, 0): _format.read_array_header_2_0}
_NPY_HEAD_BYTES = 2**14  # numpy reads no longer header
_BROKEN_NPY = (ValueError, TypeError, LookupError, SyntaxError, TokenError, MemoryError, RecursionError)  # numpy errors
_ANY_SAMPLE_FIELD = re.compile(r"sample_[0-9]+")
_SAMPLE_FIELD = re.compile(r"sample_(0|[1-9][0-9]{0,5})")
_CHARSETS = ("utf-8", "utf8", "us-ascii")
_FLAGS = {"true": True, "1": True, "false": False, "0": False, "": False}
_JSON_COST = 256  # bytes copied in the time that it takes to parse one
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

    Reading raises HTTPException 413 as soon as the announced or received size is too large, 503 if all bodies together
    are, and TimeoutError.
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

    async def form(self, request: Request) -> tuple[dict[str, str], dict[str, Upload]]:
        """Return a multipart request's fields and files by name.

        Raises what ``Form`` raises, but HTTPException 400 for a malformed body, and 415 for another content type.
        """
        kind, options = parse_options_header(request.headers.get("content-type", ""))
        if kind != b"multipart/form-data" or not options.get(b"boundary"):
            expected = "content-type: expected multipart/form-data with a boundary"
            raise HTTPException(415, f"{expected}, got {kind.decode('latin-1') or 'none'}")
        charset = options.get(b"charset", b"utf-8").decode("latin-1")
        if charset.lower() not in _CHARSETS:  # some of Python's codecs fail, others change the text
            raise HTTPException(415, f"content-type: expected the charset utf-8, got {reprlib.repr(charset)}")
        announced = request.headers.get("content-length", "")
        form = Form(min(int(announced), self.max_bytes) if announced.isdecimal() else 0)
        try:
            parser = form.parser(options[b"boundary"])
            with anyio.fail_after(self.timeout_s):
                async for chunk in self._chunks(request, self.max_bytes, LARGER):
                    parser.write(chunk)
        except ValueError as error:
            raise HTTPException(400, f"body: expected multipart/form-data, got: {error}") from None
        return form.parts()

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
            request.state.hold(len(chunk))
            yield chunk


async def read_json(limits: BodyLimits, request: Request) -> Batch:
    """Return the samples in a JSON request. Raises RequestValidationError and the errors from ``limits``."""
    body = await limits.read_json(request)
    return await off_loop(_JSON_COST * len(body), _of_json, body)


async def read_multipart(limits: BodyLimits, request: Request) -> Batch:
    """Return the samples in a multipart request. Raises RequestValidationError and the errors from ``limits``."""
    fields, uploads = await limits.form(request)
    for name in uploads:
        if name == STEPS_FIELD or _ANY_SAMPLE_FIELD.fullmatch(name):
            raise invalid((name,), "expected a form field, got a file")
    num_json_bytes = sum(map(len, fields.values()))
    num_bytes = num_json_bytes + sum(upload.content.nbytes for upload in uploads.values())
    return await off_loop(_JSON_COST * num_json_bytes, _of_form, fields, uploads, num_bytes)  # files are not copied


def _of_json(body: bytes) -> Batch:
    samples, use_frame_steps = _unwrapped(_parsed(body, ()))
    return Batch(_checked(samples, {}), [*samples], use_frame_steps, len(body))


def _of_form(fields: Mapping[str, str], uploads: Mapping[str, Upload], num_bytes: int) -> Batch:
    samples: dict[Path, Any] = {(name,): _parsed(fields[name], (name,)) for name in _sample_fields(fields)}
    arrays = {
        name: cache(partial(_read_npy, upload.content)) for name, upload in uploads.items()
    }  # each file is decoded once
    steps = _flag(fields.get(STEPS_FIELD), _FORM_FLAGS)
    return Batch(_checked(samples, arrays), [*samples], steps, num_bytes)


def _read_npy(content: UInt8Array) -> np.ndarray[Any, Any]:
    """Return the numbers in a .npy file, as a view if they are aligned.

    Raises ValueError, also for pickle and for bytes behind the array.
    """
    head = io.BytesIO(content[:_NPY_HEAD_BYTES].tobytes())
    try:
        shape, is_by_column, dtype = _NPY_HEADERS[_format.read_magic(head)](head)
        if dtype.kind not in "biuf":
            raise ValueError(f"{dtype} instead of numbers")
        if min(shape, default=0) < 0:  # numpy would take as many numbers as there are
            raise ValueError(f"the shape {shape}")
        order: Any = "F" if is_by_column else "C"
        array: np.ndarray[Any, Any] = np.ndarray(shape, dtype, content, head.tell(), order=order)
    except _BROKEN_NPY as error:
        raise ValueError(f"expected a .npy file, got: {error}") from None
    if head.tell() + array.nbytes < len(content):
        raise ValueError(f"expected a .npy file of {array.nbytes} bytes behind its header, got more")
    return np.require(array, requirements="A")


def _flag(value: Any, flags: Mapping[str, bool] = _FLAGS) -> bool | None:
    """Return a boolean from JSON or, with _FORM_FLAGS, from a form; None: none. Raises RequestValidationError."""
    if value is None:
        return None
    if isinstance(value, (bool, int, str)) and str(value).strip().lower() in flags:
        return flags[str(value).strip().lower()]
    raise invalid((STEPS_FIELD,), f"expected true or false, got {reprlib.repr(value)}")


def _parsed(text: bytes | str, loc: tuple[str, ...]) -> Any:
    gc.disable()  # it would go through all lists again and again while they are made
    try:
        return from_json(text)
    except (ValueError, TypeError) as error:  # TypeError: text that is not UTF-8
        raise invalid(loc, f"expected JSON, got: {error}", "json_invalid") from None
    finally:
        gc.enable()


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
