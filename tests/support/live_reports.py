# SPDX-License-Identifier: MIT
"""Reports of running episodes as clients write them, and a server that keeps reports."""

from __future__ import annotations

import base64
import io
import json
import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from typing import Any

import numpy as np
from PIL import Image

from rfm_client import UInt8Array
from servers import web_server

Json = dict[str, Any]


def picture(seed: int = 0, size: tuple[int, int] = (48, 64)) -> UInt8Array:
    """Return a frame with a single colour, which survives JPEG."""
    return np.full((*size, 3), np.random.default_rng(seed).integers(0, 256, 3), np.uint8)


def identity(number: int) -> str:
    return f"{number:032x}"


def step(number: int, progress: float | None = 0.25, success: float | None = 0.5, **fields: Any) -> Json:
    return {"step": number, "progress": progress, "success": success, "succeeded": False, "ms": 12.5, **fields}


def episode(number: int = 1, *steps: Json, **fields: Any) -> Json:
    about = {"id": identity(number), "name": "run", "env": 0, "task": "stack the cups", "threshold": 0.5}
    return {**about, "ended": False, "steps": list(steps), **fields}


def report(*episodes: Json, **frames: str) -> Json:
    return {"episodes": list(episodes), "frames": frames}


def jpeg(frame: UInt8Array) -> str:
    file = io.BytesIO()
    Image.fromarray(frame).save(file, "JPEG", quality=85, subsampling=0)
    return base64.b64encode(file.getvalue()).decode()


class Taker:
    """The received reports. status: of the answers"""

    def __init__(self) -> None:
        self.bodies: list[Json] = []
        self.headers: list[dict[str, str]] = []
        self.status = 204
        self.url = ""

    def steps(self) -> list[Json]:
        return [each for body in self.bodies for told in body["episodes"] for each in told["steps"]]


@contextmanager
def taking(context: ssl.SSLContext | None = None) -> Iterator[Taker]:
    """Run a server for reports that answers with ``status``. context: for HTTPS"""
    taker = Taker()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            taker.headers.append({name.lower(): value for name, value in self.headers.items()})
            if taker.status == 204:
                taker.bodies.append({**json.loads(body), "path": self.path})
            self.send_response(taker.status)
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            """Log nothing."""

    with web_server(Handler, context) as taker.url:
        yield taker
