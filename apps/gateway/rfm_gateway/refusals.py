# SPDX-License-Identifier: MIT
"""Log requests that were refused or failed, since many callers never show the text of an answer."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from typing import Any

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rfm_gateway.limited_log import LimitedLog

MOST_LINES = 20  # in a period of the log
_MOST_LETTERS = 500  # of a reason
_MOST_NAME_LETTERS = 100  # of a path or a program

logger = logging.getLogger("rfm_gateway.refusals")


def asked(scope: Scope) -> str:
    """Return method, path, and the caller's address and program."""
    client, program = scope.get("client"), Headers(scope=scope).get("user-agent", "no User-Agent")
    caller = client[0] if client else "an unknown address"
    return f"{scope['method']} {scope['path'][:_MOST_NAME_LETTERS]} for {caller} ({program[:_MOST_NAME_LETTERS]})"


class RefusalLog:
    """ASGI middleware that logs a line for each answer of status 400 and above, within the limits of LimitedLog.

    The line has the status, ``asked`` and the first reason.
    """

    def __init__(self, app: ASGIApp, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._app = app
        self._log = LimitedLog(logger, MOST_LINES, "more requests were refused or failed", clock_s)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request, and log its refusal."""
        code = 200

        async def send_logged(message: Message) -> None:
            nonlocal code
            await send(message)
            if message["type"] == "http.response.start":
                code = message["status"]
            elif code >= 400 and not message.get("more_body"):
                self._log.write(lambda: f"{code} {asked(scope)}: {_reason(message.get('body', b''))}")

        await self._app(scope, receive, send_logged if scope["type"] == "http" else send)


def _reason(body: bytes) -> str:
    """Return the first reason in an answer, and how many more it has."""
    try:
        detail: Any = json.loads(body)["detail"]
        if not isinstance(detail, str):
            first, *others = (f"{'.'.join(map(str, each['loc'][1:]))}: {each['msg']}" for each in detail)
            detail = first[:_MOST_LETTERS] + (f" (and {len(others)} more)" if others else "")
    except (ValueError, LookupError, TypeError):
        return "no reason"
    return str(detail)[: 2 * _MOST_LETTERS]
