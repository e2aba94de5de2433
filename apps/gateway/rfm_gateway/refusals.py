# SPDX-License-Identifier: MIT
"""Answer requests that are refused or fail so that callers see it, and log why, since many never show the text."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from typing import Any

import anyio
from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LINGER_S = 10.0  # as aiohttp
PERIOD_S = 10.0
MOST_LINES = 20  # in PERIOD_S
_MOST_LETTERS = 500  # of a reason
_MOST_NAME_LETTERS = 100  # of a path or a program

logger = logging.getLogger("rfm_gateway.refusals")


class LimitedLog:
    """Writes at most ``most_lines`` warnings in PERIOD_S. The first line after that tells the number of the others.

    others: follows that number, such as ``more requests were refused``
    """

    def __init__(
        self, logger: logging.Logger, most_lines: int, others: str, clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._logger, self._most_lines, self._others, self._clock_s = logger, most_lines, others, clock_s
        self._began_s = float("-inf")  # the period
        self._num_lines = self._num_left_out = 0

    def write(self, line: str) -> None:
        """Write a line, or count it."""
        now_s = self._clock_s()
        if now_s - self._began_s >= PERIOD_S:
            if self._num_left_out:
                self._logger.warning("%d %s", self._num_left_out, self._others)
            self._began_s, self._num_lines, self._num_left_out = now_s, 0, 0
        if self._num_lines == self._most_lines:
            self._num_left_out += 1
            return
        self._num_lines += 1
        self._logger.warning("%s", line)


class Refusals:
    """Answers of status 400 and above. Each is a line in the log, within the limits of LimitedLog."""

    def __init__(self) -> None:
        self._log = LimitedLog(logger, MOST_LINES, "more requests were refused or failed")

    def answer(self, scope: Scope, code: int, detail: Any, headers: Mapping[str, str] | None = None) -> JSONResponse:
        """Return the answer. detail: text, or errors at fields as ``field_errors.invalid`` makes them"""
        self._log.write(f"{code} {asked(scope)}: {_reason(detail)}")
        return JSONResponse({"detail": detail}, code, headers)


class LingerMiddleware:
    """ASGI middleware that goes on reading a body after the answer, for at most LINGER_S, and drops it.

    Closing a connection with unread bytes resets it. Callers that send all before they read, such as urllib, would get
    that instead of the refusal.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request. The answer ends, and with it the connection, when the body has ended."""
        is_read = is_answered = False

        async def receive_to_the_end() -> Message:
            nonlocal is_read
            message = await receive()
            is_read = not message.get("more_body", False)
            return message

        async def send_without_end(message: Message) -> None:
            nonlocal is_answered
            is_last = message["type"] == "http.response.body" and not message.get("more_body", False)
            is_answered = is_last and not is_read
            await send({**message, "more_body": True} if is_answered else message)

        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        await self._app(scope, receive_to_the_end, send_without_end)
        if is_answered:
            with anyio.move_on_after(LINGER_S):
                while not is_read:
                    await receive_to_the_end()
            await send({"type": "http.response.body"})


def asked(scope: Scope) -> str:
    """Return method, path, and the caller's address and program."""
    client, program = scope.get("client"), Headers(scope=scope).get("user-agent", "no User-Agent")
    caller = client[0] if client else "an unknown address"
    return f"{scope['method']} {scope['path'][:_MOST_NAME_LETTERS]} for {caller} ({program[:_MOST_NAME_LETTERS]})"


def _reason(detail: Any) -> str:
    """Return the first reason, and how many more there are."""
    if isinstance(detail, str):
        return detail[: 2 * _MOST_LETTERS]
    first, *others = detail
    reason = f"{'.'.join(map(str, first['loc'][1:]))}: {first['msg']}"[:_MOST_LETTERS]
    return reason + (f" (and {len(others)} more)" if others else "")
