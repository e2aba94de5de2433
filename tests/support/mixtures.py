# SPDX-License-Identifier: MIT
"""Samples of all types for the reference server, and the server's counts."""

from __future__ import annotations

import asyncio
import time

import httpx
import psutil
import tritonclient.grpc
from prometheus_client.parser import text_string_to_metric_families

import goldens
from commands import running
from rfm_client import (
    PreferenceSample,
    ProgressSample,
    Sample,
    SimilaritySample,
)
from rfm_client.contract.wire import Tensors
from rfm_client.transport.calls import TritonTransport
from servers import Served, wait_for
from tolerances import TOLERANCE
from trajectories import random_trajectory

TOLD_S = 1.0  # until a model has reported its counts to Triton
MODEL = "c1_t1_disc10"  # tokens, so T <= 16; discrete; all heads
FRAMES_MODEL = "enc_c1_t1_disc10"


def mixed_samples(count: int) -> list[Sample]:
    """All types, all lengths from 1 to 16, in turn."""
    samples: list[Sample] = []
    for index in range(count):
        first = random_trajectory(2 * index, 1 + index % 16)
        second = random_trajectory(2 * index + 1, 1 + (7 * index) % 16)
        pair = PreferenceSample if index % 3 == 1 else SimilaritySample
        samples.append(pair(first, second) if index % 3 else ProgressSample(first))
    return samples


def plug() -> list[Sample]:
    """Keeps the model busy while other requests queue up."""
    return [ProgressSample(random_trajectory(0, 256), frame_steps=16) for _ in range(32)]


def counts(served: Served, model: str) -> tuple[int, int]:
    """Return the numbers of good answers and pipeline executions so far. Triton counts only calls."""
    time.sleep(TOLD_S)
    with tritonclient.grpc.InferenceServerClient(served.url("grpc").removeprefix("grpc://")) as client:
        stats = client.get_inference_statistics(model).model_stats[0]
    families = text_string_to_metric_families(httpx.get(served.endpoints.metrics_url).text)
    samples = (sample for family in families for sample in family.samples)
    of_model = (s.value for s in samples if s.name == "rfm_batch_samples_count" and s.labels["model"] == model)
    return stats.inference_stats.success.count, int(sum(of_model))


def wait_until_at_work(model: str) -> None:
    """Returns when a process of the model computes."""

    def cpu_s() -> float:
        return sum(sum(psutil.Process(pid).cpu_times()[:2]) for pid in running(f"/{model}/", 2))

    before_s = cpu_s()
    wait_for(lambda: cpu_s() > before_s + 0.05)


def assert_same(left: object, right: object) -> None:
    goldens.assert_close(left, right, TOLERANCE)


def infer(url: str, model: str, tensors: Tensors, outputs: list[str]) -> Tensors:
    """The tensors as they stand, right or wrong, in one request."""

    async def ask() -> Tensors:
        transport = TritonTransport(url)
        try:
            return (await transport.infer(model, tensors, outputs, timeout_s=30)).tensors
        finally:
            await transport.close()

    return asyncio.run(ask())
