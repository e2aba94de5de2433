# SPDX-License-Identifier: MIT
"""Measure how well several GPUs share the requests, without a GPU.

    gpus.py batches     samples/s of 1, 2 and 4 GPUs, with batches of several sizes
    gpus.py episodes    the cost of a step with one server for all GPUs, and with one for each GPU

A real Triton serves a tiny vision-language checkpoint on the CPU. Each instance stands for a GPU.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import report
from contestants import VLM_BASE, VLM_CHECKPOINT, Contestant
from load import Load
from report import Row

import rfm_export
from rfm.config import ExportConfig
from rfm.launch.temporary import temporary_server
from rfm_client import RewardClient
from rfm_client.contract import wire
from rfm_client.transport.calls import Answer, GrpcTransport
from rfm_client.transport.credentials import Credentials
from rfm_export.pbtxt import parse, render

FRAMES, FRAME_PX = 2, (32, 32)  # of a sample: the CPU has little to prepare
STEP_FRAMES, STEP_PX = 8, 64  # of a window
METRICS_S = 1.5  # until instances have reported all frames to Triton
TASK = "lift the block"
SETTINGS = ExportConfig(num_gpus=0, torch_threads=1, base_model=str(VLM_BASE))
SIMULATED = """

import sys

sys.path.insert(0, {peers!r})
_load = TritonPythonModel.load


def load(self, *arguments):
    import os
    from pathlib import Path

    from engines import simulate

    _load(self, *arguments)
    simulate(self.engine, Path({file!r} + str(os.getpid())), 0.0, {row_s}, {lone_s})


