# SPDX-License-Identifier: MIT
"""Ports of this machine that nobody listens on, for servers that start soon."""

from __future__ import annotations

import random
import socket
from collections import deque

from rfm.config import DEFAULT_HOST

PORTS = range(20_000, 32_000)  # Linux gives the higher ones to connections that go out, while a server still loads
_REMEMBERED = 256

_given: deque[int] = deque(maxlen=_REMEMBERED)  # of late: their servers may not listen yet


def free_ports(count: int) -> list[int]:
    """Ports of the loopback address that are free now. Raises OSError if there are too few."""
    ports: list[int] = []
    for port in random.SystemRandom().sample(PORTS, len(PORTS)):
        if len(ports) == count:
            break
        if port not in _given and _is_free(port):
            ports.append(port)
    if len(ports) < count:
        raise OSError(f"ports: expected {count} free ones in {PORTS.start}..{PORTS.stop - 1}, got {len(ports)}")
    _given.extend(ports)
    return ports


def _is_free(port: int) -> bool:
    try:
        socket.create_server((DEFAULT_HOST, port)).close()
    except OSError:
        return False
    return True
