# SPDX-License-Identifier: MIT
"""Health, model information, metrics and schemas."""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
import requests
import torch

import goldens
from commands import own_regions
from engines import training_run
from gateway_requests import (
    ENCODER_DIMS,
    ENCODERS,
    FIRST,
    SECOND,
    TINY,
    Triton,
    answered,
    ask_json,
    ask_npy,
    expected,
    failure,
    filmed,
    paused,
    preference,
    progress,
)
from gateways import WITHIN_S, Gateway, StandIn, answers, free_port, inside, poll
from rfm_client import AsyncRewardClient, InvalidSampleError, ModelNotFoundError, ServerUnavailableError, Trajectory
from rfm_client.serving import ServerStatus
from rfm_gateway import GatewayConfig
from rfm_gateway.state import STALL_S, ServedParts, TritonState
from servers import Endpoints
from tolerances import TOLERANCE

pytestmark = pytest.mark.triton


def work_done(gateway: Gateway) -> tuple[int, float]:
    (stats,) = requests.get(f"{gateway.url}/gpu_status").json()["gpu_stats"].values()
    return stats["total_requests"], stats["total_processing_time"]


def test_gpu_status_counts_each_request_once(encoders: Gateway, tiny: Gateway, triton: Triton) -> None:
    assert requests.get(f"{encoders.url}/health").json() == {"status": "healthy", "available_gpus": 1, "total_gpus": 1}
    (count, busy_s), of_other = work_done(encoders), work_done(tiny)
    began_s = time.time()
    for _ in range(3):
        answered(ask_json(encoders, [progress(filmed(1, 2))]))
    assert work_done(encoders)[0] == count + 3
    models = ServerStatus.read(encoders.triton_url, metrics_url=triton.endpoints.metrics_url).models
    computed_s = sum(model.busy_ms for model in models if model.name in (ENCODERS, f"{ENCODERS}_encoder")) / 1e3
    assert busy_s < work_done(encoders)[1] == pytest.approx(computed_s, rel=0.01)
    assert work_done(tiny) == of_other
    status = requests.get(f"{encoders.url}/gpu_status").json()
    (stats,) = status.pop("gpu_stats").values()
    assert status == {"total_gpus": 1, "available_gpus": 1, "max_workers": 1, "pool_size": 1}
    assert (stats["device"], stats["status"]) == ("CPU", "ready")
    assert began_s - 1 <= stats["last_used"] <= time.time() + 1  # Triton's clock is coarser
    assert 0 <= stats["utilization"] <= 1
    assert 0 < stats["memory_used_bytes"] < stats["memory_total_bytes"]


def test_scoring_is_healthy_without_triton_s_metrics(triton: Triton) -> None:
    nowhere = f"http://127.0.0.1:{free_port()}/metrics"
    with inside(triton=triton.endpoints.grpc_url, model=TINY, metrics_url=nowhere) as gateway:
        healthy = {"status": "healthy", "available_gpus": None, "total_gpus": None}
        assert gateway.get("/health").json() == healthy
        assert gateway.get("/model_info").json()["num_gpus"] is None
        assert "metrics" in failure(gateway.get("/gpu_status"), 503)


@pytest.mark.slow
def test_a_server_that_hangs_is_unhealthy_with_the_reason(triton: Triton, tiny: Gateway) -> None:
    assert tiny.get("/health").ok
    with paused(triton):  # the earlier state is reported for another second
        poll(lambda: tiny.get("/health").status_code == 503)
        assert "no answer within" in failure(tiny.get("/health"), 503)
    poll(lambda: tiny.get("/health").ok)


@pytest.mark.slow
def test_a_model_that_works_is_healthy_until_it_finishes_nothing_for_long(triton: Triton) -> None:
    """A stand-in is late with its probes, beside the real Triton's statistics."""
    config, now_s = GatewayConfig(triton=triton.endpoints.grpc_url, metrics_url=triton.endpoints.metrics_url), 0.0

    async def ask() -> None:
        nonlocal now_s
        late = StandIn(served=["rfm"])
        async with AsyncRewardClient("", transports=[late], retry=False) as client:
            state = TritonState(client, config, ServedParts(), clock_s=lambda: now_s)
            assert (await state.health()).status == "healthy"
            now_s += STALL_S
            hangs = r"rfm: no answer within 1\.5 s, and nothing finished for 30 s"
            with pytest.raises(ServerUnavailableError, match=hangs):
                await state.health()
            status = await config.status(WITHIN_S)
            waiting = replace(status, models=[replace(model, requests_pending=1) for model in status.models])
            answer = state._gpu_status(waiting)
            assert (answer.available_gpus, answer.total_gpus, answer.gpu_stats["0"].status) == (0, 1, "processing")

    asyncio.run(ask())


def test_model_info_tells_the_checkpoint(tiny: Gateway, tiny_network: torch.nn.Module) -> None:
    info = requests.get(f"{tiny.url}/model_info").json()
    total = sum(parameter.numel() for parameter in tiny_network.parameters())
    architecture = info.pop("model_architecture")
    parts = architecture.pop("architecture_summary")
    assert sum(part["parameters"] for part in parts) == total
    tops = dict((*tiny_network.named_parameters(recurse=False), *tiny_network.named_children()))
    assert {part["name"]: part["type"] for part in parts} == {name: type(top).__name__ for name, top in tops.items()}
    assert {part["name"] for part in parts} == {name.partition(".")[0] for name in tiny_network.state_dict()}
    assert architecture == {
        "model_class": "RewindTransformer",
        "model_module": "rfm.families.rewind.network",
        "total_parameters": total,
        "trainable_parameters": 0,
        "frozen_parameters": total,
        "trainable_percentage": 0.0,
    }
    config = info.pop("experiment_config")["model"]
    assert config.items() >= {"video_feature_dim": 2, "hidden_dim": 8, "causal_mask": True, "progress_bins": 10}.items()
    assert info.pop("model_path").endswith("two_wide")
    assert info == {"model_version": "1", "num_gpus": 1}


