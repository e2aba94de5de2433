# SPDX-License-Identifier: MIT
"""Diagnosis of a wrong port: gRPC, HTTP, metrics or a gateway."""

from __future__ import annotations

import http.client
import socket
import ssl

from rfm_client.contract import errors
from rfm_client.contract.addresses import host_of, in_url, split_url

LOOK_S = 1.0
_READ_BYTES = 4096
_HTTP2_FRAME = "\x00\x00"  # start of a gRPC server's answer to HTTP/1.1


_GRPC, _HTTP, _METRICS, _GATEWAY = "its gRPC port", "its HTTP port", "its metrics port", "a gateway's"
_EXPECTED = {"grpc": (_GRPC, "Triton's gRPC port", 8001), "http": (_HTTP, "Triton's HTTP port", 8000)}
OF_A_PORT = (  # errors that a wrong port may cause
    errors.ServerUnavailableError,
    errors.AccessDeniedError,
    errors.InferenceFailedError,
    errors.ModelNotFoundError,  # a gateway
)


def wrong_port(url: str) -> str | None:
    """Return the fault of the port in a server's URL and its remedy; None: no fault found."""
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
    """Kind of port, for a message; None: unknown."""
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
        return "ALERT" in (error.reason or "")  # refuses the handshake, but in TLS
    except (OSError, UnicodeError):
        return False


def _read(address: str, path: str) -> bytes:
    """The beginning of a page; empty if the page is missing."""
    connection = http.client.HTTPConnection(address, timeout=LOOK_S)
    try:
        connection.request("GET", path)
        answer = connection.getresponse()
        return answer.read(_READ_BYTES) if answer.status == http.client.OK else b""
    finally:
        connection.close()
