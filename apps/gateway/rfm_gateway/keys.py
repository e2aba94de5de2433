# SPDX-License-Identifier: MIT
"""The key that requests must show."""

from __future__ import annotations

import base64
import secrets
from collections.abc import Awaitable, Callable
from typing import Annotated

from fastapi import Depends, HTTPException
from fastapi.security import APIKeyHeader, HTTPAuthorizationCredentials, HTTPBearer
from fastapi.security.http import HTTPBase

_HEADER = APIKeyHeader(name="X-API-Key", auto_error=False)  # at module level, where FastAPI resolves annotations
_BEARER = HTTPBearer(auto_error=False)
_BASIC = HTTPBase(
    scheme="basic",
    scheme_name="HTTPBasic",
    description="The key as password, with any user name: http://any:KEY@HOST.",
    auto_error=False,
)
_EXPECTED = (
    "key: expected it in X-API-Key, in Authorization: Bearer, or as the password of HTTP Basic (http://any:KEY@HOST), "
    "got another or none"
)
_CHALLENGE = "Bearer"  # not Basic, for which a browser would ask its user for a password


def key_check(key: str) -> Callable[..., Awaitable[None]]:
    """Return a dependency that refuses requests without the key."""
    expected = key.encode()

    async def check(  # not in a thread, as FastAPI would run a plain function
        in_header: Annotated[str | None, Depends(_HEADER)],
        in_bearer: Annotated[HTTPAuthorizationCredentials | None, Depends(_BEARER)],
        in_basic: Annotated[HTTPAuthorizationCredentials | None, Depends(_BASIC)],
    ) -> None:
        bearer = in_bearer.credentials if in_bearer is not None else ""
        given = ((in_header or "").encode(), bearer.encode(), _password(in_basic))
        matches = [secrets.compare_digest(each, expected) for each in given]  # all, in constant time
        if not any(matches):
            raise HTTPException(401, _EXPECTED, {"WWW-Authenticate": _CHALLENGE})

    return check


def _password(credentials: HTTPAuthorizationCredentials | None) -> bytes:
    """Return the password of HTTP Basic; empty: another scheme, or malformed."""
    if credentials is None or credentials.scheme.lower() != "basic":
        return b""
    try:
        return base64.b64decode(credentials.credentials).partition(b":")[2]
    except ValueError:
        return b""
