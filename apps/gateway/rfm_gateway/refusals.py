# SPDX-License-Identifier: MIT
"""Let callers see why a request is refused or fails, and log it: many callers never show the text."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import Scope

_MOST_LETTERS = 500  # in a logged reason
_MOST_NAME_LETTERS = 100  # in a logged path or program

logger = logging.getLogger("rfm_gateway.refusals")


def refuse(scope: Scope, code: int, detail: Any, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """Write a line to the log, and return the response with this status, 400 or above.

    detail: text, or field errors as ``field_errors.invalid`` makes them
    """
    logger.warning("%d %s: %s", code, asked(scope), _reason(detail))
    return JSONResponse({"detail": detail}, code, headers)


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