def test_model_info_has_the_whole_configuration_of_the_training_run(encoders: Gateway) -> None:
    run = training_run(goldens.config("enc_c1_t1_disc10").checkpoint / "config.yaml")
    assert requests.get(f"{encoders.url}/model_info").json()["experiment_config"] == json.loads(json.dumps(run))


def test_metrics_count_what_was_asked(tiny: Gateway) -> None:
    def counts() -> list[float]:
        return [
            tiny.metric("requests_total", endpoint="/evaluate_batch", code="200"),
            tiny.metric("requests_total", endpoint="/evaluate_batch_npy", code="422"),
            tiny.metric("requests_total", endpoint="other", code="404"),
            tiny.metric("rejections_total", reason="invalid"),
            tiny.metric("samples_total", sample_type="progress"),
            tiny.metric("samples_total", sample_type="preference"),
            tiny.metric("request_duration_seconds_count", endpoint="/evaluate_batch"),
        ]

    before = counts()
    answered(ask_json(tiny, [progress(FIRST), preference(FIRST, SECOND), progress(SECOND)]))
    ask_npy(tiny, [progress(filmed(1, 2))])
    requests.get(f"{tiny.url}/nowhere")
    assert [after - b for after, b in zip(counts(), before, strict=True)] == [1, 1, 1, 1, 2, 1, 1]
    assert tiny.metric("requests_in_flight") == 0


@pytest.mark.slow
def test_rfm_serve_runs_a_gateway_until_a_signal_and_again_if_it_is_killed_or_silent(
    triton: Triton, tmp_path: Path
) -> None:
    repository, endpoints, port = tmp_path / "model_repository", Endpoints.free(), free_port()
    shutil.copytree(triton.repository / TINY, repository / TINY)
    ports = {"http": endpoints.http_port, "grpc": endpoints.grpc_port, "metrics": endpoints.metrics_port}
    options = [word for name, number in (ports | {"gateway": port}).items() for word in (f"--{name}-port", str(number))]
    options += ["--gateway-timeout", "90", "--gateway-max-waiting", "7", "--triton-silent-s", "4"]
    rfm = [str(Path(sys.executable).parent / "rfm"), "serve", "--repository", str(repository), *options]
    log_file = tmp_path / "rfm.log"
    with log_file.open("wb") as log:
        process = subprocess.Popen(rfm, stdout=log, stderr=log)
    try:
        url = f"http://127.0.0.1:{port}"
        poll(lambda: process.poll() is not None or answers(url))
        assert process.poll() is None, log_file.read_text()
        gateway = Gateway(url, TINY, endpoints.grpc_url, process, log_file)
        answer = expected(gateway, [progress(FIRST)])
        assert answered(ask_json(gateway, [progress(FIRST)])) == answer
        assert requests.get(f"{url}/health").json()["status"] == "healthy"
        started = psutil.Process(process.pid).children(recursive=True)
        (own,) = (child for child in started if "rfm_gateway" in child.cmdline())
        assert "--timeout 90.0 --max-body-mib 512" in " ".join(own.cmdline())
        assert "--max-waiting 7" in " ".join(own.cmdline())
        own.kill()
        poll(lambda: not answers(url))
        poll(lambda: answers(url))
        assert answered(ask_json(gateway, [progress(FIRST)])) == answer
        running = psutil.Process(process.pid).children(recursive=True)
        started += running
        (stopped,) = (child for child in running if "rfm_gateway" in child.cmdline())
        stopped.suspend()
        poll(lambda: not stopped.is_running())
        poll(lambda: answers(url))
        assert answered(ask_json(gateway, [progress(FIRST)])) == answer
        started += psutil.Process(process.pid).children(recursive=True)
        process.terminate()
        assert process.wait(WITHIN_S) == 0
    finally:
        process.terminate()
        process.wait(WITHIN_S)
    for why in ("killed by SIGKILL", "no answer for 4 s"):
        assert f"]: gateway is started again: {why}\n" in gateway.log
    assert len(set(started)) >= 5  # Triton, a model process, and three gateways
    assert not [child for child in started if child.is_running()]
    assert not own_regions(process.pid)


def test_the_client_encodes_a_trajectory_once_for_many_questions(encoders: Gateway, tiny: Gateway) -> None:
    given = filmed(1, 4)
    frames = Trajectory(frames=given["frames"], task=given["task"])
    with encoders.client() as client:
        encoded = client.encode(frames)
        assert (encoded.positions.shape, encoded.frames, encoded.task) == ((4, ENCODER_DIMS[0]), None, given["task"])
        assert encoded.text_embedding is not None
        assert encoded.text_embedding.shape == (ENCODER_DIMS[1],)
        first, second = client.progress(frames), client.progress(encoded)
        np.testing.assert_allclose(first.progress, second.progress, rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(first.success, second.success, rtol=0, atol=TOLERANCE)
        with pytest.raises(InvalidSampleError, match="trajectory: expected frames, got video_embeddings"):
            client.encode(encoded)
        with pytest.raises(InvalidSampleError, match=r"expected a model .*, got .*; leave out"):
            client.encode(replace(frames, goal=frames.positions[0]))
    with tiny.client() as client, pytest.raises(ModelNotFoundError, match="rfm_encoder"):
        client.encode(frames)
