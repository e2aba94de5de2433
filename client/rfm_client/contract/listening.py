# SPDX-License-Identifier: MIT
"""Listen addresses of a server: their form in a URL, and a check for a free port."""

from __future__ import annotations

import errno
import os
import socket
from dataclasses import dataclass

from rfm_client.contract.addresses import is_loopback


def in_url(host: str) -> str:
    """Return the host as a URL writes it: IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def from_here(host: str) -> str:
    """Return the address by which this machine reaches a server that listens at ``host``."""
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
        """Return the URL by which this machine reaches the server."""
        return f"{scheme}://{in_url(from_here(self.host))}:{self.port}"

    def check_free(self, where: str, *, port_option: str, host_option: str = "--host") -> None:
        """Raise ValueError (``where: ...``) unless a server can listen here. The message names the option to change."""
        try:
            family = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)[0][0]
            socket.create_server((self.host, self.port), family=family).close()
        except (OSError, OverflowError) as error:
            number = getattr(error, "errno", None) or 0
            reason = os.strerror(number) if number > 0 else str(error)
            is_of_port = number in (errno.EADDRINUSE, errno.EACCES)
            remedy = f"{port_option} names another port" if is_of_port else f"{host_option} names another address"
            expected = f"a free port of this machine at {in_url(self.host)}:{self.port}"
            raise ValueError(f"{where}: expected {expected}, got: {reason}; {remedy}") from None
