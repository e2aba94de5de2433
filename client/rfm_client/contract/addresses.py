# SPDX-License-Identifier: MIT
"""Server addresses: URLs, listen addresses, certificate files (PEM), and proxies set in the environment.

Calls to this machine use no proxy. For other hosts gRPC and urllib decide, each from its own variables. This module
repeats their rules for error messages. The client's HTTP transport uses no proxy.
"""

from __future__ import annotations

import errno
import ipaddress
import os
import re
import socket
import ssl
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from rfm_client.contract.errors import InvalidValueError
from rfm_client.contract.settings import ConfigError

MAX_PORT = 65535

_URL = re.compile(
    r"(?P<scheme>grpcs?|https?)://(?P<address>(\[[\da-fA-F:.]+(%\w+)?\]|[^][:/@\s]+):(?P<port>\d{1,5}))/?"
)
_OPENSSL_REASONS = {
    "NO_CERTIFICATE_OR_CRL_FOUND": "a file without certificate",
    "KEY_VALUES_MISMATCH": "the key of another certificate",
    "BAD_DECRYPT": "an encrypted key",
    "BAD_PASSWORD_READ": "an encrypted key",
}


def split_url(url: str) -> tuple[str, str]:
    """Return a URL's scheme (``grpc``, ``http``, ``grpcs`` or ``https``) and ``host:port``. Raises ValueError.

    An IPv6 address needs brackets.
    """
    match = _URL.fullmatch(url)
    if match is None or int(match["port"]) > MAX_PORT:
        expected = "grpc://host:port or http://host:port, or grpcs:// or https:// (brackets around an IPv6 address)"
        raise InvalidValueError.at("url", expected, repr(url))
    return match["scheme"], match["address"]


def host_of(address: str) -> str:
    """Return the host in ``host:port``, with an IPv6 address stripped of brackets."""
    return address.rpartition(":")[0].strip("[]")


def is_loopback(host: str) -> bool:
    """True if the host is a loopback address or the name ``localhost``. Resolves no names."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def check_certificate(certificate: str | Path, key: str | Path, where: str) -> None:
    """Raise ConfigError for the setting ``where`` unless a server can use this certificate and key (PEM)."""
    load_certificate(ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), certificate, key, where)


def check_authorities(file: str | Path, where: str) -> None:
    """Raise ConfigError for the setting ``where`` unless the file holds CA certificates (PEM)."""
    try:
        ssl.create_default_context(cafile=file)
    except OSError as error:
        raise ConfigError.at(where, f"certificates (PEM) at {file}", _reason(error)) from None


def load_certificate(context: ssl.SSLContext, certificate: str | Path, key: str | Path, where: str) -> None:
    """Load a certificate and its key (PEM) into the context. Raises ConfigError for the setting ``where``."""
    try:
        context.load_cert_chain(certificate, key, password="")  # otherwise OpenSSL prompts for a password
    except OSError as error:
        expected = f"a certificate and its key (PEM, unencrypted) at {certificate} and {key}"
        raise ConfigError.at(where, expected, _reason(error)) from None


def _reason(error: OSError) -> str:
    """Say what is wrong with a PEM file, instead of quoting OpenSSL."""
    if not isinstance(error, ssl.SSLError):
        return error.strerror or str(error)
    return _OPENSSL_REASONS.get(error.reason or "", "a file in another format")


def in_url(host: str) -> str:
    """Return the host as written in a URL: IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def from_here(host: str) -> str:
    """Return the address at which this machine reaches a server that listens on ``host``."""
    return {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)


@dataclass(frozen=True)
class ListenAddress:
    """Host and port that a server listens on."""

    host: str
    port: int

    @property
    def is_loopback(self) -> bool:
        """True if only this machine can reach the server."""
        return is_loopback(self.host)

    def url(self, scheme: str) -> str:
        """Return the URL at which this machine reaches the server."""
        return f"{scheme}://{in_url(from_here(self.host))}:{self.port}"

    def check_free(self, where: str, *, port_option: str, host_option: str = "--host") -> None:
        """Raise InvalidValueError unless a server can listen here. The message names the option to change."""
        try:
            family = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)[0][0]
            socket.create_server((self.host, self.port), family=family).close()
        except (OSError, OverflowError) as error:
            number = getattr(error, "errno", None) or 0
            reason = os.strerror(number) if number > 0 else str(error)
            is_of_port = number in (errno.EADDRINUSE, errno.EACCES)
            remedy = f"{port_option} names another port" if is_of_port else f"{host_option} names another address"
            expected = f"a free port of this machine at {in_url(self.host)}:{self.port}"
            raise InvalidValueError.at(where, expected, reason, remedy) from None


_PROXY_VARIABLES = ("grpc_proxy", "https_proxy", "http_proxy")  # the first one set counts, even if empty
_NO_PROXY_VARIABLES = ("no_grpc_proxy", "no_proxy")
_CREDENTIALS = re.compile(r"[^/@]*@")


def grpc_proxy(url: str) -> str | None:
    """Return ``VARIABLE=VALUE`` for the proxy that gRPC uses for the server, without a password; None: no proxy."""
    scheme, _, address = url.rstrip("/").partition("://")
    name, value = next(((name, os.environ[name]) for name in _PROXY_VARIABLES if name in os.environ), ("", ""))
    if not value or not scheme.startswith("grpc") or is_loopback(host_of(address)):
        return None
    excepted = next((os.environ[name] for name in _NO_PROXY_VARIABLES if name in os.environ), "")
    if any(_covers(entry.strip(), host_of(address)) for entry in excepted.split(",") if entry.strip()):
        return None
    return _shown(name, value)


def with_proxy(url: str) -> str:
    """Return the server's URL for an error message, with gRPC's proxy if there is one."""
    proxy = grpc_proxy(url)
    return f"{url} through {proxy}" if proxy else url


def open_url(url: str, timeout_s: float) -> Any:
    """Open the URL and return the response. Raises OSError or HTTPException, without the words of urllib."""
    scheme, host = urlsplit(url).scheme, urlsplit(url).hostname or ""
    proxies = urllib.request.ProxyHandler({} if is_loopback(host) else None)
    try:  # a new opener, because urlopen keeps the proxies from its first call
        return urllib.request.build_opener(proxies).open(url, timeout=timeout_s)
    except OSError as error:
        reason = getattr(error, "reason", error)  # of a URLError; of its kind HTTPError a text
        text = " ".join(map(str, (getattr(error, "code", ""), getattr(reason, "strerror", None) or reason))).strip()
        proxy = urllib.request.getproxies().get(scheme)
        if proxy and not (is_loopback(host) or urllib.request.proxy_bypass(host)):
            text += f" (through {_shown(f'{scheme}_proxy', proxy)})"
        raise OSError(text) from error


def _covers(entry: str, host: str) -> bool:
    """True if a no_proxy entry covers the host by gRPC's rules: a name's ending, or a network (CIDR)."""
    if host.lower().endswith(entry.lower()):
        return True
    try:
        return "/" in entry and ipaddress.ip_address(host) in ipaddress.ip_network(entry, strict=False)
    except ValueError:
        return False


def _shown(name: str, value: str) -> str:
    """``VARIABLE=VALUE`` for an error message, without the password."""
    return f"{name}={_CREDENTIALS.sub('***@', value)}"
