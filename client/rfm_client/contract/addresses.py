# SPDX-License-Identifier: MIT
"""Checks of a server's URL, address and certificate files (PEM)."""

from __future__ import annotations

import ipaddress
import re
import ssl
from pathlib import Path

from rfm_client.contract.errors import InvalidValueError
from rfm_client.contract.settings import ConfigError

MAX_PORT = 65535

_URL = re.compile(
    r"((?P<scheme>grpcs?|https?)://|dns:///)(?P<address>(\[[\da-fA-F:.]+(%\w+)?\]|[^][:/@\s]+):(?P<port>\d{1,5}))/?"
)
_PORTS = {"grpc": 8001, "http": 8000}
_OPENSSL_REASONS = {
    "NO_CERTIFICATE_OR_CRL_FOUND": "a file without certificate",
    "KEY_VALUES_MISMATCH": "the key of another certificate",
    "BAD_DECRYPT": "an encrypted key",
    "BAD_PASSWORD_READ": "an encrypted key",
}


def split_url(url: str) -> tuple[str, str]:
    """Return the scheme (``grpc``, ``http``, ``grpcs`` or ``https``) and ``host:port`` of a URL. Raises ValueError.

    ``dns:///host:port``, gRPC's own form, means ``grpc://host:port``. An IPv6 address needs brackets.
    """
    scheme, _, address = url.rstrip("/").partition("://")
    for host, port in (address.rpartition(":")[::2], (address, str(_PORTS.get(scheme.removesuffix("s"), 8000)))):
        if _is_ipv6(host):
            raise InvalidValueError.at("url", f"brackets around an IPv6 address, {scheme}://[{host}]:{port}", repr(url))
    match = _URL.fullmatch(url)
    if match is None or int(match["port"]) > MAX_PORT:
        raise InvalidValueError.at("url", "grpc://host:port or http://host:port, or grpcs:// or https://", repr(url))
    return match["scheme"] or "grpc", match["address"]


def host_of(address: str) -> str:
    """Return the host of ``host:port``, an IPv6 address without its brackets."""
    return address.rpartition(":")[0].strip("[]")


def is_loopback(host: str) -> bool:
    """True if the host is a loopback address or the name ``localhost``. Resolves no names."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _is_ipv6(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).version == 6
    except ValueError:
        return False


def check_certificate(certificate: str | Path, key: str | Path, where: str) -> None:
    """Raise ConfigError of the setting ``where`` unless a server can serve with this certificate and key (PEM)."""
    load_certificate(ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), certificate, key, where)


def check_authorities(file: str | Path, where: str) -> None:
    """Raise ConfigError of the setting ``where`` unless the file holds certificates of authorities (PEM)."""
    try:
        ssl.create_default_context(cafile=file)
    except OSError as error:
        raise ConfigError.at(where, f"certificates (PEM) at {file}", _reason(error)) from None


def load_certificate(context: ssl.SSLContext, certificate: str | Path, key: str | Path, where: str) -> None:
    """Load a certificate and its key (PEM) into the context. Raises ConfigError of the setting ``where``."""
    try:
        context.load_cert_chain(certificate, key, password="")  # else OpenSSL prompts for a password
    except OSError as error:
        expected = f"a certificate and its key (PEM, unencrypted) at {certificate} and {key}"
        raise ConfigError.at(where, expected, _reason(error)) from None


def _reason(error: OSError) -> str:
    """What is wrong with a PEM file, in place of OpenSSL's words."""
    if not isinstance(error, ssl.SSLError):
        return error.strerror or str(error)
    return _OPENSSL_REASONS.get(error.reason or "", "a file in another format")
