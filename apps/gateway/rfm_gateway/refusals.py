# SPDX-License-Identifier: MIT
"""Let callers see why a request is refused or fails, and log it: many callers never show the text."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import anyio
from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LINGER_S = 10.0  # as aiohttp
_MOST_LETTERS = 500  # in a logged reason
_MOST_NAME_LETTERS = 100  # in a logged path or program

logger = logging.getLogger("rfm_gateway.refusals")


def refuse(scope: Scope, code: int, detail: Any, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """Write a line to the log, and return the response with this status, 400 or above.

    detail: text, or field errors as ``field_errors.invalid`` makes them
    """
    logger.warning("%d %s: %s", code, asked(scope), _reason(detail))
    return JSONResponse({"detail": detail}, code, headers)


class LingerMiddleware:
    """ASGI middleware that reads and drops the rest of a body after the response, for at most LINGER_S.

    Closing a connection with unread bytes resets it. Callers that send all before they read, such as urllib, would get
    the reset instead of the refusal.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request. The response, and with it the connection, ends once the body has ended."""
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
