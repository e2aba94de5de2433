# SPDX-License-Identifier: MIT
"""Limits of the gateway: bodies, waiting requests, callers."""

from __future__ import annotations

import asyncio
import json
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
    Triton,
    answered,
    ask_json,
    begun,
    expected,
    failure,
    numbers,
    paused,
    post_body,
    preference,
    progress,
)
from gateways import Gateway, metric_at, poll, running
from rfm.config import ExportConfig
from rfm.rewind.checkpoint import RewindCheckpoint
from rfm.rewind.network import RewindTransformer
from rfm_client import AsyncRewardClient, ServerUnavailableError
from rfm_gateway import GatewayConfig
from rfm_gateway.state import STALL_S, TritonState
from servers import start_triton

pytestmark = pytest.mark.triton


HALVES = {
    "/evaluate_batch": ({"Content-Length": "100"}, b'{"samples": ['),
    "/evaluate_batch_npy": ({"Content-Length": "100", "Content-Type": MULTIPART}, NAMED),
}


@pytest.mark.parametrize(("path", "half"), HALVES.items(), ids=HALVES)
def test_a_body_that_does_not_come_is_a_408_and_lets_others_pass(strict: Gateway, path: str, half: Any) -> None:
    connection = begun(strict, *half, path=path)
    assert answered(ask_json(strict, [progress(FIRST)]))
    response = connection.getresponse()
    assert (response.status, response.getheader("Connection")) == (408, "close")
    assert json.loads(response.read())["detail"] == "body: expected all of it in time, got a part"
    connection.close()


def test_more_requests_than_allowed_are_a_503_and_health_is_not_one(triton: Triton, strict: Gateway) -> None:
    with paused(triton):
        connection = post_body(strict, progress(FIRST))
        poll(lambda: strict.metric("requests_in_flight") == 1)
        response = ask_json(strict, [progress(FIRST)])
        assert failure(response, 503) == "expected at most 1 evaluations at a time, got more"
        assert response.headers["Retry-After"] == "1"
        assert "evaluations" not in failure(strict.get("/health"), 503)
    assert connection.getresponse().status == 504
    connection.close()
    poll(lambda: strict.metric("requests_in_flight") == 0)
    assert answered(ask_json(strict, [progress(FIRST)]))


def test_a_caller_who_leaves_is_no_failure_of_the_gateway(tiny: Gateway) -> None:
    for path, half in HALVES.items():
        begun(tiny, *half, path=path).close()
        poll(lambda path=path: tiny.metric("requests_total", endpoint=path, code="400") >= 1)  # type: ignore[misc]


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

    def gated(rows, batch, execution):
        import time

        while Path({gate!r}).exists():
            Path({gate!r} + ".at_work").touch()
            time.sleep(0.01)
        return score(rows, batch, execution)

    self.engine.predictor.score = gated


TritonPythonModel.load = load
"""


@pytest.mark.slow
def test_while_a_model_works_health_is_told_and_callers_who_hang_up_cost_no_forward(
    tiny_network: RewindTransformer, tmp_path: Path
) -> None:
    """The preference is asked last: once it is counted, so is whatever was scored before it."""
    repository, checkpoint, gate = tmp_path / "model_repository", tmp_path / "two_wide", tmp_path / "gate"
    RewindCheckpoint(TINY_CONFIG, tiny_network.state_dict()).save(checkpoint)
    rfm_export.export(checkpoint, repository, ExportConfig(name=TINY, num_gpus=0, torch_threads=1))
    model = repository / TINY / "1" / "model.py"
    model.write_text(model.read_text() + CLOSED_GATE.format(gate=str(gate)))
    samples, now_s = [progress(FIRST), preference(FIRST, SECOND)], [0.0]

    async def ask_health() -> None:
        async with AsyncRewardClient(endpoints.grpc_url) as client:
            config = GatewayConfig(triton=endpoints.grpc_url, metrics_url=endpoints.metrics_url)
            state = TritonState(client, config, clock_s=lambda: now_s[0])
            assert (await state.health()).status == "healthy"
            now_s[0] += STALL_S
            await state.health()

    def metric(name: str, **labels: str) -> float:
        return metric_at(endpoints.metrics_url, name, **labels)

    def scored(sample_type: str) -> float:
        return metric("rfm_samples_total", outcome="scored", sample_type=sample_type)

    with start_triton(repository) as server, running(server.endpoints, tmp_path) as gateway:
        endpoints = server.endpoints
        answers = [expected(gateway, [sample]) for sample in samples]
        poll(lambda: scored("preference") == 1)
        progress_before = scored("progress")
        gate.touch()
        first = post_body(gateway, samples[0])
        poll(gate.with_name("gate.at_work").exists)
        leaving = [post_body(gateway, samples[0]) for _ in range(12)]
        poll(lambda: metric("nv_inference_pending_request_count") == len(leaving))
        for caller in leaving:
            caller.close()
        poll(lambda: gateway.metric("requests_total", code="499") == len(leaving))
        last = post_body(gateway, samples[1])
        poll(lambda: metric("nv_inference_pending_request_count") >= 1)
        health = {"status": "healthy", "available_gpus": 0, "total_gpus": 1}
        assert answered(requests.get(f"{gateway.url}/health")) == health
        hangs = r"rfm: no answer within 1\.5 s, and nothing finished for 30 s"
        with pytest.raises(ServerUnavailableError, match=hangs):
            asyncio.run(ask_health())
        gate.unlink()
        for caller, answer in zip((first, last), answers, strict=True):
            assert json.loads(caller.getresponse().read()) == numbers(answer)
            caller.close()
        poll(lambda: scored("preference") == 2)
        assert scored("progress") == progress_before + 1
        assert gateway.metric("requests_in_flight") == 0


def test_no_score_in_time_is_a_504(triton: Triton, strict: Gateway) -> None:
    assert answered(ask_json(strict, [progress(FIRST)]))
    with paused(triton):
        assert failure(ask_json(strict, [progress(FIRST)]), 504) == "Triton: no answer within 1 s"
    assert answered(ask_json(strict, [progress(FIRST)]))
