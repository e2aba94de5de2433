# SPDX-License-Identifier: MIT
"""A host name that several gRPC servers share, as a headless Service of Kubernetes: each address is a server.

gRPC by itself keeps to one address of a name, or with round_robin looks the name up again only when a connection ends,
so that servers which are added later would stay idle. And a retry must know which server has been tried.
"""

from __future__ import annotations

import asyncio
import ipaddress
import socket
from collections.abc import Iterable, Mapping
from typing import Protocol

from rfm_client.contract.addresses import split_url
from rfm_client.transport.calls import Transport

REFRESH_S = 30.0  # between two times that a name is looked up

_WHOLE_NAME = ""  # the key of a transport that leaves the addresses to gRPC


class Connect(Protocol):
    """A function that makes the transport to one server."""

    def __call__(self, url: str, *, named: str | None = None) -> Transport:
        """The transport to ``url``, as ``calls.connect`` makes it."""


class Name:
    """The servers behind one URL. While its name has one address, gRPC looks after it."""

    def __init__(self, url: str, connect: Connect) -> None:
        self.url = url
        self._scheme, self._named = split_url(url)
        self._connect = connect
        self._transports = {_WHOLE_NAME: connect(url)}

    @property
    def transports(self) -> Mapping[str, Transport]:
        """The transports by address, as the name was last looked up."""
        return self._transports

    async def look_up(self) -> None:
        """Raises OSError or UnicodeError when the name cannot be looked up; then all stays as it was."""
        host, _, port = self._named.rpartition(":")
        addresses = await _addresses(host, int(port))
        if len(addresses) > 1 or _WHOLE_NAME not in self._transports:
            self._transports = {address: self._at(address) for address in addresses}

    def _at(self, address: str) -> Transport:
        known = self._transports.get(address)
        return known or self._connect(f"{self._scheme}://{address}", named=self._named)


def is_name(url: str) -> bool:
    """Whether the URL may stand for several gRPC servers: it has a host name, which is not this machine's own."""
    scheme, address = split_url(url)
    host = address.rpartition(":")[0].strip("[]")
    return scheme.startswith("grpc") and host != "localhost" and not _is_address(host)


def of_urls(urls: Iterable[str], connect: Connect) -> tuple[list[Transport], list[Name]]:
    """A transport for each URL that is one server, and the names that may be several. Raises ValueError."""
    fixed: list[Transport] = []
    names: list[Name] = []
    for url in urls:
        if is_name(url):
            names.append(Name(url, connect))
        else:
            fixed.append(connect(url))
    return fixed, names


async def _addresses(host: str, port: int) -> list[str]:
    """The addresses of a host, ``address:port`` each.

    All are of one family, so that a server with an IPv4 and an IPv6 address is one server.
    """
    found = await asyncio.get_running_loop().getaddrinfo(host, port, type=socket.SOCK_STREAM)
    family = found[0][0]
    hosts = sorted({str(place[0]) for kind, _, _, _, place in found if kind is family})
    return [f"[{host}]:{port}" if family is socket.AF_INET6 else f"{host}:{port}" for host in hosts]


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
