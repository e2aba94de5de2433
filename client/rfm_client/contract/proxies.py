# SPDX-License-Identifier: MIT
"""Which calls go through a proxy that the environment names. Those to this machine go through none.

To other hosts gRPC and urllib decide, each by its own variables. What is here only says what they decide, for errors.
The client's HTTP transport takes no proxy.
"""

from __future__ import annotations

import ipaddress
import os
import re
import urllib.request
from typing import Any
from urllib.parse import urlsplit

from rfm_client.contract.addresses import host_of, is_loopback

_OF_GRPC = ("grpc_proxy", "https_proxy", "http_proxy")  # the first that is set counts, also if it is empty
_NOT_OF_GRPC = ("no_grpc_proxy", "no_proxy")
_CREDENTIALS = re.compile(r"[^/@]*@")


def grpc_proxy(address: str) -> str | None:
    """The variable and the value by which gRPC goes to ``host:port`` through a proxy; None: it goes there itself."""
    host = host_of(address)
    name = next((name for name in _OF_GRPC if name in os.environ), None)
    if name is None or not os.environ[name] or is_loopback(host):
        return None
    excepted = next((os.environ[name] for name in _NOT_OF_GRPC if name in os.environ), "")
    if any(_matches(host, entry.strip()) for entry in excepted.split(",") if entry.strip()):
        return None
    return _shown(name, os.environ[name])


def open_url(url: str, timeout_s: float) -> Any:
    """The open response of an HTTP server. Raises OSError, HTTPException."""
    scheme, host = urlsplit(url).scheme, urlsplit(url).hostname or ""
    proxies = urllib.request.ProxyHandler({} if is_loopback(host) else None)
    try:  # with an opener of its own: that of urlopen keeps the proxies of its first call
        return urllib.request.build_opener(proxies).open(url, timeout=timeout_s)
    except OSError as error:
        proxy = urllib.request.getproxies().get(scheme)
        if not proxy or urllib.request.proxy_bypass(host):
            raise
        raise OSError(f"{error} (through {_shown(f'{scheme}_proxy', proxy)})") from error


def _matches(host: str, entry: str) -> bool:
    """Whether an entry of no_proxy names the host, as gRPC reads it: the end of a name, or a network (CIDR)."""
    if host.lower().endswith(entry.lower()):
        return True
    try:
        return "/" in entry and ipaddress.ip_address(host) in ipaddress.ip_network(entry, strict=False)
    except ValueError:
        return False


def _shown(name: str, value: str) -> str:
    """The variable as an error shows it, without a password."""
    return f"{name}={_CREDENTIALS.sub('***@', value)}"