TritonPythonModel.load = load
"""


def batches(arguments: argparse.Namespace, folder: Path) -> None:
    """Measure samples/s. A forward pass sleeps for the longer of the lone pass and the time of its samples."""
    lone_s, row_s = arguments.lone_ms / 1e3, arguments.sample_ms / 1e3
    rows: list[Row] = []
    for num_gpus, limit in product(arguments.gpus, arguments.max_batch):
        place = folder / f"{num_gpus}_{limit}"
        settings = replace(SETTINGS, instances=num_gpus, max_batch_size=limit, feature_cache_mib=0)
        rfm_export.export(VLM_CHECKPOINT, place / "repository", settings)
        (model,) = (place / "repository").glob("*/1/model.py")
        peers = str(Path(__file__).parent / "peers")
        told = {"peers": peers, "file": str(place / "ledger"), "row_s": row_s, "lone_s": lone_s}
        model.write_text(model.read_text() + SIMULATED.format(**told))
        with Contestant("gRPC", served(place), (0, 0)) as contestant:
            for number, callers in product(range(arguments.rounds), arguments.callers):
                load = Load(callers, arguments.seconds, (FRAMES, FRAMES), frame_px=FRAME_PX)
                measured = contestant.measure(load)
                of_each = callers / num_gpus
                evenly = num_gpus * of_each / max(lone_s, of_each * row_s)
                figures = {name: measured[name] for name in ("samples_per_s", "p50_ms", "p99_ms", "failed")}
                share = measured["samples_per_s"] / evenly
                row = {"GPUs": num_gpus, "callers": callers, "batch": f"up to {limit}", "round": number}
                rows.append({**row, "evenly": evenly, "share": share, **figures})
                print(f"{num_gpus} GPUs, up to {limit}, {callers} callers: {share:.0%} of {evenly:.0f}/s", flush=True)
    about = (
        "Samples/s of several GPUs\n"
        f"A forward pass sleeps for {arguments.lone_ms:g} ms, or {arguments.sample_ms:g} ms a sample if longer.\n"
        "evenly: the rate if each GPU always had its part of the callers. share: of that rate."
    )
    by = ("GPUs", "callers", "batch")
    report.write(f"gpus_lone_{arguments.lone_ms:g}ms", about, sorted(rows, key=_place), by, folder=arguments.output)


def _place(row: Row) -> tuple[Any, ...]:
    return row["GPUs"], row["callers"]


def episodes(arguments: argparse.Namespace, folder: Path) -> None:
    """Measure steps of parallel episodes: what is sent, encoded and refused."""
    rows: list[Row] = []
    num_gpus = max(arguments.gpus)
    ways = {
        "one server, references offered": (1, num_gpus, True),
        "one server, whole windows": (1, num_gpus, False),
        "a server for each GPU": (num_gpus, 1, True),
    }
    for way, (num_servers, instances, by_digest) in ways.items():
        place = folder / way.replace(" ", "_").replace(",", "")
        rfm_export.export(VLM_CHECKPOINT, place / "repository", SETTINGS)
        _as_for_gpus(place / "repository", instances, by_digest=by_digest)
        with ExitStack() as stack:
            ends = [
                stack.enter_context(temporary_server(place / "repository", place / f"{number}.log"))
                for number in range(num_servers)
            ]
            for number in range(arguments.rounds):
                figures = _stepped([end.grpc_url for end in ends], [end.metrics_url for end in ends], arguments, number)
                rows.append({"episodes": arguments.episodes, "way": way, "round": number, **figures})
                print(rows[-1], flush=True)
    about = (
        f"A step on {num_gpus} GPUs, each with a feature cache\n"
        f"Windows of {STEP_FRAMES} frames of {STEP_PX} x {STEP_PX}, {arguments.steps} steps.\n"
        "For each step of an episode: samples and KB sent, frames encoded, samples that were refused and sent whole."
    )
    report.write("gpus_episodes", about, rows, ("episodes", "way"), folder=arguments.output)


class Counting(GrpcTransport):
    """A connection to a server that counts samples and the bytes of inputs."""

    samples = num_bytes = 0

    async def infer(self, model: str, inputs: Any, outputs: Any, timeout_s: float, *, request_id: str = "") -> Answer:
        """Count the request, and send it."""
        self.samples += len(next(iter(inputs.values())))
        self.num_bytes += sum(array.nbytes for array in inputs.values())
        return await super().infer(model, inputs, outputs, timeout_s, request_id=request_id)


def _stepped(urls: Sequence[str], metrics: Sequence[str], arguments: argparse.Namespace, seed: int) -> dict[str, float]:
    """Return the cost of a step of an episode, with new noise for ``seed``."""
    transports = [Counting(url, Credentials(), shared_memory=False) for url in urls]
    random = np.random.default_rng(seed)
    shape = (arguments.episodes, STEP_PX, STEP_PX, 3)
    with RewardClient([], transports=transports) as client:
        growing = client.episodes(arguments.episodes, TASK, frames=STEP_FRAMES)
        encoded, refused = _encoded(metrics), _refused(metrics)
        began_s = time.perf_counter()
        for _ in range(arguments.steps):
            growing.add(random.integers(0, 256, shape, np.uint8))
        took_s = time.perf_counter() - began_s
    time.sleep(METRICS_S)
    count = arguments.episodes * arguments.steps
    return {
        "samples": sum(transport.samples for transport in transports) / count,
        "sent_kb": sum(transport.num_bytes for transport in transports) / count / 1e3,
        "encoded": (_encoded(metrics) - encoded) / count,
        "refused": (_refused(metrics) - refused) / count,
        "step_ms": took_s / arguments.steps * 1e3,
    }


def _encoded(metrics: Sequence[str]) -> float:
    return _total(metrics, r"rfm_frames_encoded_total\{[^}]*\}")


def _refused(metrics: Sequence[str]) -> float:
    return _total(metrics, r'rfm_samples_total\{[^}]*outcome="refused"[^}]*\}')


def _total(metrics: Sequence[str], series: str) -> float:
    texts = [urllib.request.urlopen(url, timeout=10).read().decode() for url in metrics]
    return sum(float(value) for text in texts for value in re.findall(rf"^{series} (\S+)$", text, re.MULTILINE))


def _as_for_gpus(repository: Path, instances: int, *, by_digest: bool) -> None:
    """Give an export for the CPU one instance and cache for each GPU."""
    (file,) = repository.glob("*/config.pbtxt")
    config = parse(file.read_text())
    config.instance_group[0].count = instances
    if not by_digest:
        kept = [tensor for tensor in config.input if tensor.name != wire.FRAME_DIGESTS]
        del config.input[:]
        config.input.extend(kept)
    file.write_text(render(config))


@contextmanager
def served(place: Path) -> Iterator[str]:
    """Serve a repository; yield the URL."""
    with temporary_server(place / "repository", place / "triton.log") as endpoints:
        yield endpoints.grpc_url


def main() -> None:
    """Read the command line, and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("batches", "episodes"))
    parser.add_argument("--gpus", type=int, nargs="+", default=[1, 2, 4], help="episodes: only the largest counts")
    parser.add_argument("--callers", type=int, nargs="+", default=[16, 32, 64])
    parser.add_argument("--max-batch", type=int, nargs="+", default=[64, 4], help="sizes of batches to compare")
    parser.add_argument("--lone-ms", type=float, default=50.0, help="shortest forward pass")
    parser.add_argument("--sample-ms", type=float, default=16.0)
    parser.add_argument("--episodes", type=int, default=8)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each load")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--output", type=Path, default=report.RESULTS, help="folder for the results")
    arguments = parser.parse_args()
    with TemporaryDirectory(prefix="rfm-bench-") as name:
        {"batches": batches, "episodes": episodes}[arguments.what](arguments, Path(name))


if __name__ == "__main__":
    sys.exit(main())
