# SPDX-License-Identifier: MIT
"""Four times as many requests as can be served: what is accepted is answered soon, what is not is told at once."""

from __future__ import annotations

import asyncio
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import torch
from prometheus_client.parser import text_string_to_metric_families

from callers import (
    MOST_FRAMES,
    TEXT_DIM,
    VIDEO_DIM,
    Connect,
    Exam,
    closed_loop,
    direct,
    open_loop,
    through_gateway,
    trajectory,
)
from chaos_site import Row, Site, site, wait_healthy
from rfm.launch.process import Endpoints
from rfm.rewind.checkpoint import RewindCheckpoint
from rfm.rewind.network import RewindTransformer
from rfm_client import ProgressSample, Sample
from rfm_gateway.command import gateway_command
from rfm_gateway.config import GatewayConfig
from rfm_gateway.scoring import FRAME_STEPS
from rfm_serve import MODEL, PATIENCE_S
from small_network import SMALL

ROOM = 8  # calls that may wait at a time: about a second
SETTINGS = {"max_queue_size": ROOM, "max_batch_size": 1}
FACTOR = 4
CALIBRATION_S = 6.0
CALLERS = 8
CROWD_PER_S = 200.0
CROWD_S = 5.0
TOLD_S = 0.1
METRICS_S = 2.0  # for a model to tell Triton what it has counted
P99_FACTOR = 3
LARGE = replace(  # much work and few bytes: callers beside the server take little of the machine
    SMALL, video_feature_dim=VIDEO_DIM, text_feature_dim=TEXT_DIM, hidden_dim=1024, num_layers=4, num_attention_heads=8,
    max_len=MOST_FRAMES, progress_bins=10,
)  # fmt: skip


@contextmanager
def large_site(folder: Path, **settings: int) -> Iterator[Site]:
    """What is overloaded: a checkpoint of random weights."""
    torch.manual_seed(0)
    checkpoint = folder / "checkpoint"
    RewindCheckpoint(LARGE, RewindTransformer(LARGE).state_dict()).save(checkpoint)
    with site(folder, checkpoint, **settings) as served:
        yield served


def heavy_samples() -> list[Sample]:
    """As many sequences each as they have frames."""
    random = np.random.default_rng(2)
    return [ProgressSample(trajectory(random, MOST_FRAMES), frame_steps=FRAME_STEPS) for _ in range(16)]


def of_grpc(site: Site, folder: Path, seconds: float) -> list[Row]:
    """The model rejects what it has no room for, and counts it; then the gateway's crowd."""
    exam = Exam.of(site.checkpoint, heavy_samples())
    endpoints = site.served.endpoints
    connect = direct(endpoints.grpc_url, retry=False, max_in_flight=4096, join=False)
    return [_overload(exam, "gRPC", connect, ROOM, lambda: _rejected(endpoints), seconds), _crowd(site)]


def of_gateway(site: Site, folder: Path, seconds: float) -> list[Row]:
    """A gateway turns away what is more than it takes at a time, and counts it, whatever Triton does."""
    endpoints, port = site.served.endpoints, Endpoints.free().http_port
    url = f"http://127.0.0.1:{port}"
    command = gateway_command(
        GatewayConfig(port, triton=endpoints.grpc_url, metrics_url=endpoints.metrics_url, model=MODEL)
    )
    with (folder / "gateway.log").open("wb") as log:
        gateway = subprocess.Popen([*command, f"--max-in-flight={ROOM}", "--max-waiting=0"], stdout=log, stderr=log)
    try:
        wait_healthy(url)
        exam = Exam.of(site.checkpoint, heavy_samples())
        return [_overload(exam, "a gateway", through_gateway(url), ROOM, lambda: _rejections(url), seconds)]
    finally:
        gateway.terminate()
        gateway.wait(PATIENCE_S)


def _overload(exam: Exam, door: str, connect: Connect, room: int, count: Callable[[], float], seconds: float) -> Row:
    """FACTOR times as many calls as can be served, for so long. ``count``: refusals that the metrics count."""
    unloaded_s = closed_loop(connect, exam, 1, CALIBRATION_S)[0].p99_s
    _, capacity_per_s = closed_loop(connect, exam, CALLERS, CALIBRATION_S)
    before = count()
    tally, latest_s = asyncio.run(open_loop(connect, exam, FACTOR * capacity_per_s, seconds))
    time.sleep(METRICS_S)
    counted = count() - before
    queue_s = room / capacity_per_s
    most_s = P99_FACTOR * unloaded_s + queue_s
    refusals_ms = 1e3 * np.percentile(tally.refusals_s or [0.0], [99, 100])
    told = (
        f"{capacity_per_s:.0f}/s can be served, {tally.answered / seconds:.0f}/s were; "
        f"p99 {1e3 * tally.p99_s:.0f} ms of {1e3 * most_s:.0f} allowed (unloaded {1e3 * unloaded_s:.0f}, "
        f"queue {1e3 * queue_s:.0f}); refusals told in p99 {refusals_ms[0]:.0f} ms, max {refusals_ms[1]:.0f} ms "
        f"(callers were up to {1e3 * latest_s:.0f} ms late themselves)"
    )
    row = Row.of(f"{FACTOR} x overload of {door} for {seconds:g} s", tally, told=told)
    row.expect(tally.refused > 0, "nobody was refused")
    row.expect(tally.p99_s <= most_s, f"p99 of accepted calls: {tally.p99_s:.2f} s; allowed: {most_s:.2f} s")
    row.expect(max(tally.refusals_s, default=0) <= TOLD_S, f"a refusal was told after {refusals_ms[1]:.0f} ms")
    row.expect(counted == tally.refused, f"the metrics count {counted:.0f} refused calls")
    return row


def _crowd(site: Site) -> Row:
    """More callers of the gateway than the model takes; every refusal is in the gateway's metrics."""
    before = _rejections(site.gateway_url)
    tally, _ = asyncio.run(open_loop(through_gateway(site.gateway_url), site.progress, CROWD_PER_S, CROWD_S))
    counted = _rejections(site.gateway_url) - before
    row = Row.of("a crowd through the gateway", tally, told=f"its metrics count {counted:.0f} refused")
    row.expect(tally.refused > 0, "nobody was refused")
    row.expect(counted == tally.refused, f"the gateway counts {counted:.0f} refused calls")
    return row


def _rejections(gateway_url: str) -> float:
    return _sum(f"{gateway_url}/metrics", "rfm_gateway_rejections_total", reason="unavailable")


def _rejected(endpoints: Endpoints) -> float:
    return _sum(endpoints.metrics_url, "rfm_samples_total", model=MODEL, outcome="rejected")


def _sum(url: str, name: str, **labels: str) -> float:
    families = text_string_to_metric_families(httpx.get(url).text)
    samples = [sample for family in families for sample in family.samples]
    return sum(
        sample.value
        for sample in samples
        if sample.name.removesuffix("_total") == name.removesuffix("_total") and labels.items() <= sample.labels.items()
    )
