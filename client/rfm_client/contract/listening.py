# SPDX-License-Identifier: MIT
"""Addresses that a server listens at: how a URL writes them, and whether one is free."""

from __future__ import annotations

import errno
import os
import socket


def in_url(host: str) -> str:
    """The address as a URL writes it: IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def from_here(host: str) -> str:
    """The address at which this machine itself reaches a server that listens at ``host``."""
    return {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)


def check_free(host: str, port: int, where: str, *, port_option: str, host_option: str = "--host") -> None:
    """Raises ValueError (``where: ...``) unless a server could listen there; it ends in the option to change."""
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        socket.create_server((host, port), family=family).close()
    except (OSError, OverflowError) as error:
        number = getattr(error, "errno", None) or 0
        reason = os.strerror(number) if number > 0 else str(error)
        is_of_port = number in (errno.EADDRINUSE, errno.EACCES)
        remedy = f"{port_option} names another port" if is_of_port else f"{host_option} names another address"
        expected = f"a free port of this machine at {in_url(host)}:{port}"
        raise ValueError(f"{where}: expected {expected}, got: {reason}; {remedy}") from None
