# SPDX-License-Identifier: MIT
"""Credentials for a protected server: certificate authorities, client certificate, headers, key."""

from __future__ import annotations

import re
import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from rfm_client.contract.addresses import check_authorities, load_certificate

SECURE_SCHEMES = ("grpcs", "https")
AUTHORIZATION = "authorization"

_NAME = re.compile(r"[a-z0-9][a-z0-9_.-]*")
_VALUE = re.compile("[!-~]([ -~]*[!-~])?")  # visible ASCII; blanks inside


@dataclass(frozen=True)
class Credentials:
    """Credentials of a client. Raises ValueError for what cannot be used, without showing a key.

    ca_file: certificates (PEM) of the authorities that may vouch for the server; None: those of the system
    client_certificate, client_key: files (PEM) by which a server knows this client (mutual TLS); both or none
    headers: shown with each request, in HTTP and as gRPC's metadata
    api_key: shown with each request as ``Authorization: Bearer KEY``
    """

    ca_file: str | Path | None = None
    client_certificate: str | Path | None = None
    client_key: str | Path | None = None
    headers: Mapping[str, str] = field(default_factory=dict, repr=False)
    api_key: str | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if (self.client_certificate is None) != (self.client_key is None):
            raise ValueError("client_certificate, client_key: expected both or none, got one")
        for name, value in self.shown.items():
            if not _NAME.fullmatch(name) or name.endswith("-bin"):  # binary metadata in gRPC
                raise ValueError(f"headers: expected letters, digits and any of ._- as a name, got {name!r:.100}")
            if not _VALUE.fullmatch(value):
                raise ValueError(f"{name}: expected visible ASCII characters, got others or none")
        if self.uses_tls:
            self.ssl_context  # noqa: B018  # a file that cannot be read is an error now, not at first use

    @property
    def uses_tls(self) -> bool:
        """Whether it has something that means nothing without TLS."""
        return self.ca_file is not None or self.client_certificate is not None

    @property
    def options(self) -> dict[str, Any]:
        """The same as keyword arguments of a client."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @property
    def shown(self) -> dict[str, str]:
        """All headers, by name in lower case, as gRPC wants it."""
        given = {name.lower(): value for name, value in self.headers.items()}
        return given if self.api_key is None else {**given, AUTHORIZATION: f"Bearer {self.api_key}"}

    @cached_property
    def ssl_context(self) -> ssl.SSLContext:
        """The TLS context for connections over HTTP."""
        if self.ca_file is not None:
            check_authorities(self.ca_file, "ca_file")
        context = ssl.create_default_context(cafile=self.ca_file)
        if self.client_certificate is not None:
            assert self.client_key is not None  # checked
            load_certificate(context, self.client_certificate, self.client_key, "client_certificate, client_key")
        return context

    def http_options(self, scheme: str) -> dict[str, Any]:
        """Arguments of tritonclient's HTTP clients that do not wait by asyncio."""
        if scheme not in SECURE_SCHEMES:
            return {}
        files = {"ca_certs": self.ca_file}  # None: the system's, not the library's own
        if self.client_certificate is not None:
            files |= {"certfile": self.client_certificate, "keyfile": self.client_key}
        return {"ssl": True, "ssl_options": files}

    def grpc_options(self, scheme: str) -> dict[str, Any]:
        """Arguments of tritonclient's gRPC clients."""
        if scheme not in SECURE_SCHEMES:
            return {}
        files = {
            "root_certificates": self.ca_file,
            "private_key": self.client_key,
            "certificate_chain": self.client_certificate,
        }
        return {"ssl": True, **files}

    def show_with_each_request(self, client: Any) -> None:
        """Has one of tritonclient's clients show the headers."""
        shown = self.shown
        if not shown:
            return

        def show(request: Any) -> None:
            request.headers = {**request.headers, **shown}

        client.register_plugin(show)
