# SPDX-License-Identifier: MIT
"""Samples/s of a served vision-language checkpoint, 1, 8 and 32 samples asked together, 8 frames of 256 x 256 each.

    python benchmarks/vlm_throughput.py grpc://localhost:8001 --metrics http://localhost:8002/metrics

Medians of interleaved rounds; collate and forward time of the last sample's batch, as the server tells them (the client
cuts requests at 8 MiB, so 8 and 32 samples are several); the share of the time that the
GPU computes as Triton's metrics tell it. Writes benchmarks/results/vlm_throughput.json.
"""

from __future__ import annotations

import argparse
import json
import platform
import re
import statistics
import time
import urllib.request
from pathlib import Path

import numpy as np

from rfm_client import ProgressSample, RewardClient, Trajectory

TOGETHER = (1, 8, 32)
FRAMES, SIZE_PX = 8, 256
RESULTS = Path(__file__).parent / "results"


def gpu_utilisation(metrics_url: str) -> list[float]:
    """nv_gpu_utilization of each GPU, 0..1; empty without one."""
    with urllib.request.urlopen(metrics_url, timeout=10) as answer:
        text = answer.read().decode()
    return [float(value) for value in re.findall(r"^nv_gpu_utilization\{[^}]*\} (\S+)$", text, re.MULTILINE)]


def main() -> None:
    """Measures and writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("url")
    parser.add_argument("--metrics", required=True)
    parser.add_argument("--model", default="rfm")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--machine", default=platform.processor() or platform.machine())
    options = parser.parse_args()
    random = np.random.default_rng(0)
    samples = [
        ProgressSample(
            Trajectory(frames=random.integers(0, 256, (FRAMES, SIZE_PX, SIZE_PX, 3), np.uint8), task=f"task {index}")
        )
        for index in range(max(TOGETHER))
    ]
    measured: dict[int, list[dict[str, float]]] = {count: [] for count in TOGETHER}
    with RewardClient(options.url, model=options.model, timeout_s=600) as client:
        client.evaluate(samples)  # warm
        for _ in range(options.rounds):
            for count in TOGETHER:
                started_s = time.perf_counter()
                results = client.evaluate(samples[:count], timing=True)
                elapsed_s = time.perf_counter() - started_s
                timing = results[-1].timing
                assert timing is not None
                measured[count].append(
                    {
                        "samples_per_s": count / elapsed_s,
                        "last_batch_collate_ms": timing.collate_ms,
                        "last_batch_forward_ms": timing.forward_ms,
                        "gpu_busy": max(gpu_utilisation(options.metrics), default=float("nan")),
                    }
                )
    medians = {
        count: {name: statistics.median(row[name] for row in rows) for name in rows[0]}
        for count, rows in measured.items()
    }
    report = {"machine": options.machine, "frames": FRAMES, "size_px": SIZE_PX, "rounds": measured, "medians": medians}
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "vlm_throughput.json").write_text(json.dumps(report, indent=2) + "\n")
    print(json.dumps(medians, indent=2))


if __name__ == "__main__":
    main()
