# SPDX-License-Identifier: MIT
"""Options and credentials of a connection.

A firewall or a lost machine drops packets without an error. Over gRPC all calls share one connection, so every call
would run into its deadline. Two rules open a new connection instead:

- A request whose bytes the peer does not acknowledge within UNACKNOWLEDGED_MS ends the connection, and is sent again.
  The kernel enforces this (TCP_USER_TIMEOUT, which gRPC sets where keepalive is on).
- If a call runs into its deadline and nothing has arrived for SILENT_S, later calls get a new connection. This covers
  peers that acknowledge bytes but do not answer, such as a proxy that hangs.

Pings alone do not suffice. Triton closes a connection after more than two pings less than 300 s apart during which it
sends nothing, as in a long call. So gRPC pings at most every PING_MS, and only during a call.
"""

from __future__ import annotations

import re
import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from rfm_client.contract.addresses import check_authorities, host_of, is_loopback, load_certificate
from rfm_client.contract.errors import InvalidValueError
from rfm_client.contract.settings import ConfigError
from rfm_client.contract.triton import AUTHORIZATION, bearer_headers

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
    options = {**GRPC_OPTIONS, "grpc.enable_http_proxy": int(not is_loopback(host_of(address)))}
    return list(options.items())


SECURE_SCHEMES = ("grpcs", "https")

_NAME = re.compile(r"[a-z0-9][a-z0-9_.-]*")
_VALUE = re.compile("[!-~]([ -~]*[!-~])?")  # visible ASCII, with spaces inside


@dataclass(frozen=True)
class Credentials:
    """A client's credentials. Raises ConfigError for unusable values, without showing a key.

    ca_file: CA certificates (PEM) that may vouch for the server; None: the system's
    client_certificate, client_key: files (PEM) that identify this client (mutual TLS); both or neither
    headers: sent with every request, over gRPC as metadata
    api_key: sent with every request as ``Authorization: Bearer KEY``; over gRPC also as metadata for Triton
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
                where = "api_key" if name.endswith(AUTHORIZATION) and self.api_key is not None else name
                raise ConfigError.at(where, "visible ASCII characters", "others or none")
        if self.uses_tls:
            self.ssl_context  # noqa: B018  # reports an unreadable file now, not at first use

    @property
    def uses_tls(self) -> bool:
        """True if there are certificates, which only TLS uses."""
        return self.ca_file is not None or self.client_certificate is not None

    def check_url(self, url: str) -> None:
        """Raise InvalidValueError for a URL without TLS beside certificates, which the environment may name."""
        if self.uses_tls and url.partition("://")[0] not in SECURE_SCHEMES:
            remedy = "without TLS leave out ca_file (RFM_CA_FILE) and client_certificate (RFM_CLIENT_CERTIFICATE)"
            raise InvalidValueError.at("url", "grpcs:// or https:// with certificates", url, remedy)

    @property
    def options(self) -> dict[str, Any]:
        """The credentials as keyword arguments for a client."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @property
    def shown(self) -> dict[str, str]:
        """All headers, with names in lower case, as gRPC requires."""
        given = {name.lower(): value for name, value in self.headers.items()}
        return given if self.api_key is None else {**given, **bearer_headers(self.api_key)}

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
