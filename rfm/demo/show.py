# SPDX-License-Identifier: MIT
"""Scores from a served model as a person would look at them: a table, a plot, the server's metrics."""

from __future__ import annotations

import time
import urllib.request
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from rfm_client import FrameScores, PreferenceResult, ProgressResult, Result, SimilarityResult
from rfm_client.samples import UInt8Array

STRIP_FRAMES = 8
METRICS_TIMEOUT_S = 10
METRICS_POLL_S = 0.2
_COUNTERS = {
    "nv_inference_request_success": "requests",
    "nv_inference_request_failure": "failed",
    "nv_inference_count": "samples",
    "nv_inference_exec_count": "executions",
    "nv_inference_compute_infer_duration_us": "compute ms",
    "nv_inference_queue_duration_us": "queue ms",
}
_GAUGES = ("nv_gpu_utilization", "nv_gpu_memory_used_bytes", "nv_cpu_utilization", "nv_cpu_memory_used_bytes")


def scores_table(title: str, rows: Sequence[tuple[str, Result]]) -> Table:
    """One row a result: its question's answer, and the scores of its last frame."""
    table = Table(title=title, title_justify="left")
    for column in ("sample", "answer", "progress at the end", "success at the end"):
        table.add_column(column)
    frames: FrameScores
    for name, result in rows:
        if isinstance(result, ProgressResult):
            answer, frames = f"{len(result.progress)} frames", result
        elif isinstance(result, PreferenceResult):
            answer, frames = f"P(first) = {result.preference:.4f}", result.first
        else:
            assert isinstance(result, SimilarityResult)
            answer, frames = f"similarity = {result.similarity:.4f}", result.reference
        table.add_row(name, answer, f"{frames.progress[-1]:.4f}", f"{frames.success[-1]:.4f}")
    return table


def plot(file: Path, frames: UInt8Array, result: ProgressResult, title: str) -> None:
    """Writes a PNG: some of the frames [T, H, W, 3] in a strip, and below them each frame's scores."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    shown = np.unique(np.linspace(0, len(frames) - 1, STRIP_FRAMES).round().astype(int))
    figure = pyplot.figure(figsize=(10, 4.6), layout="constrained")
    grid = figure.add_gridspec(2, len(shown), height_ratios=[1, 2])
    for column, index in enumerate(shown):
        axes = figure.add_subplot(grid[0, column])
        axes.imshow(frames[index])
        axes.set_axis_off()
        axes.set_title(f"{index}", fontsize=8)
    axes = figure.add_subplot(grid[1, :])
    axes.plot(result.progress, marker="o", label="progress")
    axes.plot(result.success, marker="s", label="success probability")
    axes.set(xlabel="frame", ylim=(-0.02, 1.02), xlim=(-0.3, len(frames) - 0.7))
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left")
    figure.suptitle(title)
    figure.savefig(file, dpi=120)
    pyplot.close(figure)


def metrics_table(url: str) -> Table:
    """What Triton's metrics endpoint says of each model, and of the machine."""
    samples = _read_metrics(url)
    sampled_by_s = time.monotonic() + METRICS_TIMEOUT_S
    while not _machine(samples).get("nv_cpu_memory_used_bytes") and time.monotonic() < sampled_by_s:
        time.sleep(METRICS_POLL_S)  # Triton looks at the machine every two seconds
        samples = _read_metrics(url)
    by_model: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    for sample in samples:
        name = sample.name.removesuffix("_total")
        if name in _COUNTERS:
            scale = 1e-3 if name.endswith("_us") else 1.0
            by_model[sample.labels["model"]][_COUNTERS[name]] += sample.value * scale
    machine = ", ".join(f"{name} {value:.3g}" for name, value in _machine(samples).items())
    table = Table(title=f"Triton's metrics, warm-up included\n{machine}", title_justify="left")
    for column in ("model", *_COUNTERS.values()):
        table.add_column(column)
    for model, counters in sorted(by_model.items()):
        table.add_row(model, *(f"{counters[name]:.0f}" for name in _COUNTERS.values()))
    return table


def _read_metrics(url: str) -> list[Any]:
    from prometheus_client.parser import text_string_to_metric_families

    with urllib.request.urlopen(url, timeout=METRICS_TIMEOUT_S) as answer:
        families = text_string_to_metric_families(answer.read().decode())
        return [sample for family in families for sample in family.samples]


def _machine(samples: Sequence[Any]) -> dict[str, float]:
    return {" ".join([s.name, *s.labels.values()]): s.value for s in samples if s.name in _GAUGES}
