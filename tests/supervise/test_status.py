# SPDX-License-Identifier: MIT
"""The status port of ``rfm serve``."""

from __future__ import annotations

import socket
from contextlib import closing

import httpx
import pytest

from rfm.launch.process import Endpoints
from rfm.supervise import status
from rfm.supervise.status import NO_REASON, Status, StatusServer

HOST = "127.0.0.1"


def test_a_silent_connection_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status, "REQUEST_S", 0.5)
    port = Endpoints.free().http_port
    with closing(StatusServer(HOST, port, Status())), socket.create_connection((HOST, port)) as silent:
        silent.send(b"G")
        assert silent.recv(1) == b""
        assert httpx.get(f"http://{HOST}:{port}/live").status_code == 200


def told(about: Status) -> dict[str, float]:
    """By metric and model."""
    lines = [line for line in about.metrics().decode().splitlines() if line.startswith("rfm_serve_ready")]
    return {name.replace('{model="', " ").removesuffix('"}'): float(value) for name, value in map(str.split, lines)}


def test_nothing_is_told_of_what_there_was() -> None:
    about = Status()
    about.record({"a": NO_REASON, "b": NO_REASON, "a_frames": NO_REASON})
    about.record({"a": NO_REASON, "a_frames": NO_REASON})
    assert told(about) == {"rfm_serve_ready a": 1, "rfm_serve_ready a_frames": 1}
    about.record_down("tritonserver is started again")
    assert told(about) == {"rfm_serve_ready a": 0, "rfm_serve_ready a_frames": 0}
    text = about.metrics().decode()
    assert 'rfm_serve_not_ready{model="a",reason="tritonserver is started again"} 1.0' in text
    about.record({"a": "it is loaded", "a_frames": NO_REASON})
    text = about.metrics().decode()
    assert [line for line in text.splitlines() if line.startswith("rfm_serve_not_ready{")] == [
        'rfm_serve_not_ready{model="a",reason="it is loaded"} 1.0'
    ]
    about.record_down("tritonserver is started again")
    assert about.ready[1]["models"]["a_frames"] == {"ready": False, "reason": "tritonserver is started again"}
