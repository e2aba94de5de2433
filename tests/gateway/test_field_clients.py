# SPDX-License-Identifier: MIT
"""Public Robometer clients change their URL and nothing else: their recorded requests, and the original server's answers."""

from __future__ import annotations

import http.client
import io
import json
import re
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import urlsplit

import numpy as np
import pytest

import goldens
from gateway_requests import FRAME_STEPS, Json, answered, ask_json, expected
from gateways import Gateway, inside, running
from paths import ROOT
from servers import Served
from tolerances import TOLERANCE

pytestmark = [pytest.mark.triton, pytest.mark.slow]

Rows: TypeAlias = list[list[float]]

FOLDER = Path(__file__).parent / "field_clients"
EXPECTED: Json = json.loads((FOLDER / "expect.json").read_text())
CHECKPOINT: str = EXPECTED["checkpoint_of_original_server"]
PROBABILITY = goldens.config(CHECKPOINT).tolerances[1]
WITHIN_S = 120  # as most of the clients wait
QWEN3 = {"name": "model", "type": "Qwen3VLModel"}  # as a client of the original server looks for it
HOST = re.compile(rb"^Host:[^\r]*", re.MULTILINE)


@dataclass(frozen=True)
class FieldRequest:
    """A recorded request."""

    file: Path

    def __str__(self) -> str:
        return self.file.stem

    @property
    def expected(self) -> Json:
        return dict(EXPECTED["requests"][self.file.name])

    @property
    def original(self) -> Rows:
        """Scores of the original server, each sample sent alone."""
        told = self.expected["original_server"]
        return [*told["progress"], *told["success"], told["preference"]]

    def sent(self, url: str) -> tuple[int, Any]:
        """Send the bytes, with only the server's address changed. Return status and content of the answer."""
        server = urlsplit(url)
        head, blank, body = self.file.read_bytes().partition(b"\r\n\r\n")
        head = HOST.sub(b"Host: " + server.netloc.encode(), head, count=1)
        with socket.create_connection((server.hostname, server.port), WITHIN_S) as connection:
            connection.sendall(head + blank + body)
            response = http.client.HTTPResponse(connection)
            response.begin()
            assert response.headers["content-type"] == "application/json"
            return response.status, json.loads(response.read(), parse_constant=pytest.fail)

    def samples(self) -> list[Json]:
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


REQUESTS = {file.stem: FieldRequest(file) for file in sorted(FOLDER.glob("*.http"))}
EVALUATIONS = [request for request in REQUESTS.values() if "original_server" in request.expected]
REPORTS = [request for request in REQUESTS.values() if "original_server" not in request.expected]


def rows(answer: Json) -> Rows:
    """Return an answer's numbers as the clients read them: progress of each sample, success of each, all preferences."""
    progress, success, preference = (
        answer.get(f"outputs_{kind}") or {} for kind in ("progress", "success", "preference")
    )
    told = [*progress.get("progress_pred", []), *success.get("success_probs", [])]  # without samples null or missing
    return [*told, preference.get("prediction_probs", [])]


def difference(one: Rows, other: Rows) -> float:
    """Return the largest difference between numbers of one place."""
    pairs = [np.subtract(*pair) for pair in zip(one, other, strict=True)]
    return float(np.abs(np.concatenate(pairs)).max())


@pytest.fixture(scope="module")
def gateway(served: Served, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    served.has(CHECKPOINT)
    with running(served.endpoints, tmp_path_factory.mktemp("gateway"), CHECKPOINT) as started:
        yield started


@pytest.mark.parametrize("request_", EVALUATIONS, ids=str)
def test_a_recorded_request_gets_the_original_servers_numbers_and_those_of_the_python_client(
    gateway: Gateway, request_: FieldRequest
) -> None:
    told = request_.expected
    status, answer = request_.sent(gateway.url)
    assert status == 200, answer
    for path in told["keys"]:
        outputs, key = path.split(".")
        assert isinstance(answer[outputs][key], list)
    found = rows(answer)
    assert [len(row) for row in found] == [*told["lengths"], *told["lengths"], told["preferences"]]
    assert difference(found, request_.original) <= PROBABILITY
    steps = FRAME_STEPS if told["use_frame_steps"] else 0
    assert difference(found, rows(expected(gateway, request_.samples(), frame_steps=steps))) <= TOLERANCE


@pytest.mark.parametrize("request_", REPORTS, ids=str)
def test_the_reports_that_clients_read_have_their_keys(gateway: Gateway, request_: FieldRequest) -> None:
    status, answer = request_.sent(gateway.url)
    assert status == 200, answer
    assert set(request_.expected["keys"]) <= answer.keys()
    if "model_architecture" in answer:
        assert answer["model_architecture"]["model_module"] == "rfm.families.robometer.network"
        assert answer["model_architecture"]["architecture_summary"][1].items() >= QWEN3.items()


def test_a_request_that_does_not_say_is_scored_by_prefixes_where_the_gateway_has_that_default(gateway: Gateway) -> None:
    silent = REQUESTS["rynnvalue_pirl.default"]
    samples = silent.samples()
    steps = rows(expected(gateway, samples, frame_steps=FRAME_STEPS))
    assert difference(steps, silent.original) > 0.1  # as one pass
    with inside(triton=gateway.triton_url, model=CHECKPOINT, use_frame_steps=True) as changed:
        for fields in ({}, {"use_frame_steps": None}):
            assert difference(rows(answered(ask_json(changed, samples, **fields))), steps) <= TOLERANCE
        whole = rows(answered(ask_json(changed, samples, use_frame_steps=False)))
        assert difference(whole, silent.original) <= PROBABILITY


def test_the_guide_names_each_project_whose_requests_are_sent_and_the_longest_that_it_waits() -> None:
    guide = (ROOT / "docs" / "guides" / "robometer_clients.md").read_text()
    told = {row.split(" | ")[0].removeprefix("| "): row for row in guide.splitlines() if row.startswith("| ")}
    for client in EXPECTED["clients"].values():
        if client["project"] != "unknown":
            assert f"{client['timeout_s']} s" in told[client["project"]]
