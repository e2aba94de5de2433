# SPDX-License-Identifier: MIT
"""Bodies, waiting and callers beyond what the gateway takes."""

from __future__ import annotations

import asyncio
import http.client
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import requests

import rfm_export
from gateway_requests import (
    FIRST,
    MULTIPART,
    NAMED,
    SECOND,
    TINY,
    TINY_CONFIG,
    Json,
    Triton,
    answered,
    ask_json,
    begun,
    dumped,
    expected,
    failure,
    numbers,
    paused,
    preference,
    progress,
)
from gateways import Gateway, metric_at, poll, running
from one_model import BriefServer
from rfm.config import ExportConfig
from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints
from rfm.rewind.checkpoint import RewindCheckpoint
from rfm.rewind.network import RewindTransformer
from rfm.triton_model.batch_model import GIVEN_UP_S
from rfm_client import AsyncRewardClient, ServerUnavailableError
from rfm_gateway.state import STALL_S, TritonState

pytestmark = pytest.mark.triton


HALVES = {
    "/evaluate_batch": ({"Content-Length": "100"}, b'{"samples": ['),
    "/evaluate_batch_npy": ({"Content-Length": "100", "Content-Type": MULTIPART}, NAMED),
}


@pytest.mark.parametrize(("path", "half"), HALVES.items(), ids=HALVES)
def test_a_body_that_does_not_come_is_a_408(strict: Gateway, path: str, half: Any) -> None:
    connection = begun(strict, *half, path=path)
    response = connection.getresponse()
    assert (response.status, response.getheader("Connection")) == (408, "close")
    assert json.loads(response.read())["detail"] == "body: expected all of it in time, got a part"
    connection.close()


def test_more_requests_than_allowed_are_a_503_and_health_is_not_one(strict: Gateway) -> None:
    connection = begun(strict, *HALVES["/evaluate_batch"])
    poll(lambda: strict.metric("requests_in_flight") == 1)
    response = ask_json(strict, [progress(FIRST)])
    assert failure(response, 503) == "expected at most 1 evaluations at a time, got more"
    assert response.headers["Retry-After"] == "1"
    assert requests.get(f"{strict.url}/health").ok
    connection.close()
    poll(lambda: strict.metric("requests_in_flight") == 0)
    assert answered(ask_json(strict, [progress(FIRST)]))


def test_a_caller_who_leaves_is_no_failure_of_the_gateway(tiny: Gateway) -> None:
    for path, half in HALVES.items():
        begun(tiny, *half, path=path).close()
        poll(lambda path=path: tiny.metric("requests_total", endpoint=path, code="400") >= 1)  # type: ignore[misc]


def post_body(gateway: Gateway, sample: Json) -> http.client.HTTPConnection:
    """A connection on which a whole request has been sent."""
    body = dumped([sample]).encode()
    connection: http.client.HTTPConnection = begun(gateway, {"Content-Length": str(len(body))}, body)
    return connection


def test_three_hundred_callers_at_once_are_all_answered(triton: Triton, tiny: Gateway) -> None:
    """Upstream's clients do not ask again: more than are scored at a time wait."""
    answer = expected(tiny, [progress(FIRST)])
    with paused(triton):
        callers = [post_body(tiny, progress(FIRST)) for _ in range(300)]
        poll(lambda: tiny.metric("requests_in_flight") + tiny.metric("requests_waiting") == 300)
        assert tiny.metric("requests_waiting") == 300 - 256
    for caller in callers:
        response = caller.getresponse()
        assert (response.status, json.loads(response.read())) == (200, numbers(answer))
        caller.close()


def test_a_caller_who_waits_too_long_is_a_503(triton: Triton, tmp_path: Path) -> None:
    with running(triton.endpoints, tmp_path, TINY, "--timeout", "1", "--max-in-flight", "1") as gateway:
        answered(ask_json(gateway, [progress(FIRST)]))
        with paused(triton):
            first = post_body(gateway, progress(FIRST))
            poll(lambda: gateway.metric("requests_in_flight") == 1)
            second, third = (post_body(gateway, progress(FIRST)) for _ in range(2))
            codes = []
            for caller in (first, second, third):
                codes.append(caller.getresponse().status)
                caller.close()
        assert set(codes) == {503, 504}


CLOSED_GATE = """

_load = TritonPythonModel.load


def load(self, version, device, settings):
    _load(self, version, device, settings)
    score = self.engine.predictor.score

    def gated(rows, batch):
        import time

        while Path({gate!r}).exists():
            Path({gate!r} + ".at_work").touch()
            time.sleep(0.01)
        return score(rows, batch)

    self.engine.predictor.score = gated


TritonPythonModel.load = load
"""


