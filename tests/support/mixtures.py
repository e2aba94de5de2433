# SPDX-License-Identifier: MIT
"""Samples of all types for the reference server, and the server's counts."""

from __future__ import annotations

import time
from collections.abc import Callable

import httpx
import numpy as np
import psutil
import tritonclient.grpc
from prometheus_client.parser import text_string_to_metric_families

import goldens
from commands import running
from rfm_client import (
    PreferenceSample,
    ProgressSample,
    RewardError,
    Sample,
    SimilaritySample,
)
from servers import Served, wait_for
from tolerances import TOLERANCE
from trajectories import random_trajectory

TOLD_S = 1.0  # until a model has reported its counts to Triton
MODEL = "c1_t1_disc10"  # tokens, so T <= 16; discrete; all heads


FRAMES_MODEL = "enc_c1_t1_disc10"


def mixed_samples(count: int, longest: int = 16) -> list[Sample]:
    """All types, all lengths from 1 to ``longest``, in turn."""
    samples: list[Sample] = []
    for index in range(count):
        first = random_trajectory(2 * index, 1 + index % longest)
        second = random_trajectory(2 * index + 1, 1 + (7 * index) % longest)
        kinds: tuple[Callable[[], Sample], ...] = (
            lambda first=first: ProgressSample(first),
            lambda first=first, second=second: PreferenceSample(first, second),
            lambda first=first, second=second: SimilaritySample(first, second),
        )
        samples.append(kinds[index % 3]())
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
    assert not isinstance(left, RewardError), left
    assert not isinstance(right, RewardError), right
    for a, b in zip(goldens.frame_scores(left), goldens.frame_scores(right), strict=True):  # type: ignore[arg-type]
        np.testing.assert_allclose(a.progress, b.progress, rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(a.success, b.success, rtol=0, atol=TOLERANCE)
    for name in ("preference", "similarity"):
        if hasattr(left, name):
            assert abs(getattr(left, name) - getattr(right, name)) <= TOLERANCE
