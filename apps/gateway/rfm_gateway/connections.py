# SPDX-License-Identifier: MIT
"""uvicorn's connections, with bounds that uvicorn lacks."""

from __future__ import annotations

import asyncio
import logging
from typing import Any

import httptools
from starlette.responses import JSONResponse
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from rfm_gateway.admission import PACE_BYTES, RETRY_AFTER
from rfm_gateway.refusals import RefusalLog

MAX_HEAD_BYTES = 64 * 2**10  # as of most servers; also of what comes between two pieces of a body, such as trailers

logger = logging.getLogger("rfm_gateway.connections")
logger.setLevel(logging.ERROR)  # so that malformed requests cannot fill the log

_refusal = RefusalLog(
    JSONResponse(
        {"detail": "expected fewer connections at a time, got more"}, 503, {**RETRY_AFTER, "Connection": "close"}
    )
)


def most_connections(num_descriptors: int) -> int:
    """Return how many connections leave an eighth of the descriptors for files and for Triton."""
    return num_descriptors - num_descriptors // 8


class Connection(HttpToolsProtocol):
    """A connection that is closed if the head of its next request is large or does not arrive within ``head_s``.

    It drops the trailers of a chunked body, and is closed if they are large.

    The time begins when the connection opens, and later with the first byte after an answer; until then uvicorn's
    timeout_keep_alive counts. The rest of a body that has its answer may take ``rest_s``, since many callers read an
    answer only after it. So may each PACE_BYTES of an answer: the kernel passes on large pieces.

    Beyond uvicorn's limit_concurrency, requests get JSON and Retry-After. Beyond half of the descriptors above that,
    connections are closed at once. A request before the end of the answer to another is malformed. There are no
    WebSockets.
    """

    head_s, rest_s = 10.0, 120.0

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._most, self.limit_concurrency = self.limit_concurrency, None
        self._head_due: asyncio.TimerHandle | None = None
        self._read_due: asyncio.TimerHandle | None = None
        self._is_in_head, self._dry_bytes = False, 0  # bytes of a head, or since the last piece of a body
        self.logger, self.ws_protocol_class = logger, None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn has it
        """Wait for the first head."""
        super().connection_made(transport)
        if self._most is not None and len(self.connections) > self._most + self._most // 14 + 1:
            transport.abort()
        self._await_head(self.head_s)

    def data_received(self, data: bytes) -> None:
        """Wait for the next head, from its first byte on, also while the rest of a refused body arrives."""
        is_between_requests = self.cycle is None or self.cycle.response_complete
        if is_between_requests and self._head_due is None:
            has_rest = self.cycle is not None and self.cycle.more_body
            self._await_head(self.rest_s if has_rest else self.head_s)
        self._dry_bytes += len(data)
        super().data_received(data)
        if self._dry_bytes > MAX_HEAD_BYTES:
            self.transport.abort()

    def on_message_begin(self) -> None:
        """Keep the headers that follow."""
        super().on_message_begin()
        self._is_in_head = True

    def on_header(self, name: bytes, value: bytes) -> None:
        """Keep a header, and drop a trailer."""
        if self._is_in_head:
            super().on_header(name, value)

    def on_body(self, body: bytes) -> None:
        """Begin to count anew, after data."""
        self._dry_bytes = 0
        super().on_body(body)

    def on_message_complete(self) -> None:
        """Begin to count anew, after data."""
        self._dry_bytes = 0
        super().on_message_complete()

    def on_headers_complete(self) -> None:
        """Hand the request to the application, or refuse it. Raises HttpParserError for a second one at a time."""
        self._forget_head()
        self._is_in_head = False
        if self.cycle is not None and not self.cycle.response_complete:
            raise httptools.HttpParserError("expected one request at a time, got another")
        is_full = self._most is not None and len(self.connections) > self._most
        self.app = _refusal if is_full else self.config.loaded_app
        super().on_headers_complete()

    def send_400_response(self, msg: str) -> None:
        """Refuse malformed requests, and end the answer under way."""
        if self.cycle is not None:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        super().send_400_response(msg)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the timers of head and answer."""
        self._forget_head()
        super().connection_lost(exc)
        self.resume_writing()

    def pause_writing(self) -> None:
        """Wait for the peer to read."""
        super().pause_writing()
        self._await_read(self.transport.get_write_buffer_size())

    def resume_writing(self) -> None:
        """Forget the timer of the peer's reading."""
        super().resume_writing()
        if self._read_due is not None:
            self._read_due.cancel()

    def _await_read(self, unread_bytes: int) -> None:
        self._read_due = self.loop.call_later(self.rest_s, self._check_read, unread_bytes)

    def _check_read(self, unread_before_bytes: int) -> None:
        unread_bytes = self.transport.get_write_buffer_size()
        if unread_before_bytes - unread_bytes < PACE_BYTES:
            self.transport.abort()
        else:
            self._await_read(unread_bytes)

    def _await_head(self, within_s: float) -> None:
        self._head_due = self.loop.call_later(within_s, self.transport.close)

    def _forget_head(self) -> None:
        if self._head_due is not None:
            self._head_due.cancel()
            self._head_due = None
