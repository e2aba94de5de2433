# SPDX-License-Identifier: MIT
"""Ports for servers that start soon: free, given once, and not those of connections that go out."""

from __future__ import annotations

import socket
from contextlib import ExitStack

import pytest

from rfm.launch import ports
from rfm.launch.ports import PORTS, free_ports


def test_ports_are_free_and_given_once() -> None:
    given = [port for _ in range(20) for port in free_ports(3)]
    assert len(set(given)) == 60
    assert set(given) <= set(PORTS)
    with ExitStack() as stack:
        for port in given:
            stack.enter_context(socket.create_server(("127.0.0.1", port)))


def test_a_port_that_is_taken_is_not_given(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = free_ports(2)
    monkeypatch.setattr(ports, "PORTS", range(min(first, second), max(first, second) + 1, abs(first - second)))
    monkeypatch.setattr(ports, "_given", ports.deque())
    with socket.create_server(("127.0.0.1", first)):
        assert free_ports(1) == [second]
        with pytest.raises(OSError, match="ports: expected 1 free ones in"):
            free_ports(1)
