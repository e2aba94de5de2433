# SPDX-License-Identifier: MIT
"""Parse a multipart body while it arrives.

Not Starlette's parser, which copies each file into a temporary file, from which numpy would copy the array.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from fastapi import HTTPException
from python_multipart.multipart import MultipartParser, parse_options_header

from rfm_client import UInt8Array
from rfm_gateway.field_errors import invalid

MAX_PARTS = 2000  # even an empty part takes memory
MAX_JSON_BYTES = 32 * 2**20  # large arrays come as files
AS_FILES = "send arrays as .npy files, to /evaluate_batch_npy"
_ALIGNED_BYTES = 16  # as numpy aligns arrays; less than the head of a part takes


@dataclass(frozen=True, eq=False)
class Upload:
    """A file in a form. name: the caller's name for it; content: uint8 [bytes], a view of the body"""

    name: str
    content: UInt8Array


class Form:
    """The fields and files in a multipart body, all in one buffer: reading a file need not copy it.

    announced_bytes: size of the body; 0: unknown. No memory is taken before it arrives.

    The methods ``on_...`` are python_multipart's callbacks. They raise ValueError for a malformed body, HTTPException
    413 for too many parts and for fields above MAX_JSON_BYTES.
    """

    def __init__(self, announced_bytes: int) -> None:
        self._buffer = np.empty(announced_bytes, np.uint8)
        self._begin = self._end = 0  # of the last part's content, in the buffer
        self._parts: list[tuple[str, str | None, slice]] = []  # name, name of the file, content
        self._num_field_bytes = 0
        self._name = ""  # of the last part
        self._file: str | None = None
        self._header = self._value = self._disposition = b""
        self._has_ended = False

    def parser(self, boundary: bytes) -> MultipartParser:
        """Return the parser that fills this form. The form has no reference to it, so that both are freed at once."""
        callbacks: Any = {name: getattr(self, name) for name in dir(self) if name.startswith("on_")}
        return MultipartParser(boundary, callbacks)

    def parts(self) -> tuple[dict[str, str], dict[str, Upload]]:
        """Return fields and files by name.

        Raises HTTPException 400 for an incomplete body, RequestValidationError for two parts with the same name.
        """
        if not self._has_ended:
            raise HTTPException(400, "body: expected its last boundary at its end, got none")
        for name, count in Counter(name for name, _, _ in self._parts).items():
            if count > 1:
                raise invalid((name,), "expected one part of this name, got several")
        fields = {name: _text(self._buffer[at].tobytes()) for name, file, at in self._parts if file is None}
        uploads = {name: Upload(file, self._buffer[at]) for name, file, at in self._parts if file is not None}
        return fields, uploads

    def on_part_begin(self) -> None:
        """Begin another part, unless there are too many."""
        if len(self._parts) == MAX_PARTS:
            expected = f"body: expected at most {MAX_PARTS} parts, fields and files together"
            raise HTTPException(413, f"{expected}, got more; send the samples in several requests")
        self._disposition = b""

    def on_header_field(self, data: bytes, start: int, end: int) -> None:
        """Take a piece of a header's name."""
        self._header += data[start:end]

    def on_header_value(self, data: bytes, start: int, end: int) -> None:
        """Take a piece of a header's value."""
        self._value += data[start:end]

    def on_header_end(self) -> None:
        """Keep the header that names the part."""
        if self._header.lower() == b"content-disposition":
            self._disposition = self._value
        self._header = self._value = b""

    def on_headers_finished(self) -> None:
        """Begin the part's content."""
        _, options = parse_options_header(self._disposition)
        if b"name" not in options:
            raise ValueError("a part without a name in its Content-Disposition")
        file = options.get(b"filename")
        self._name, self._file = _text(options[b"name"]), None if file is None else _text(file)
        self._begin = self._end = -(-self._end // _ALIGNED_BYTES) * _ALIGNED_BYTES  # or numpy would copy the array

    def on_part_data(self, data: bytes, start: int, end: int) -> None:
        """Take a piece of the part's content."""
        begin, self._end = self._end, self._end + end - start
        if self._file is None:
            self._num_field_bytes += end - start
            if self._num_field_bytes > MAX_JSON_BYTES:
                raise HTTPException(413, f"body: expected at most {MAX_JSON_BYTES} bytes of JSON, got more; {AS_FILES}")
        if self._end > len(self._buffer):
            grown = np.empty(2 * self._end, np.uint8)
            grown[:begin] = self._buffer[:begin]
            self._buffer = grown
        self._buffer[begin : self._end] = np.frombuffer(data, np.uint8, end - start, start)

    def on_part_end(self) -> None:
        """Keep the place of the part's content."""
        self._parts.append((self._name, self._file, slice(self._begin, self._end)))

    def on_end(self) -> None:
        """Take note of the last boundary."""
        self._has_ended = True


def _text(text: bytes) -> str:
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1")
