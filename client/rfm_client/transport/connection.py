# SPDX-License-Identifier: MIT
"""A connection to a server: its options and credentials, and a diagnosis for wrong ports.

A firewall or a lost machine drops packets without an error. Over gRPC all calls share one connection, so every call
would run into its deadline. Two rules open a new connection instead:

- A request whose bytes the peer does not acknowledge within UNACKNOWLEDGED_MS ends the connection. The kernel enforces
  this (TCP_USER_TIMEOUT, which gRPC sets where keepalive is on). The call is sent again over a new connection.
- If a call runs into its deadline and nothing has arrived on the connection for SILENT_S, later calls get a new
  connection. This covers peers that acknowledge bytes but do not answer, such as a proxy that hangs.

Pings alone do not suffice. Triton closes a connection after more than two pings less than 300 s apart during which it
sends nothing, as in a long call. So gRPC pings at most every PING_MS, and only during a call.
"""

from __future__ import annotations

import asyncio
import http.client
import re
import socket
import ssl
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from rfm_client.contract import errors
from rfm_client.contract.addresses import check_authorities, grpc_proxy, host_of, in_url, load_certificate, split_url
from rfm_client.contract.settings import ConfigError

PING_MS = 330_000
UNACKNOWLEDGED_MS = 10_000
SILENT_S = 1.0

_UNBOUNDED = -1
GRPC_OPTIONS: dict[str, int | str] = {
    "grpc.max_send_message_length": _UNBOUNDED,
    "grpc.max_receive_message_length": _UNBOUNDED,
    "grpc.lb_policy_name": "round_robin",  # over a name's addresses, looked up again when a connection ends
    "grpc.initial_reconnect_backoff_ms": 100,
    "grpc.max_reconnect_backoff_ms": 2000,  # default: two minutes, long after a restart
    "grpc.keepalive_time_ms": PING_MS,
    "grpc.keepalive_timeout_ms": UNACKNOWLEDGED_MS,
    "grpc.use_local_subchannel_pool": 1,  # otherwise a new channel reuses the old channel's connection
}


def grpc_options(address: str) -> list[tuple[str, int | str]]:
    """Return the options for a gRPC channel to ``host:port``."""
    options = GRPC_OPTIONS if grpc_proxy(address) else {**GRPC_OPTIONS, "grpc.enable_http_proxy": 0}
    return list(options.items())


class Connection:
    """A tritonclient asyncio client, for one event loop. Once left, it closes after its last call."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._num_calls = 0
        self._is_left = False
        self._silent_since_s: float | None = None  # first call since the last answer
        self._closing: asyncio.Task[None] | None = None

    @contextmanager
    def used(self) -> Iterator[Any]:
        """Context manager in which a call uses the client."""
        self._num_calls += 1
        if self._silent_since_s is None:
            self._silent_since_s = time.monotonic()
        try:
            yield self._client
        finally:
            self._num_calls -= 1
            self._close_if_unused()

    def record_answer(self) -> None:
        """Record that the server has just sent something."""
        self._silent_since_s = None

    @property
    def is_silent(self) -> bool:
        """True if nothing has arrived for SILENT_S since a call began."""
        return self._silent_since_s is not None and time.monotonic() - self._silent_since_s >= SILENT_S

    def leave(self) -> None:
        """Close the connection after its last call; no new call may use it."""
        self._is_left = True
        self._close_if_unused()

    @property
    def is_closed(self) -> bool:
        """True once ``close`` has finished."""
        return self._closing is not None and self._closing.done()

    async def close(self) -> None:
        """Close the connection, even if calls still use it."""
        if self._closing is None:
            self._closing = asyncio.create_task(self._client.close())
        await self._closing

    def _close_if_unused(self) -> None:
        if self._is_left and not self._num_calls and self._closing is None:
            self._closing = asyncio.create_task(self._client.close())


SECURE_SCHEMES = ("grpcs", "https")
AUTHORIZATION = "authorization"

_NAME = re.compile(r"[a-z0-9][a-z0-9_.-]*")
_VALUE = re.compile("[!-~]([ -~]*[!-~])?")  # visible ASCII, with spaces inside


@dataclass(frozen=True)
class Credentials:
    """A client's credentials. Raises ConfigError for unusable values, without showing a key.

    ca_file: CA certificates (PEM) that may vouch for the server; None: the system's
    client_certificate, client_key: files (PEM) that identify this client (mutual TLS); both or neither
    headers: sent with every request, over gRPC as metadata
    api_key: sent with every request as ``Authorization: Bearer KEY``
    """

    ca_file: str | Path | None = None
    client_certificate: str | Path | None = None
    client_key: str | Path | None = None
    headers: Mapping[str, str] = field(default_factory=dict, repr=False)
    api_key: str | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        ConfigError.require_both(self, "client_certificate", "client_key")
        for name, value in self.shown.items():
            if not _NAME.fullmatch(name) or name.endswith("-bin"):  # binary metadata in gRPC
                raise ConfigError.at("headers", "letters, digits and any of ._- as a name", f"{name!r:.100}")
            if not _VALUE.fullmatch(value):
                where = "api_key" if name == AUTHORIZATION and self.api_key is not None else name
                raise ConfigError.at(where, "visible ASCII characters", "others or none")
        if self.uses_tls:
            self.ssl_context  # noqa: B018  # reports an unreadable file now, not at first use

    @property
    def uses_tls(self) -> bool:
        """True if there are certificates, which only TLS uses."""
        return self.ca_file is not None or self.client_certificate is not None

    @property
    def options(self) -> dict[str, Any]:
        """The credentials as keyword arguments for a client."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @property
    def shown(self) -> dict[str, str]:
        """All headers, with names in lower case, as gRPC requires."""
        given = {name.lower(): value for name, value in self.headers.items()}
        return given if self.api_key is None else {**given, AUTHORIZATION: f"Bearer {self.api_key}"}

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "ssl_context"}  # which cannot be pickled

    @cached_property
    def ssl_context(self) -> ssl.SSLContext:
        """The TLS context for connections over HTTP."""
        if self.ca_file is not None:
            check_authorities(self.ca_file, "ca_file")
        context = ssl.create_default_context(cafile=self.ca_file)
        if self.client_certificate is not None:
            assert self.client_key is not None  # checked by __post_init__
            load_certificate(context, self.client_certificate, self.client_key, "client_certificate")
        return context

    def grpc_options(self, scheme: str) -> dict[str, Any]:
        """Return arguments for tritonclient's gRPC clients."""
        if scheme not in SECURE_SCHEMES:
            return {}
        files = {
            "root_certificates": self.ca_file,
            "private_key": self.client_key,
            "certificate_chain": self.client_certificate,
        }
        return {"ssl": True, **files}

    def show_with_each_request(self, client: Any) -> None:
        """Make a tritonclient client send the headers with each request."""
        shown = self.shown
        if not shown:
            return

        def show(request: Any) -> None:
            request.headers = {**request.headers, **shown}

        client.register_plugin(show)


