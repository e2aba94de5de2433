# SPDX-License-Identifier: MIT
"""``make chaos``: cause faults under load, check every answer, and report the outcomes of all calls.

    chaos.py faults     processes killed, stopped and hung, a crash loop, a greedy caller
    chaos.py rollout    two versions take turns on one server
    chaos.py requests   malformed requests: schemathesis against the gateway, spoilt messages against Triton
    chaos.py soak       no fault: at half of the possible rate, memory and latency stay constant

The default is all parts except soak. The program starts its own servers on loopback. Status 1: a bound was broken.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
import torch
from rich.console import Console
from rich.table import Table

import odd_requests
import rfm_export
import rollout
from callers import WIDTHS
from faults import CALLERS, CHECKPOINT, FAULTS, TRITON, Row, site
from paths import ROOT
from rfm.config import ExportConfig
from rfm_client import PreferenceSample, ProgressSample, Sample, Trajectory
from servers import MODEL
from trajectories import random_trajectory

ENCODERS = ROOT / "model_repository" / "rfm_encoder" / "1"
MOST_MIB_PER_MIN = 1e6 / 2**20  # largest memory growth in a soak
MOST_RISE = 0.25  # for p99 in a soak, relative to its median; up to two standard errors are chance


def all_faults(folder: Path, arguments: argparse.Namespace) -> list[Row]:
    rows = []
    for number, fault in enumerate(FAULTS):
        print(f"{fault.__name__} ...", flush=True)
        with tried(fault.__name__, rows), site(folder / f"fault_{number}") as served:
            rows += fault(served)
    return rows


def rollout_samples() -> list[Sample]:
    """Embeddings and frames, several lengths, two types."""
    random = np.random.default_rng(0)
    samples: list[Sample] = []
    for index in range(16):
        count = 1 + index % 6
        frames = random.integers(0, 256, (count, 48, 48, 3), np.uint8)
        filmed = Trajectory(frames=frames, task=f"stack {index} cups")
        for trajectory in (random_trajectory(index, count, *rollout.WIDTHS), filmed):
            samples.append(PreferenceSample(trajectory, trajectory) if index % 4 == 3 else ProgressSample(trajectory))
    return samples


def take_turns(folder: Path, arguments: argparse.Namespace) -> list[Row]:
    """Alternate rollout and rollback under gRPC and HTTP calls without retry. Each answer names its version."""
    other, samples = rollout.other_checkpoint(folder / "other"), rollout_samples()
    checkpoints = {"1": rollout.WITH_ENCODERS.checkpoint, "2": other}
    expected = {version: rollout.answers(checkpoint, samples) for version, checkpoint in checkpoints.items()}
    rows = []
    with site(folder / "rollout", lambda repository: rollout.export(checkpoints["1"], repository, MODEL)) as served:
        rollout.export(other, served.folder / "model_repository", MODEL)
        ends, end_s = served.served.endpoints, time.monotonic() + 60 * arguments.minutes
        asking = [rollout.callers(url, samples, expected, count=CALLERS) for url in (ends.grpc_url, ends.http_url)]
        with asking[0] as over_grpc, asking[1] as over_http:
            turns = 0
            while time.monotonic() < end_s:
                served.models(*(("rollback", MODEL) if turns % 2 else ("rollout", MODEL, "2")))
                turns += 1
    for name, tally in {"gRPC": over_grpc, "HTTP": over_http}.items():
        row = Row(f"{turns} times another version, {name}", told=str(tally))
        row.expect(not tally.failed, f"{len(tally.failed)} calls failed, such as {tally.failed[:1]}")
        row.expect(not tally.unlike, f"answers of neither version, such as {tally.unlike[:1]}")
        rows.append(row)
    return rows


def requests(folder: Path, arguments: argparse.Namespace) -> list[Row]:
    def export(repository: Path) -> None:
        encoders = {f"{kind}_encoder": str(ENCODERS / f"{kind}_encoder") for kind in ("image", "text")}
        rfm_export.export(CHECKPOINT, repository, ExportConfig(num_gpus=0, torch_threads=1, **encoders))

    with site(folder / "requests", export) as served, served.callers(2) as callers:
        of_gateway = odd_requests.against_gateway(served.gateway_url, arguments.examples, arguments.seed)
        url = served.served.endpoints.grpc_url
        codes = odd_requests.against_triton(url, WIDTHS, arguments.examples, arguments.seed)
        callers.wait_for_all()
        log = served.served.log.read_text(errors="replace")
        restarts = served.restarts(MODEL) + served.restarts(TRITON)
    row = Row("malformed requests, and callers beside them", callers, told=f"from Triton: {dict(codes)}")
    row.expect(of_gateway, "the gateway: schemathesis told it above")
    row.expect("DEADLINE_EXCEEDED" not in codes, "an answer came late")
    row.expect(not restarts and "Traceback" not in log, f"{restarts:.0f} restarts, or a traceback in the log")
    return [row]


def soak(folder: Path, arguments: argparse.Namespace) -> list[Row]:
    """Load a server at half its maximum rate for 30 windows. The first fifth is warm-up."""
    minutes, course = [], []
    with site(folder / "soak") as served:
        with served.callers(6) as alone:
            time.sleep(5)
        pause_s = float(np.median(alone.latencies_s))  # one answer time: half the load
        process = psutil.Process(served.served.process.pid)
        with served.callers(6, pause_s=pause_s) as callers, served.gateway_callers(2, pause_s=2 * pause_s) as beside:
            began_s = time.monotonic()
            for window in range(1, 31):
                first = callers.answered
                time.sleep(max(began_s + 60 * arguments.minutes * window / 30 - time.monotonic(), 0))
                memory = sum(one.memory_info().rss for one in (process, *process.children(recursive=True)))
                p99_ms = 1e3 * np.percentile(callers.latencies_s[first:], 99)
                minutes.append((time.monotonic() - began_s) / 60)
                course.append((memory / 2**20, p99_ms))
                print(f"{minutes[-1]:5.1f} min: {course[-1][0]:.1f} MiB, p99 {p99_ms:.1f} ms", flush=True)
    slopes, covariance = np.polyfit(minutes[6:], np.array(course[6:]), 1, cov=True)
    (mib, p99), p99_error = slopes[0], np.sqrt(covariance[0, 0, 1])
    row = Row("soak", callers, told=f"{mib:+.3f} MiB/min, p99 {p99:+.3f} ms/min (standard error {p99_error:.3f})")
    row.expect(mib < MOST_MIB_PER_MIN, f"memory grew by {mib:.3f} MiB/min; allowed: {MOST_MIB_PER_MIN:.3f}")
    is_flat = p99 * minutes[-1] <= MOST_RISE * np.median(course, axis=0)[1] or p99 <= 2 * p99_error
    row.expect(bool(is_flat), f"p99 rose by {p99 * minutes[-1]:.1f} ms")
    return [row, Row("  through the gateway", beside)]


@contextmanager
def tried(name: str, rows: list[Row]) -> Iterator[None]:
    """Turn an exception into a row, so that the remaining parts still run."""
    try:
        yield
    except Exception as error:  # noqa: BLE001
        traceback.print_exc()
        rows.append(Row(name, broken=[f"{type(error).__name__}: {error}"]))


PARTS = {"faults": all_faults, "rollout": take_turns, "requests": requests, "soak": soak}


def main() -> int:
    """Run the chosen parts and print a table. Returns 1 if a bound was broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default="all", choices=["all", *PARTS], metavar="PART")
    parser.add_argument("--minutes", type=float, default=None, help="of a soak (30), of rollouts (1)")
    parser.add_argument("--examples", type=int, default=300, help="of malformed requests, of each kind")
    parser.add_argument("--seed", type=int, default=0, help="of malformed requests")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[Row] = []
    for part in [part for part in PARTS if part != "soak"] if arguments.parts == "all" else arguments.parts:
        of_part = argparse.Namespace(**vars(arguments))
        of_part.minutes = arguments.minutes or (30.0 if part == "soak" else 1.0)
        with tempfile.TemporaryDirectory(prefix="rfm-chaos-") as folder, tried(part, rows):
            rows += PARTS[part](Path(folder), of_part)
    table = Table("fault", "asked", "answered", "refused", "broken off", "lost", "wrong", "healed s", "told")
    for row in rows:
        table.add_row(*row.cells)
    Console(width=150).print(table)
    broken = [f"BROKEN: {row.name}: {why}" for row in rows for why in row.broken]
    print("\n".join(broken) or "every bound was kept")
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main())
