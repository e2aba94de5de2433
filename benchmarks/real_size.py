# SPDX-License-Identifier: MIT
"""Measure published-size networks without a server: prints a JSON line for each measurement.

    real_size.py FOLDER [--tiny]

FOLDER has checkpoints from random_checkpoints.py. Imports only what older commits also have. Each batch has new
frames; a measurement lasts a few seconds after the warm-up calls.
"""

from __future__ import annotations

import inspect
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from load import Calls, Load, Measured, samples
from random_checkpoints import BASE_MODEL, DESCRIBED, QWEN, QWEN3_VL_4B, ROBOMETER, RYNNVALUE, TINY, Size
from torch.profiler import ProfilerActivity, profile

from rfm import published
from rfm.config import ExportConfig
from rfm.engine import Engine

FRAMES = 8
WARM_UP_CALLS = 3  # a CUDA graph is captured at the third
LEAST_ROUNDS = 3
MAX_TOKENS = 10**6
SHOWN_KERNELS = 12


@dataclass(frozen=True)
class Scale:
    """Sizes and durations for the measurements.

    small_px, usual_px: frame heights and widths
    many_frames: frames in TOPReward's episode
    callers: caller counts, which are also the batch sizes
    seconds: per measurement, after warm_up_s
    """

    size: Size
    device: str
    small_px: tuple[int, int]
    usual_px: tuple[int, int]
    many_frames: int
    callers: tuple[int, int, int]
    seconds: float
    warm_up_s: float


FULL = Scale(QWEN3_VL_4B, "cuda", (224, 224), (480, 640), 64, (1, 8, 32), 5.0, 1.5)
SMALLEST = Scale(TINY, "cpu", (64, 64), (64, 96), 6, (1, 2, 4), 0.3, 0.1)


def described(px: tuple[int, int], frames: int, callers: int, **more: Any) -> dict[str, Any]:
    """Return the columns that identify a measurement."""
    return {"frames": frames, "size": f"{px[0]}x{px[1]}", "callers": callers, "repeated": False, **more}


def measured(engine: Engine, scale: Scale, count: int, frames: int, px: tuple[int, int]) -> dict[str, Any]:
    """Return rate, latencies and memory for batches with ``count`` samples."""
    sample = samples(Load(1, 0, (frames, frames), frame_px=px), 0, 0)
    on_gpu = scale.device != "cpu"
    latencies_s: list[float] = []
    began_s = time.perf_counter()
    for number in range(WARM_UP_CALLS, -(10**6), -1):
        if number == 0:
            began_s = time.perf_counter()
            if on_gpu:
                torch.cuda.reset_peak_memory_stats()
        if len(latencies_s) >= LEAST_ROUNDS and time.perf_counter() - began_s > scale.seconds / 2:
            break
        batch = [sample(0) for _ in range(count)]
        before_s = time.perf_counter()
        for result in engine.evaluate(batch):
            if isinstance(result, Exception):
                raise result
        if number <= 0:
            latencies_s.append(time.perf_counter() - before_s)
    told = Measured.of([Calls(latencies_s, 0, sum(latencies_s))], count)
    row = described(px, frames, count, tokens=engine.prepare(sample(0)).num_tokens)
    figures = {"samples_per_s": told.samples_per_s, "failed": 0, "p50_ms": told.p50_ms, "p99_ms": told.p99_ms}
    if on_gpu:
        figures |= {"peak_gib": torch.cuda.max_memory_allocated() / 2**30, "device_ms": device_ms(engine, batch)}
    return {**row, **figures}


def device_ms(engine: Engine, batch: Sequence[Any]) -> float:
    """Return how many milliseconds a batch's kernels run: far fewer than its latency means that the host is slow.

    Prints the slowest kernels to standard error.
    """
    with profile(activities=[ProfilerActivity.CUDA]) as told:
        engine.evaluate(batch)
        torch.cuda.synchronize()
    kernels = sorted(told.key_averages(), key=lambda each: each.self_device_time_total, reverse=True)
    for each in kernels[:SHOWN_KERNELS]:
        print(f"{each.self_device_time_total / 1e3:9.3f} ms {each.count:5} {each.key[:100]}", file=sys.stderr)
    return float(sum(each.self_device_time_total for each in kernels) / 1e3)


def rows(folder: Path, scale: Scale) -> Iterator[dict[str, Any]]:
    """Measure all networks in turn. Graphs are measured where the engine knows them."""
    small, usual, (one, some, many) = scale.small_px, scale.usual_px, scale.callers
    plans: list[tuple[str, str, Sequence[tuple[int, int, tuple[int, int]]]]] = [
        ("Robometer", ROBOMETER, [(n, FRAMES, px) for px in (small, usual) for n in (one, some, many)]),
        ("topreward", QWEN, [(one, scale.many_frames // 4, small), (one, scale.many_frames, small)]),
        ("roboreward", QWEN, [(n, FRAMES, usual) for n in (one, some)]),
        ("roboreward-expected", QWEN, [(n, FRAMES, usual) for n in (one, some)]),
    ]
    if "robot_description" in {each.name for each in fields(ExportConfig)}:
        plans += [("rynnvalue", RYNNVALUE, [(n, FRAMES, small) for n in (one, some, many)])]
    knows_graphs = "cuda_graphs" in inspect.signature(Engine.of).parameters
    for what, kind, sizes in plans:
        for graphs in (False, True) if knows_graphs and kind == ROBOMETER else (False,):
            known: dict[str, dict[str, Any]] = {ROBOMETER: {"base_model": str(BASE_MODEL)}, RYNNVALUE: DESCRIBED}
            sources = known.get(kind, {"reward_model": what})
            options: dict[str, Any] = {"feature_cache_mib": ExportConfig().feature_cache_mib}  # as the server's
            options |= {"cuda_graphs": True} if graphs else {}
            checkpoint = published.load(folder / kind, **sources)
            engine = Engine.of(checkpoint, device=scale.device, max_sample_tokens=MAX_TOKENS, **options)
            for size in sizes[:2] if graphs else sizes:
                yield {
                    "what": what.partition(",")[0],
                    "way": "engine",
                    "graphs": graphs,
                    **measured(engine, scale, *size),
                }
            del engine
            if scale.device != "cpu":
                torch.cuda.empty_cache()


if __name__ == "__main__":
    for row in rows(Path(sys.argv[1]), SMALLEST if "--tiny" in sys.argv else FULL):
        print(json.dumps(row), flush=True)
