# SPDX-License-Identifier: MIT
"""What it costs the CPU to prepare a sample of frames for a vision-language checkpoint, all threads together.

    python benchmarks/preparation.py            # a minute

Prepared is what the device is sent: checked, named by digests (for the cache of features), brought to size, laid out.
Frames are new in each round. This server is measured twice: with a task that was asked before, as in an RL loop, whose
conversation is kept, and with a new task each time. Beside it the image processor of transformers in numpy and Pillow,
as upstream uses it. It also normalises and cuts into patches; here the device does that. Measured in turn, round after
round. The weights play no part, so the checkpoint of the tests serves. Writes preparation.json and preparation.md.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import numpy as np
from bench import RESULTS, ROOT, machine
from rich.console import Console
from transformers import AutoImageProcessor

from rfm import families
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm_client import ProgressSample, Trajectory

CASE = ROOT / "tests" / "golden" / "vlm"
CHECKPOINT, BASE = CASE / "q3_tok_disc10" / "checkpoint", CASE / "bases" / "q3"
SIZES = ((256, 256), (480, 640), (720, 1280))
FRAMES = 8
OURS, OURS_NEW, THEIRS = "this server", "this server, a new task", "transformers' processor"

Prepare: TypeAlias = Callable[[np.ndarray], object]


def main() -> None:
    """Measures, writes and shows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=31)
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder for the results")
    arguments = parser.parse_args()
    checkpoint = families.load(CHECKPOINT, base_model=str(BASE))
    predictor = Engine.of(checkpoint, feature_cache_mb=ExportConfig().feature_cache_mb).predictor
    processor = AutoImageProcessor.from_pretrained(BASE, use_fast=False)
    numbers = itertools.count()

    def ours(frames: np.ndarray, task: str) -> object:
        return predictor.collate(predictor.rows(ProgressSample(Trajectory(frames=frames, task=task))))

    ways: dict[str, Prepare] = {
        OURS: lambda frames: ours(frames, "stack the cups"),
        OURS_NEW: lambda frames: ours(frames, f"stack {next(numbers)} cups"),
        THEIRS: lambda frames: processor(images=list(frames), return_tensors="pt"),
    }
    rows = [_measured(size, arguments.rounds, ways) for size in SIZES]
    results = {"machine": machine(), "frames": FRAMES, "rounds": arguments.rounds, "measurements": rows}
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "preparation.json").write_text(json.dumps(results, indent=1) + "\n")
    text = _markdown(rows, arguments.rounds)
    (arguments.output / "preparation.md").write_text(text)
    Console().print(text, highlight=False)


def _measured(size: tuple[int, int], rounds: int, ways: dict[str, Prepare]) -> dict[str, object]:
    """Milliseconds of the CPU that each way takes for frames of a size, threads included."""
    random = np.random.default_rng(0)
    took_ms: dict[str, list[float]] = {name: [] for name in ways}
    for number in range(rounds + 1):
        frames = random.integers(0, 256, (FRAMES, *size, 3), np.uint8)
        for name, prepare in ways.items():
            began_s = time.process_time()
            prepare(frames)
            if number:  # the first one warms up
                took_ms[name].append((time.process_time() - began_s) * 1e3)
    ratio = statistics.median(ours / theirs for ours, theirs in zip(took_ms[OURS], took_ms[THEIRS], strict=True))
    return {"size": f"{size[0]}x{size[1]}", "cpu_ms": took_ms, "ratio": ratio}


def _markdown(rows: list[dict[str, object]], rounds: int) -> str:
    lines = [
        "# Preparing a sample for a vision-language checkpoint",
        "",
        f"Milliseconds of CPU time for {FRAMES} frames, all threads together: medians of {rounds} interleaved rounds, "
        f"with the smallest and largest. Ratio: of {OURS} to {THEIRS}, median of those within a round.",
        "",
        f"| frames | {OURS} | {OURS_NEW} | {THEIRS} | ratio |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        cells = [_spread(times) for times in row["cpu_ms"].values()]  # type: ignore[attr-defined]
        lines.append(f"| {row['size']} | {' | '.join(cells)} | {row['ratio']:.2f} |")
    return "\n".join(lines) + "\n"


def _spread(values: list[float]) -> str:
    return f"{statistics.median(values):.1f} ({min(values):.1f}..{max(values):.1f})"


if __name__ == "__main__":
    main()
