# SPDX-License-Identifier: MIT
"""Proxies that the environment names. Calls to this machine use none.

For other hosts gRPC and urllib decide, each by its own variables. This module repeats their rules for error messages.
The client's HTTP transport uses no proxy.
"""

from __future__ import annotations

import ipaddress
import os
import re
import urllib.request
from typing import Any
from urllib.parse import urlsplit

from rfm_client.contract.addresses import host_of, is_loopback

_OF_GRPC = ("grpc_proxy", "https_proxy", "http_proxy")  # the first that is set counts, even if empty
_NOT_OF_GRPC = ("no_grpc_proxy", "no_proxy")
_CREDENTIALS = re.compile(r"[^/@]*@")


def grpc_proxy(address: str) -> str | None:
    """Return ``VARIABLE=VALUE`` of the proxy that gRPC uses for ``host:port``, without a password; None: no proxy."""
    host = host_of(address)
    name = next((name for name in _OF_GRPC if name in os.environ), None)
    if name is None or not os.environ[name] or is_loopback(host):
        return None
    excepted = next((os.environ[name] for name in _NOT_OF_GRPC if name in os.environ), "")
    if any(_matches(host, entry.strip()) for entry in excepted.split(",") if entry.strip()):
        return None
    return _shown(name, os.environ[name])


def open_url(url: str, timeout_s: float) -> Any:
    """Open the URL and return the response. Raises OSError or HTTPException."""
    scheme, host = urlsplit(url).scheme, urlsplit(url).hostname or ""
    proxies = urllib.request.ProxyHandler({} if is_loopback(host) else None)
    try:  # a new opener, since urlopen keeps the proxies of its first call
        return urllib.request.build_opener(proxies).open(url, timeout=timeout_s)
    except OSError as error:
        proxy = urllib.request.getproxies().get(scheme)
        if not proxy or urllib.request.proxy_bypass(host):
            raise
        raise OSError(f"{error} (through {_shown(f'{scheme}_proxy', proxy)})") from error


def _matches(host: str, entry: str) -> bool:
    """True if an entry of no_proxy names the host by gRPC's rules: the end of a name, or a network (CIDR)."""
    if host.lower().endswith(entry.lower()):
        return True
    try:
        return "/" in entry and ipaddress.ip_address(host) in ipaddress.ip_network(entry, strict=False)
    except ValueError:
        return False


def _shown(name: str, value: str) -> str:
    """``VARIABLE=VALUE`` for an error message, without the password."""
    return f"{name}={_CREDENTIALS.sub('***@', value)}"
