# SPDX-License-Identifier: MIT
"""Refuse requests of web pages that the gateway did not serve.

A page of another site can send requests to addresses that only its visitor can reach, such as 127.0.0.1. Browsers say
so in ``Origin`` and ``Sec-Fetch-Site``, which no page can change. With DNS rebinding, the page's own name leads to such
an address, and browsers take both servers for one. Then ``Host`` has the page's name.
"""

from __future__ import annotations

import ipaddress
import socket
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rfm_gateway.config import GatewayConfig

EMBEDDED_HERE_ALONE = {"Cross-Origin-Resource-Policy": "same-origin"}  # without TLS, browsers do not say who asks
_IN_NO_FRAME = "frame-ancestors 'none'"
_ANY_ORIGIN = "*"
_NEVER_PUBLIC = ("local", "internal", "lan", "svc")  # top-level domains that the public DNS does not have
_MOST_LETTERS = 100  # of a header in an answer


class ForeignPageMiddleware:
    """ASGI middleware that answers 421 to a foreign ``Host`` and 403 to a request of a foreign page.

    has_key: True: every host is taken, since a page has no key
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
                headers.update(EMBEDDED_HERE_ALONE)
                headers.setdefault("Content-Security-Policy", _IN_NO_FRAME)  # a page has its own, which says so, too
            await send(message)

        refusal = None
        if scope["type"] == "http":
            refusal = self._refusal(Headers(scope=scope), scope["method"])
        await (refusal or self._app)(scope, receive, send_embedded_here_alone)

    def _refusal(self, headers: Headers, method: str) -> JSONResponse | None:
        host = headers.get("host")  # only HTTP/1.0 may leave it out, and browsers never do
        if host is not None and not self._has_key and not self._is_known(_name_in(host)):
            expected = "localhost or an IP address" if self._is_local else "a local name or an IP address"
            remedy = "start the gateway with a key, or name this host: --allow-host (rfm serve: --gateway-allow-host)"
            detail = f"host: expected {expected}, got {host[:_MOST_LETTERS]!r}; {remedy}"
            return JSONResponse({"detail": detail}, 421)
        if self._is_foreign(headers, method):
            got = headers.get("origin") or "none, of another site"
            remedy = "start the gateway with --cors-origin (rfm serve: --gateway-cors-origin) to allow it"
            detail = f"origin: expected the gateway's own, got {got[:_MOST_LETTERS]!r}; {remedy}"
            return JSONResponse({"detail": detail}, 403)
        return None

    def _is_known(self, name: str) -> bool:
        """True for names that a foreign page cannot have.

        On a loopback address these are ``localhost`` and IP addresses. On others, also names of the local network:
        whoever can choose those can reach the gateway without a browser.
        """
        *parents, last = name.split(".")
        is_of_network = not self._is_local and name != "" and (not parents or last in _NEVER_PUBLIC)
        return last == "localhost" or is_of_network or name in self._names or _is_ip_address(name)

    def _is_foreign(self, headers: Headers, method: str) -> bool:
        origin, site = headers.get("origin"), headers.get("sec-fetch-site")
        if origin is not None and (origin in self._origins or _ANY_ORIGIN in self._origins):
            return False
        if site is not None:
            return site not in ("same-origin", "none") and not _follows_link(headers, method)
        return origin is not None and origin.partition("://")[2] != headers.get("host")


def _name_in(host: str) -> str:
    """Return the name or address in a ``Host``, in lower case; empty if it is malformed."""
    try:
        return (urlsplit(f"//{host}").hostname or "").removesuffix(".")
    except ValueError:
        return ""


def _is_ip_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _follows_link(headers: Headers, method: str) -> bool:
    """True if a browser opens an answer as a page, which the page with the link cannot read."""
    return method in ("GET", "HEAD") and headers.get("sec-fetch-dest") == "document"
