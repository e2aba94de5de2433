# SPDX-License-Identifier: MIT
"""Recorded requests of public Robometer clients, and the answers of the original server."""

from __future__ import annotations

import http.client
import io
import json
import re
import socket
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from paths import ROOT

FOLDER = ROOT / "tests" / "gateway" / "field_clients"
EXPECTED: dict[str, Any] = json.loads((FOLDER / "expect.json").read_text())
CLIENTS: dict[str, dict[str, Any]] = EXPECTED["clients"]
CHECKPOINT: str = EXPECTED["checkpoint_of_original_server"]
WITHIN_S = 120  # as most of the clients wait
_HOST = re.compile(rb"^Host:[^\r]*", re.MULTILINE)


@dataclass(frozen=True)
class Scores:
    """The numbers of an answer: progress and success of each progress sample, and each preference."""

    progress: list[list[float]]
    success: list[list[float]]
    preference: list[float]

    @classmethod
    def of(cls, answer: dict[str, Any]) -> Scores:
        """Read them as the clients do; a type without samples may be null or missing."""
        progress, success, preference = (answer.get(f"outputs_{kind}") or {} for kind in cls.__annotations__)
        return cls(
            progress.get("progress_pred", []), success.get("success_probs", []), preference.get("prediction_probs", [])
        )

    @classmethod
    def joined(cls, parts: Sequence[Scores]) -> Scores:
        """Return the scores of all samples from those of each."""
        return cls(*(list(chain.from_iterable(getattr(each, kind) for each in parts)) for kind in cls.__annotations__))

    @property
    def flat(self) -> list[float]:
        return [value for row in (*self.progress, *self.success, self.preference) for value in row]

    def difference(self, other: Scores) -> float:
        """Return the largest difference; infinity for rows of other lengths."""
        if self.lengths != other.lengths:
            return float("inf")
        return float(np.max(np.abs(np.subtract(self.flat, other.flat)), initial=0.0))

    @property
    def lengths(self) -> tuple[list[int], list[int], int]:
        return [len(row) for row in self.progress], [len(row) for row in self.success], len(self.preference)


@dataclass(frozen=True)
class FieldRequest:
    """A recorded request."""

    file: Path

    def __str__(self) -> str:
        return self.file.stem

    @property
    def expected(self) -> dict[str, Any]:
        return dict(EXPECTED["requests"][self.file.name])

    @property
    def original(self) -> Scores:
        """Scores of the original server, each sample sent alone."""
        return Scores(**self.expected["original_server"])

    @property
    def is_evaluation(self) -> bool:
        return "original_server" in self.expected

    def sent(self, url: str) -> tuple[int, dict[str, str], bytes]:
        """Send the bytes, with only the server's address changed. Return status, headers and body of the answer."""
        server = urlsplit(url)
        head, blank, body = self.file.read_bytes().partition(b"\r\n\r\n")
        head = _HOST.sub(b"Host: " + server.netloc.encode(), head, count=1)
        with socket.create_connection((server.hostname, server.port), WITHIN_S) as connection:
            connection.sendall(head + blank + body)
            response = http.client.HTTPResponse(connection)
            response.begin()
            return response.status, {name.lower(): value for name, value in response.getheaders()}, response.read()

    def samples(self) -> list[dict[str, Any]]:
        """Return the samples with their arrays."""
        parts = dict(self._parts())
        names = sorted((name for name in parts if re.fullmatch(r"sample_\d+", name)), key=lambda name: int(name[7:]))
        samples = [json.loads(parts[name]) for name in names]
        for trajectory in (value for sample in samples for value in sample.values() if isinstance(value, dict)):
            trajectory["frames"] = np.load(io.BytesIO(parts[trajectory["frames"]["__numpy_file__"]]))
        return samples

    def _parts(self) -> Iterator[tuple[str, bytes]]:
        head, _, body = self.file.read_bytes().partition(b"\r\n\r\n")
        (boundary,) = re.findall(rb'boundary="?([^"\r;]+)', head)
        for part in body.split(b"--" + boundary)[1:-1]:
            fields, _, content = part.partition(b"\r\n\r\n")
            (name,) = re.findall(rb'[ ;]name="([^"]+)"', fields)
            yield name.decode(), content.removesuffix(b"\r\n")


REQUESTS = [FieldRequest(file) for file in sorted(FOLDER.glob("*.http"))]
EVALUATIONS = [request for request in REQUESTS if request.is_evaluation]
REPORTS = [request for request in REQUESTS if not request.is_evaluation]
