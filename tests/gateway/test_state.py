# SPDX-License-Identifier: MIT
"""Health, model information, metrics and schemas."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from typing import Any

import pytest
import requests
import torch

import goldens
from engines import training_run
from gateway_requests import (
    ENCODERS,
    FIRST,
    SECOND,
    TINY,
    Triton,
    answered,
    ask_json,
    ask_npy,
    failure,
    filmed,
    paused,
    preference,
    progress,
)
from gateways import Gateway, free_port, inside
from rfm_client.serving import ServerStatus
from servers import wait_for

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
    # Triton measures devices for the first time after two seconds.
    wait_for(lambda: requests.get(f"{encoders.url}/gpu_status").json()["gpu_stats"]["0"]["memory_used_bytes"])
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
        wait_for(lambda: tiny.get("/health").status_code == 503)
        assert "no answer within" in failure(tiny.get("/health"), 503)
    wait_for(lambda: tiny.get("/health").ok)


def test_the_devices_are_busy_while_a_request_waits(triton: Triton, monkeypatch: pytest.MonkeyPatch) -> None:
    read = ServerStatus.read_async

    async def waiting(*arguments: Any, **options: Any) -> ServerStatus:
        status = await read(*arguments, **options)
        return replace(status, models=[replace(model, requests_pending=1) for model in status.models])

    monkeypatch.setattr(ServerStatus, "read_async", waiting)
    ends = triton.endpoints
    with inside(triton=ends.grpc_url, model=TINY, metrics_url=ends.metrics_url) as gateway:
        status = gateway.get("/gpu_status").json()
    told = (status["available_gpus"], status["total_gpus"], status["gpu_stats"]["0"]["status"])
    assert told == (0, 1, "processing")


def test_model_info_describes_the_checkpoint_and_its_training_run(
    tiny: Gateway, encoders: Gateway, tiny_network: torch.nn.Module
) -> None:
    info = requests.get(f"{tiny.url}/model_info").json()
    total = sum(parameter.numel() for parameter in tiny_network.parameters())
    architecture = info.pop("model_architecture")
    parts = architecture.pop("architecture_summary")
    assert sum(part["parameters"] for part in parts) == total
    tops = dict((*tiny_network.named_parameters(recurse=False), *tiny_network.named_children()))
    assert {part["name"]: part["type"] for part in parts} == {name: type(top).__name__ for name, top in tops.items()}
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
    run = training_run(goldens.config("enc_c1_t1_disc10").checkpoint / "config.yaml")
    assert requests.get(f"{encoders.url}/model_info").json()["experiment_config"] == json.loads(json.dumps(run))


def test_metrics_count_requests_and_samples(tiny: Gateway) -> None:
    def counts() -> list[float]:
        return [
            tiny.metric("requests_total", endpoint="/evaluate_batch", code="200"),
            tiny.metric("requests_total", endpoint="/evaluate_batch_npy", code="422"),
            tiny.metric("requests_total", endpoint="other", code="404"),
            tiny.metric("samples_total", sample_type="progress"),
            tiny.metric("samples_total", sample_type="preference"),
            tiny.metric("request_duration_seconds_count", endpoint="/evaluate_batch"),
        ]

    before = counts()
    answered(ask_json(tiny, [progress(FIRST), preference(FIRST, SECOND), progress(SECOND)]))
    ask_npy(tiny, [progress(filmed(1, 2))])
    requests.get(f"{tiny.url}/nowhere")
    requests.head(f"{tiny.url}/nowhere")  # a probe
    assert [after - b for after, b in zip(counts(), before, strict=True)] == [1, 1, 1, 2, 1, 1]
    assert tiny.metric("requests_in_flight") == 0
