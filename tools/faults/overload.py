# SPDX-License-Identifier: MIT
"""Four times as many requests as can be served: what is accepted is answered soon, what is not is told at once."""

from __future__ import annotations

import asyncio
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
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
from control import SCORE, control
from rfm.rewind.checkpoint import RewindCheckpoint
from rfm.rewind.network import RewindConfig, RewindTransformer
from rfm.supervise.process import Endpoints
from rfm_client import ProgressSample, Sample
from rfm_gateway.command import gateway_command
from rfm_gateway.scoring import FRAME_STEPS
from rfm_serve import MODEL, PATIENCE_S

ROOM = 8  # calls that may wait at a time: about a second
# Two instances: with one, a Triton before 26.08 that has a bounded queue serves a batch each half second once it is full.
SETTINGS = {"max_queue_size": ROOM, "max_batch_size": 1, "instances": 2}
FACTOR = 4
CALIBRATION_S = 6.0
CALLERS = 8
CROWD_PER_S = 200.0
CROWD_S = 5.0
TOLD_S = 0.1
US_PER_S = 1e6
P99_FACTOR = 3
LARGE = RewindConfig(  # much work and few bytes: callers beside the server take little of the machine
    video_feature_dim=VIDEO_DIM,
    text_feature_dim=TEXT_DIM,
    hidden_dim=1024,
    num_layers=4,
    num_attention_heads=8,
    max_len=MOST_FRAMES,
    causal_mask=True,
    use_per_frame_progress_token=True,
    progress_bins=10,
    has_similarity=True,
)


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
    """Triton's own queue refuses what it has no room for, beside a control without our code; then the gateway's crowd.

    A bound that the control breaks too is Triton's limit: the row reports it and does not fail for it.
    """
    exam = Exam.of(site.checkpoint, heavy_samples())
    ends = site.served.endpoints
    ours = _overload(exam, "gRPC", _without_retries(ends), ROOM, lambda: _failures(ends), seconds)
    with control(site.repository, folder / "control", _service_s(site, exam)) as ends:
        blank = Exam(exam.samples, [np.full_like(expected, SCORE) for expected in exam.expected])
        bare = _overload(blank, "a bare Triton", _without_retries(ends), ROOM, lambda: _failures(ends), seconds)
    for bound, why in ours.broken.items():
        if bound in bare.broken:
            ours.row.told += f"; Triton's limit, the control breaks it too: {bare.broken[bound]}"
        else:
            ours.row.broken.append(why)
    return [ours.row, bare.row, _crowd(site)]


def _without_retries(endpoints: Endpoints) -> Connect:
    return direct(endpoints.grpc_url, retry=False, max_in_flight=4096)


def _service_s(site: Site, exam: Exam) -> float:
    """Seconds that a model instance takes for one request of a lone caller, as Triton counts them."""
    names = ("nv_inference_compute_infer_duration_us", "nv_inference_count")
    before = [_sum(site.served.endpoints.metrics_url, name, model=MODEL) for name in names]
    closed_loop(_without_retries(site.served.endpoints), exam, 1, CALIBRATION_S)
    after = [_sum(site.served.endpoints.metrics_url, name, model=MODEL) for name in names]
    return (after[0] - before[0]) / (after[1] - before[1]) / US_PER_S


def of_gateway(site: Site, folder: Path, seconds: float) -> list[Row]:
    """A gateway turns away what is more than it takes at a time, and counts it, whatever Triton does."""
    endpoints, port = site.served.endpoints, Endpoints.free().http_port
    url = f"http://127.0.0.1:{port}"
    command = gateway_command(endpoints.grpc_url, endpoints.metrics_url, MODEL, "127.0.0.1", port)
    with (folder / "gateway.log").open("wb") as log:
        gateway = subprocess.Popen([*command, f"--max-in-flight={ROOM}", "--max-waiting=0"], stdout=log, stderr=log)
    try:
        wait_healthy(url)
        exam = Exam.of(site.checkpoint, heavy_samples())
        found = _overload(exam, "a gateway", through_gateway(url), ROOM, lambda: _rejections(url), seconds)
    finally:
        gateway.terminate()
        gateway.wait(PATIENCE_S)
    row = found.row
    row.broken += found.broken.values()
    row.expect(found.counted == row.refused, f"the gateway counts {found.counted:.0f} refused calls")
    return [row]


@dataclass
class Overload:
    """What became of an overload. counted: refusals that metrics count; broken: by bound, how it was broken"""

    row: Row
    counted: float
    broken: dict[str, str]


def _overload(
    exam: Exam, door: str, connect: Connect, room: int, count: Callable[[], float], seconds: float
) -> Overload:
    """FACTOR times as many calls as can be served, for so long."""
    unloaded_s = closed_loop(connect, exam, 1, CALIBRATION_S)[0].p99_s
    _, capacity_per_s = closed_loop(connect, exam, CALLERS, CALIBRATION_S)
    before = count()
    tally, latest_s = asyncio.run(open_loop(connect, exam, FACTOR * capacity_per_s, seconds))
    counted = count() - before
    queue_s = room / capacity_per_s
    most_s = P99_FACTOR * unloaded_s + queue_s
    refusals_ms = 1e3 * np.percentile(tally.refusals_s or [0.0], [99, 100])
    told = (
        f"{capacity_per_s:.0f}/s can be served, {tally.answered / seconds:.0f}/s were; "
        f"p99 {1e3 * tally.p99_s:.0f} ms of {1e3 * most_s:.0f} allowed (unloaded {1e3 * unloaded_s:.0f}, "
        f"queue {1e3 * queue_s:.0f}); refusals told in p99 {refusals_ms[0]:.0f} ms, max {refusals_ms[1]:.0f} ms "
        f"(callers were up to {1e3 * latest_s:.0f} ms late themselves); metrics count {counted:.0f}"
    )
    row = Row.of(f"{FACTOR} x overload of {door} for {seconds:g} s", tally, told=told)
    row.expect(tally.refused > 0, "nobody was refused")
    broken = {}
    if tally.p99_s > most_s:
        broken["p99"] = f"p99 of accepted calls: {tally.p99_s:.2f} s; allowed: {most_s:.2f} s"
    if max(tally.refusals_s, default=0) > TOLD_S:
        broken["refusals"] = f"a refusal was told after {refusals_ms[1]:.0f} ms"
    return Overload(row, counted, broken)


def _crowd(site: Site) -> Row:
    """More callers of the gateway than Triton's queue takes; every refusal is in the gateway's metrics."""
    before = _rejections(site.gateway_url)
    tally, _ = asyncio.run(open_loop(through_gateway(site.gateway_url), site.progress, CROWD_PER_S, CROWD_S))
    counted = _rejections(site.gateway_url) - before
    row = Row.of("a crowd through the gateway", tally, told=f"its metrics count {counted:.0f} refused")
    row.expect(tally.refused > 0, "nobody was refused")
    row.expect(counted == tally.refused, f"the gateway counts {counted:.0f} refused calls")
    return row


def _rejections(gateway_url: str) -> float:
    return _sum(f"{gateway_url}/metrics", "rfm_gateway_rejections_total", reason="unavailable")


def _failures(endpoints: Endpoints) -> float:
    return _sum(endpoints.metrics_url, "nv_inference_request_failure")


def _sum(url: str, name: str, **labels: str) -> float:
    families = text_string_to_metric_families(httpx.get(url).text)
    samples = [sample for family in families for sample in family.samples]
    return sum(
        sample.value
        for sample in samples
        if sample.name.removesuffix("_total") == name.removesuffix("_total") and labels.items() <= sample.labels.items()
    )
