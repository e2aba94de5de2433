# SPDX-License-Identifier: MIT
"""Refuse requests without the key, and requests from web pages that the gateway did not serve.

A page from another site can send requests to addresses that only its visitor can reach, such as 127.0.0.1. Browsers
reveal this in ``Origin`` and ``Sec-Fetch-Site``, which no page can change. With DNS rebinding, the page's own name
resolves to such an address, so browsers take both servers for one; then ``Host`` has the page's name. Starlette's
middleware falls short: TrustedHostMiddleware knows names but no rule for IP addresses, and CORSMiddleware refuses only
preflights.
"""

from __future__ import annotations

import base64
import ipaddress
import secrets
import socket
from collections.abc import Awaitable, Callable
from typing import Annotated
from urllib.parse import urlsplit

from fastapi import Depends, HTTPException
from fastapi.security import APIKeyHeader, HTTPAuthorizationCredentials, HTTPBearer
from fastapi.security.http import HTTPBase
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rfm_gateway.config import GatewayConfig
from rfm_gateway.refusals import refuse

_NEVER_PUBLIC = ("local", "internal", "lan", "svc")  # top-level domains that do not exist in public DNS
_MOST_LETTERS = 100  # quoted from a header in a response
_KEY_IN_URL = "http://any:KEY@HOST, KEY percent-encoded"
_HEADER = APIKeyHeader(name="X-API-Key", auto_error=False)  # at module level, where FastAPI resolves annotations
_BEARER = HTTPBearer(auto_error=False)
_BASIC = HTTPBase(
    scheme="basic",
    scheme_name="HTTPBasic",
    description=f"The key as password, with any user name: {_KEY_IN_URL}.",
    auto_error=False,
)
_EXPECTED_KEY = (
    "key: expected it in X-API-Key, in Authorization: Bearer, or as the password of HTTP Basic "
    f"({_KEY_IN_URL}), got another or none"
)
_CHALLENGE = "Bearer"  # not Basic: a browser would ask its user for a password


class ForeignPageMiddleware:
    """ASGI middleware that answers 421 to a foreign ``Host`` and 403 to requests from foreign pages.

    has_key: True: accept every host, because a page has no key
    """

    def __init__(self, app: ASGIApp, config: GatewayConfig, *, has_key: bool) -> None:
        self._app = app
        self._origins = config.cors_origin
        self._has_key = has_key
        self._is_local = config.address.is_loopback
        own = () if self._is_local else (config.host or "", socket.gethostname())
        self._names = {name.lower().removesuffix(".") for name in (*config.allow_host, *own)}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""

        async def send_embedded_here_alone(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers["Cross-Origin-Resource-Policy"] = "same-origin"  # without TLS, browsers do not say who asks
                headers.setdefault("Content-Security-Policy", "frame-ancestors 'none'")  # a page's own has it, too
            await send(message)

        refusal = self._refusal(scope) if scope["type"] == "http" else None
        await (refusal or self._app)(scope, receive, send_embedded_here_alone)

    def _refusal(self, scope: Scope) -> JSONResponse | None:
        headers = Headers(scope=scope)
        host = headers.get("host")  # only HTTP/1.0 may leave it out, and browsers never do
        if host is not None and not self._has_key and not self._is_known(host):
            expected = "localhost or an IP address" if self._is_local else "a local name or an IP address"
            remedy = "start the gateway with a key, or name this host: --allow-host (rfm serve: --gateway-allow-host)"
            detail = f"host: expected {expected}, got {host[:_MOST_LETTERS]!r}; {remedy}"
            return refuse(scope, 421, detail)
        if self._is_foreign(headers, scope["method"]):
            got = headers.get("origin") or "none, of another site"
            remedy = "start the gateway with --cors-origin (rfm serve: --gateway-cors-origin) to allow it"
            detail = f"origin: expected the gateway's own, got {got[:_MOST_LETTERS]!r}; {remedy}"
            return refuse(scope, 403, detail)
        return None

    def _is_known(self, host: str) -> bool:
        """True for names that a foreign page cannot have.

        On a loopback address these are ``localhost`` and IP addresses. On others, local network names also count:
        whoever can assign those can reach the gateway without a browser.
        """
        try:
            name = (urlsplit(f"//{host}").hostname or "").removesuffix(".")
        except ValueError:  # malformed
            return False
        *parents, last = name.split(".")
        is_of_network = not self._is_local and name != "" and (not parents or last in _NEVER_PUBLIC)
        if last == "localhost" or is_of_network or name in self._names:
            return True
        try:
            return bool(ipaddress.ip_address(name))
        except ValueError:
            return False

    def _is_foreign(self, headers: Headers, method: str) -> bool:
        origin, site = headers.get("origin"), headers.get("sec-fetch-site")
        if origin is not None and (origin in self._origins or "*" in self._origins):
            return False
        if site is None:
            return origin is not None and origin.partition("://")[2] != headers.get("host")
        follows_link = method in ("GET", "HEAD") and headers.get("sec-fetch-dest") == "document"  # no page reads it
        return site not in ("same-origin", "none") and not follows_link


def key_check(key: str) -> Callable[..., Awaitable[None]]:
    """Return a dependency that refuses requests without the key."""
    expected = key.encode()

    async def check(  # async, because FastAPI would run a plain function in a thread
        in_header: Annotated[str | None, Depends(_HEADER)],
        in_bearer: Annotated[HTTPAuthorizationCredentials | None, Depends(_BEARER)],
        in_basic: Annotated[HTTPAuthorizationCredentials | None, Depends(_BASIC)],
    ) -> None:
        bearer = in_bearer.credentials if in_bearer is not None else ""
        given = ((in_header or "").encode(), bearer.encode(), _password(in_basic))
        matches = [secrets.compare_digest(each, expected) for each in given]  # all, in constant time
        if not any(matches):
            raise HTTPException(401, _EXPECTED_KEY, {"WWW-Authenticate": _CHALLENGE})

    return check


def _password(credentials: HTTPAuthorizationCredentials | None) -> bytes:
    """Return the HTTP Basic password; empty: another scheme, or malformed."""
    if credentials is None or credentials.scheme.lower() != "basic":
        return b""
    try:
        return base64.b64decode(credentials.credentials).partition(b":")[2]
    except ValueError:
        return b""
