# SPDX-License-Identifier: MIT
"""The id of a request: in errors, in Triton's log, in traces, and through the gateway."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from http.server import BaseHTTPRequestHandler
from typing import Any

import pytest
import requests
import tritonclient.http
from tritonclient.utils import np_to_triton_dtype

import goldens
import rfm_export
from engines import serve_config
from gateways import answers
from paths import ROOT
from repositories import FAILING, FAILING_STEPS
from rfm_client import (
    DeadlineExceededError,
    InferenceFailedError,
    InvalidSampleError,
    ProgressSample,
    RewardClient,
    ServerUnavailableError,
)
from rfm_client.contract.wire import encode_samples
from servers import Endpoints, Quiet, Serving, serving, wait_for, web_server
from trajectories import random_trajectory

CONFIG = goldens.config("c1_t1_disc10")
NOBODY = "grpc://127.0.0.1:9"
PATIENCE_S = 30.0
RANDOM_ID = re.compile(r"[0-9a-f]{16}")


@dataclass(frozen=True)
class Running:
    served: Serving
    traces: list[bytes]
    gateway: str  # URL

    def client(self, protocol: str = "grpc") -> RewardClient:
        endpoints = self.served.endpoints
        return RewardClient(endpoints.grpc_url if protocol == "grpc" else endpoints.http_url, retry=False)

    def said_of(self, request_id: str, process: str = "rfm/1") -> list[tuple[str, str]]:
        """Return level and message of each line about a request. A process may write it after the answer."""
        head = (
            rf"^\d{{4}}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{{3}}Z ([A-Z]+) {process}\[\d+\] request={re.escape(request_id)}: "
        )

        def found() -> list[tuple[str, str]]:
            return re.findall(f"{head}(.*)$", self.served.log.read_text(), re.MULTILINE)

        wait_for(found, PATIENCE_S)
        return found()


class Collector(Quiet, BaseHTTPRequestHandler):
    """Takes traces, as an OpenTelemetry collector does."""

    def __init__(self, traces: list[bytes], *connection: Any) -> None:
        self.traces = traces
        super().__init__(*connection)

    def do_POST(self) -> None:
        self.traces.append(self.rfile.read(int(self.headers["Content-Length"])))
        self.send_response(200)
        self.end_headers()


def documented_options(traces_url: str) -> list[str]:
    """Return the options for tritonserver from the documents, with this collector and for every request."""
    text = " ".join(
        re.findall(r"--trace-config=[^\s`]+", (ROOT / "docs" / "reference" / "logs_and_metrics.md").read_text())
    )
    text, count = re.subn(r"=opentelemetry,url=\S+", f"=opentelemetry,url={traces_url}", text)
    text, others = re.subn(r"=rate=\S+", "=rate=1", text)
    assert (count, others) == (1, 1)
    return text.split()


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """An ``rfm serve`` and a gateway beside."""
    folder = tmp_path_factory.mktemp("logs")
    repository = folder / "repository"
    rfm_export.export(CONFIG.checkpoint, repository, serve_config(CONFIG))
    model = repository / "rfm" / "1" / "model.py"
    model.write_text(model.read_text() + FAILING)
    traces: list[bytes] = []
    with web_server(partial(Collector, traces)) as collector, pytest.MonkeyPatch.context() as environment:
        environment.setitem(os.environ, "RFM_LOG_LEVEL", "debug")
        options = documented_options(f"{collector}/v1/traces")
        port = Endpoints.free().http_port
        with serving(repository, f"--gateway-port={port}", "--", *options) as served:
            served.wait_ready()
            gateway = f"http://127.0.0.1:{port}"
            wait_for(lambda: answers(gateway))
            yield Running(served, traces, gateway)


GOOD = ProgressSample(random_trajectory(0, 3))
TOO_LONG = ProgressSample(random_trajectory(0, 17))
BREAKING = ProgressSample(random_trajectory(0, 3), frame_steps=FAILING_STEPS)


@pytest.mark.triton
def test_the_error_of_a_refused_sample_names_its_request_and_is_logged_at_debug(
    running: Running, protocol: str
) -> None:
    with running.client(protocol) as client, pytest.raises(InvalidSampleError, match="at most 16") as raised:
        client.evaluate([TOO_LONG])
    request_id = str(raised.value.request_id)
    assert re.fullmatch(f"{RANDOM_ID.pattern}-1", request_id)
    assert str(raised.value) == f"{raised.value.message} (request {request_id})"
    assert raised.value.remedy.startswith("score some of them")  # by the client
    reason = f"{raised.value.where}: expected {raised.value.expected}, got {raised.value.got}"
    assert running.said_of(request_id) == [("DEBUG", f"refused (progress): {reason}")]


@pytest.mark.triton
def test_a_failed_sample_is_logged_as_an_error_with_its_traceback(running: Running) -> None:
    name = "a.fault/of-the-model"
    with running.client() as client, pytest.raises(InferenceFailedError) as raised:
        client.evaluate([BREAKING], request_id=name)
    assert str(raised.value) == f"scoring failed; the server's log has the reason (request {name}-1)"
    said = running.said_of(f"{name}-1")
    assert {level for level, _ in said} == {"ERROR"}
    assert said[0][1] == "failed (progress): scoring failed; the server's log has the reason"
    assert said[1][1] == "Traceback (most recent call last):"
    assert said[-1][1] == "ZeroDivisionError: a fault of the model's"


@pytest.mark.triton
def test_the_requests_of_a_call_begin_alike(running: Running) -> None:
    """A refused batch of three, then each sample alone."""
    with running.client() as client:
        outcomes = client.evaluate([GOOD, TOO_LONG, GOOD], return_errors=True, request_id="call")
        assert isinstance(outcomes[1], InvalidSampleError)
        assert outcomes[1].request_id in [f"call-{number}" for number in (2, 3, 4)]
        with pytest.raises(InvalidSampleError, match=r"^samples\[1\]\.num_frames: .* \(request call-[234]\)$"):
            client.evaluate([GOOD, TOO_LONG, GOOD], request_id="call")


@pytest.mark.parametrize("name", ["", "two words", "new\nline", "] forged", "x" * 65, "\u00e4"])
def test_a_name_that_a_log_could_not_hold_is_refused(name: str) -> None:
    with RewardClient(NOBODY) as client, pytest.raises(ValueError, match="request_id: expected 1 to 64 letters"):
        client.progress(random_trajectory(0, 2), request_id=name)


@pytest.mark.triton
def test_a_request_without_an_answer_is_named_too(running: Running) -> None:
    lost = pytest.raises(ServerUnavailableError, match=r"\(request lost-1\)$")
    with RewardClient(NOBODY, retry=False) as client, lost:
        client.progress(random_trajectory(0, 2), request_id="lost")
    with running.client() as client, pytest.raises(DeadlineExceededError) as raised:
        client.evaluate([ProgressSample(random_trajectory(0, 500), frame_steps=16)], timeout_s=0.05, request_id="late")
    assert raised.value.request_id in ("late-1", None)  # None: the time was up before it was sent


@pytest.mark.triton
def test_traces_name_the_request_and_continue_a_caller_s(running: Running) -> None:
    trace_id = "4bf92f3577b34da6a3ce929d0e0e4736"
    inputs = []
    for name, array in encode_samples([GOOD]).items():
        inputs.append(tritonclient.http.InferInput(name, array.shape, np_to_triton_dtype(array.dtype)))
        inputs[-1].set_data_from_numpy(array)
    headers = {"traceparent": f"00-{trace_id}-00f067aa0ba902b7-01"}
    with tritonclient.http.InferenceServerClient(running.served.endpoints.http_url.removeprefix("http://")) as client:
        client.infer("rfm", inputs, headers=headers, request_id="traced")
    for told in (b'"triton.request_id","value":{"stringValue":"traced"}', trace_id.encode()):
        wait_for(lambda told=told: any(told in trace for trace in running.traces), PATIENCE_S)


def asked(running: Running, request_id: str, **content: Any) -> requests.Response:
    headers = {"X-Request-ID": request_id}
    return requests.post(f"{running.gateway}/evaluate_batch", headers=headers, timeout=PATIENCE_S, **content)


@pytest.mark.triton
def test_the_gateway_passes_the_caller_s_id_on_and_returns_it(running: Running) -> None:
    def body(sample: ProgressSample) -> dict[str, Any]:
        embeddings = {
            name: getattr(sample.trajectory, name).tolist() for name in ("video_embeddings", "text_embedding")
        }
        return {"samples": [{"sample_type": "progress", "trajectory": embeddings}]}

    refused = asked(running, "of-the-caller", json=body(TOO_LONG))
    assert (refused.status_code, refused.headers["X-Request-ID"]) == (422, "of-the-caller")
    assert "(request" not in refused.text
    assert running.said_of("of-the-caller-1")[0][1].startswith("refused (progress): num_frames: expected at most 16")
    scored = asked(running, "of-the-caller", json=body(GOOD))
    assert (scored.status_code, scored.headers["X-Request-ID"]) == (200, "of-the-caller")
    answer = asked(running, "odd", data=b"no JSON")  # which it refuses itself
    assert (answer.status_code, answer.headers["X-Request-ID"]) == (422, "odd")


@pytest.mark.triton
def test_the_gateway_makes_an_id_where_there_is_none_to_pass_on(running: Running) -> None:
    for given in ("", "two words", "x" * 65, "a\tb", "rfm-probe"):
        answer = requests.get(f"{running.gateway}/model_info", headers={"X-Request-ID": given}, timeout=PATIENCE_S)
        assert RANDOM_ID.fullmatch(answer.headers["X-Request-ID"]), given