LOOK_S = 1.0
_READ_BYTES = 4096
_HTTP2_FRAME = "\x00\x00"  # a gRPC server's answer to HTTP/1.1 starts with this


_GRPC, _HTTP, _METRICS, _GATEWAY = "its gRPC port", "its HTTP port", "its metrics port", "a gateway's"
_EXPECTED = {"grpc": (_GRPC, "Triton's gRPC port", 8001), "http": (_HTTP, "Triton's HTTP port", 8000)}
WRONG_PORT_ERRORS = (  # errors that a wrong port may cause
    errors.ServerUnavailableError,
    errors.AccessDeniedError,
    errors.InferenceFailedError,
    errors.ModelNotFoundError,  # from a gateway
)


def wrong_port(url: str) -> str | None:
    """Say what is wrong with the port in a server's URL and how to fix it; None: no fault found."""
    scheme, address = split_url(url)
    protocol = scheme.removesuffix("s")
    right, expected, usual = _EXPECTED[protocol]
    if scheme != protocol and _speaks_tls(address):
        return None
    found = _port_at(address)
    if found is None:
        is_secure = scheme == protocol and _speaks_tls(address)
        return f"{url}: expected {expected} without TLS, got TLS: use {protocol}s://{address}" if is_secure else None
    if found is right and scheme == protocol:
        return None
    mend = {
        _GRPC: f"use grpc://{address}",
        _HTTP: f"use http://{address}",
        _METRICS: f"use {scheme}://{in_url(host_of(address))}:{usual}, unless the server was given another",
        _GATEWAY: f"use that of the Triton behind it, by default {usual}",
    }[found]
    with_tls, without = ("", "") if scheme == protocol else (" with TLS", " without")
    return f"{url}: expected {expected}{with_tls}, got {found}{without}: {mend}"


def _port_at(address: str) -> str | None:
    """Return the kind of port, for a message; None: unknown."""
    try:
        if _read(address, "/v2").startswith(b"{"):
            return _HTTP
        metrics = _read(address, "/metrics")
        if b"rfm_gateway_" in metrics or b'"available_gpus"' in _read(address, "/health"):
            return _GATEWAY
        return _METRICS if b"nv_" in metrics else None
    except http.client.BadStatusLine as error:
        return _GRPC if str(error).startswith(_HTTP2_FRAME) else None
    except (OSError, http.client.HTTPException):
        return None


def _speaks_tls(address: str) -> bool:
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        place = host_of(address), int(address.rpartition(":")[2])
        with socket.create_connection(place, LOOK_S) as plain, context.wrap_socket(plain):
            return True
    except ssl.SSLError as error:
        return "ALERT" in (error.reason or "")  # refuses the handshake, but speaks TLS
    except (OSError, UnicodeError):
        return False


def _read(address: str, path: str) -> bytes:
    """Return the beginning of a page; empty if the page is missing."""
    connection = http.client.HTTPConnection(address, timeout=LOOK_S)
    try:
        connection.request("GET", path)
        answer = connection.getresponse()
        return answer.read(_READ_BYTES) if answer.status == http.client.OK else b""
    finally:
        connection.close()