@dataclass(frozen=True)
class Gated:
    """A gateway before a Triton whose model works on its batch for as long as the file ``gate`` is there."""

    gateway: Gateway
    endpoints: Endpoints
    gate: Path

    @contextmanager
    def working(self) -> Iterator[http.client.HTTPConnection]:
        """Within it, the model works on the request of the connection."""
        self.gate.touch()
        try:
            caller = post_body(self.gateway, progress(FIRST))
            poll(self.gate.with_name(f"{self.gate.name}.at_work").exists)
            yield caller
        finally:
            self.gate.unlink()
            self.gate.with_name(f"{self.gate.name}.at_work").unlink(missing_ok=True)

    def metric(self, name: str, **labels: str) -> float:
        return metric_at(self.endpoints.metrics_url, name, **labels)


@pytest.fixture(scope="module")
def gated(tmp_path_factory: pytest.TempPathFactory, tiny_network: RewindTransformer) -> Iterator[Gated]:
    folder = tmp_path_factory.mktemp("gated")
    repository, checkpoint, gate = folder / "model_repository", folder / "two_wide", folder / "gate"
    RewindCheckpoint(TINY_CONFIG, tiny_network.state_dict()).save(checkpoint)
    rfm_export.export(checkpoint, repository, ExportConfig(name=TINY, num_gpus=0, torch_threads=1))
    model = repository / TINY / "1" / "model.py"
    model.write_text(model.read_text() + CLOSED_GATE.format(gate=str(gate)))
    with (
        (folder / "tritonserver.log").open("wb") as log,
        BriefServer(repository, Endpoints.free(), find_installation(), log=log) as server,
        running(server.endpoints, folder) as gateway,
    ):
        yield Gated(gateway, server.endpoints, gate)


@pytest.mark.slow
def test_callers_who_hang_up_cost_no_forward(gated: Gated) -> None:
    """Preferences are asked last: once one is counted, a moment later, so is whatever was scored before it."""

    def scored(sample_type: str) -> float:
        return gated.metric("rfm_samples_total", outcome="scored", sample_type=sample_type)

    samples = [progress(FIRST), preference(FIRST, SECOND)]
    answers = [expected(gated.gateway, [sample]) for sample in samples]
    poll(lambda: scored("preference") == 1)
    progress_before = scored("progress")
    with gated.working() as first:
        leaving = [post_body(gated.gateway, progress(FIRST)) for _ in range(12)]
        poll(lambda: gated.metric("nv_inference_pending_request_count") == len(leaving))
        for caller in leaving:
            caller.close()
        poll(lambda: gated.gateway.metric("requests_total", code="499") == len(leaving))
        last = post_body(gated.gateway, samples[1])  # behind what has told Triton that they left
        poll(lambda: gated.metric("nv_inference_pending_request_count") >= 1)
        time.sleep(2 * GIVEN_UP_S)  # behind a batch that took less, the model does not ask who has left
    for caller, answer in zip((first, last), answers, strict=True):
        assert json.loads(caller.getresponse().read()) == numbers(answer)
        caller.close()
    poll(lambda: scored("preference") == 2)
    assert scored("progress") == progress_before + 1
    assert gated.gateway.metric("requests_in_flight") == 0


@pytest.mark.slow
def test_health_is_told_while_a_model_works(gated: Gated) -> None:
    with gated.working() as first:
        second = post_body(gated.gateway, progress(FIRST))
        poll(lambda: gated.metric("nv_inference_pending_request_count") == 1)
        health = {"status": "healthy", "available_gpus": 0, "total_gpus": 1}
        assert answered(requests.get(f"{gated.gateway.url}/health")) == health
        now_s = [0.0]

        async def ask() -> None:
            async with AsyncRewardClient(gated.endpoints.grpc_url) as client:
                urls = gated.endpoints.grpc_url, gated.endpoints.metrics_url
                state = TritonState(client, *urls, TINY, clock_s=lambda: now_s[0])
                assert (await state.health()).status == "healthy"
                now_s[0] += STALL_S
                await state.health()

        hangs = r"rfm: no answer within 1\.5 s, and nothing finished for 30 s"
        with pytest.raises(ServerUnavailableError, match=hangs):
            asyncio.run(ask())
    for caller in (first, second):
        assert caller.getresponse().status == 200
        caller.close()


def test_no_score_in_time_is_a_504(triton: Triton, strict: Gateway) -> None:
    assert answered(ask_json(strict, [progress(FIRST)]))
    with paused(triton):
        assert failure(ask_json(strict, [progress(FIRST)]), 504) == "Triton: no answer within 1 s"
    assert answered(ask_json(strict, [progress(FIRST)]))
