# SPDX-License-Identifier: MIT
"""The status port of ``rfm serve``: what it tells, and that nobody can hold its threads."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing

import httpx
import pytest

from rfm.launch.process import Endpoints
from rfm.supervise import status
from rfm.supervise.status import MOST_CONNECTIONS, NO_REASON, Status, StatusServer
from rfm_serve import wait_for

HOST = "127.0.0.1"


@pytest.fixture
def port() -> Iterator[int]:
    port = Endpoints.free().http_port
    with closing(StatusServer(HOST, port, Status())):
        yield port


def is_cut(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        return connection.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionResetError:
        return True


def test_a_request_that_takes_its_time_is_cut_short(monkeypatch: pytest.MonkeyPatch, port: int) -> None:
    """A byte now and then does not help it."""
    monkeypatch.setattr(status, "REQUEST_S", 0.5)
    with socket.create_connection((HOST, port)) as slow:

        def gives_up() -> bool:
            try:
                slow.send(b"G")
            except (BrokenPipeError, ConnectionResetError):
                return True
            return is_cut(slow)

        assert wait_for(gives_up, 5.0) >= 0.4
    wait_for(lambda: not any("process_request_thread" in thread.name for thread in threading.enumerate()))


def test_many_slow_connections_keep_nobody_out(monkeypatch: pytest.MonkeyPatch, port: int) -> None:
    monkeypatch.setattr(status, "REQUEST_S", 600.0)
    with ExitStack() as stack:
        slow = [stack.enter_context(socket.create_connection((HOST, port))) for _ in range(3 * MOST_CONNECTIONS)]
        assert httpx.get(f"http://{HOST}:{port}/live").status_code == 200
        wait_for(lambda: sum(not is_cut(connection) for connection in slow) <= MOST_CONNECTIONS)
        # a handler whose connection has just been cut may still be on its way out
        wait_for(lambda: sum("process_request_thread" in t.name for t in threading.enumerate()) <= MOST_CONNECTIONS)


def told(about: Status) -> dict[str, float]:
    """By metric and model."""
    lines = [
        line
        for line in about.metrics().decode().splitlines()
        if line.startswith(("rfm_serve_ready", "rfm_serve_canary_ok"))
    ]
    return {name.replace('{model="', " ").removesuffix('"}'): float(value) for name, value in map(str.split, lines)}


def test_nothing_is_told_of_what_there_was(port: int) -> None:
    about = Status()
    about.record({"a": NO_REASON, "b": NO_REASON, "a_frames": NO_REASON})
    for model in ("a", "b"):
        about.record_probe(model, is_ok=True)
    about.record({"a": NO_REASON, "a_frames": NO_REASON})
    assert told(about) == {"rfm_serve_ready a": 1, "rfm_serve_ready a_frames": 1, "rfm_serve_canary_ok a": 1}
    about.record_down("tritonserver is started again")
    assert told(about) == {"rfm_serve_ready a": 0, "rfm_serve_ready a_frames": 0, "rfm_serve_canary_ok a": 0}
    text = about.metrics().decode()
    assert 'rfm_serve_not_ready{model="a",reason="tritonserver is started again"} 1.0' in text
    about.record({"a": "it is loaded", "a_frames": NO_REASON})
    text = about.metrics().decode()
    assert [line for line in text.splitlines() if line.startswith("rfm_serve_not_ready{")] == [
        'rfm_serve_not_ready{model="a",reason="it is loaded"} 1.0'
    ]
    about.record_down("tritonserver is started again")
    assert about.ready[1]["models"]["a_frames"] == {"ready": False, "reason": "tritonserver is started again"}
