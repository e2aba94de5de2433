# SPDX-License-Identifier: MIT
"""What a step of an RL loop costs: its bytes, the frames that are encoded for it, and its time.

    python benchmarks/episodes.py

Vectorised environments show frames of random pixels to the demo checkpoint with its encoders. ``window``: each step
sends the whole window of each environment to a server that keeps nothing, as before there were episodes. ``episode``:
``client.episodes``. ``resized``: the same with ``resize``. Each way has a server of its own; rounds are interleaved.
Counts of encoded frames are from the servers' metrics. Writes episodes.json, episodes.md and episodes.png.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from prometheus_client.parser import text_string_to_metric_families

from rfm.config import ExportConfig
from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints, TritonServer
from rfm_client import ProgressSample, RewardClient, Trajectory
from rfm_client.contract import wire
from rfm_client.contract.samples import UInt8Array
from rfm_client.data.sampling import Sampling
from rfm_client.transport.access import Access
from rfm_client.transport.calls import Answer, GrpcTransport
from rfm_export import export

RESULTS = Path(__file__).parent / "results"
DEMO = Path(__file__).parent.parent / "model_repository"
WINDOW, EPISODE, RESIZED = "window", "episode", "resized"
TASK = "put the red block on the plate"
TOLD_S = 1.0  # in which a model tells Triton what it has counted
MS_PER_S = 1e3


@dataclass(frozen=True)
class Step:
    """One step of all environments. num_bytes: of all inputs of its requests; ms: of the call"""

    t: int
    num_bytes: int
    ms: float


class Counting(GrpcTransport):
    """Counts the bytes of the inputs."""

    def __init__(self, url: str) -> None:
        super().__init__(url, Access(), shared_memory=False)
        self.num_bytes = 0

    async def infer(self, model: str, inputs: wire.Tensors, outputs: object, timeout_s: float, **more: str) -> Answer:
        """The real server's answer."""
        self.num_bytes += sum(array.nbytes for array in inputs.values())
        return await super().infer(model, inputs, outputs, timeout_s, **more)  # type: ignore[arg-type]


class Loop:
    """One way to ask, with a server of its own, during one run of all environments."""

    def __init__(self, way: str, endpoints: Endpoints, num_envs: int, frames: int) -> None:
        self.way, self.endpoints = way, endpoints
        self.transport = Counting(endpoints.grpc_url)
        self.client = RewardClient([], transports=[self.transport])
        self.steps: list[Step] = []
        self._sampling = Sampling("rint_pad", frames)
        self._episodes = self.client.episodes(num_envs, TASK, frames=frames, resize=way == RESIZED)
        self._kept: list[UInt8Array] = []

    def step(self, frames: UInt8Array) -> None:
        """One step of all environments, uint8 [N, H, W, 3]."""
        before, started_s = self.transport.num_bytes, time.perf_counter()
        if self.way == WINDOW:
            self._kept.append(frames)
            shown = [self._kept[index] for index in self._sampling.prefix(len(self._kept) - 1).indices]
            films = [np.stack([step[env] for step in shown]) for env in range(len(frames))]
            self.client.evaluate([ProgressSample(Trajectory(frames=film, task=TASK)) for film in films])
        else:
            self._episodes.add(frames)
        ms = (time.perf_counter() - started_s) * MS_PER_S
        self.steps.append(Step(len(self.steps), self.transport.num_bytes - before, ms))

    def num_encoded(self) -> float:
        """Frames that its server has encoded so far."""
        time.sleep(TOLD_S)
        with urllib.request.urlopen(self.endpoints.metrics_url, timeout=10) as answer:
            families = text_string_to_metric_families(answer.read().decode())
            return sum(s.value for family in families for s in family.samples if s.name == "rfm_frames_encoded_total")


@contextmanager
def servers(folder: Path) -> Iterator[dict[str, Endpoints]]:
    """A server for each way."""
    with ExitStack() as stack:
        started = {}
        for way in (WINDOW, EPISODE, RESIZED):
            encoders = DEMO / "rfm_encoder" / "1"
            settings = ExportConfig(
                num_gpus=0,
                image_encoder=str(encoders / "image_encoder"),
                text_encoder=str(encoders / "text_encoder"),
                **({"feature_cache_mb": 0} if way == WINDOW else {}),
            )
            export(DEMO / "rfm" / "1" / "checkpoint", folder / way, settings)
            log = stack.enter_context((folder / f"{way}.log").open("wb"))
            server = TritonServer(folder / way, Endpoints.free(), find_installation(), log=log)
            started[way] = stack.enter_context(server).endpoints
        yield started


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Runs all ways side by side, step by step."""
    rng = np.random.default_rng(0)
    height, width = arguments.size
    with tempfile.TemporaryDirectory() as folder, servers(Path(folder)) as endpoints:
        loops = [Loop(way, endpoints[way], arguments.envs, arguments.frames) for way in endpoints]
        before = {loop.way: loop.num_encoded() for loop in loops}
        for t in range(arguments.steps):
            frames = rng.integers(0, 256, (arguments.envs, height, width, 3), np.uint8)
            for loop in loops:
                if loop.way != WINDOW or t < arguments.window_steps:
                    loop.step(frames)
        encoded = {loop.way: loop.num_encoded() - before[loop.way] for loop in loops}
        for loop in loops:
            loop.client.close()
    late = slice(arguments.frames, None)  # whose windows are full
    return {
        "envs": arguments.envs,
        "size": [height, width],
        "frames": arguments.frames,
        "ways": {
            loop.way: {
                "steps": len(loop.steps),
                "bytes_a_step": statistics.median(step.num_bytes for step in loop.steps[late]),
                "ms_a_step": statistics.median(step.ms for step in loop.steps[late]),
                "encoded_a_step": encoded[loop.way] / len(loop.steps),
                "each_step": [asdict(step) for step in loop.steps],
            }
            for loop in loops
        },
    }


def write(results: dict[str, Any]) -> None:
    """Results as JSON, a table, and a curve of the cost of each step."""
    mpl.use("Agg")
    from matplotlib import pyplot

    (RESULTS / "episodes.json").write_text(json.dumps(results, indent=1) + "\n")
    ways: dict[str, dict[str, Any]] = results["ways"]
    whole = ways[WINDOW]

    def late(way: dict[str, Any]) -> list[dict[str, float]]:
        return way["each_step"][results["frames"] :]  # type: ignore[no-any-return]

    lines = [
        f"{results['envs']} environments, frames of {results['size']}, windows of {results['frames']}; medians of the "
        "steps whose window is full. Ratios are of `window`; of times: medians of those within a step.",
        "",
        "| way | bytes a step | ratio | ms a step | ratio | frames encoded a step |",
        "|---|---|---|---|---|---|",
    ]
    for name, way in ways.items():
        of_bytes = whole["bytes_a_step"] / way["bytes_a_step"]
        of_ms = statistics.median(
            before["ms"] / after["ms"] for before, after in zip(late(whole), late(way), strict=False)
        )
        numbers = f"{way['bytes_a_step']:,.0f} | 1/{of_bytes:.1f} | {way['ms_a_step']:.1f} | 1/{of_ms:.1f}"
        lines.append(f"| `{name}` | {numbers} | {way['encoded_a_step']:.2f} |")
    (RESULTS / "episodes.md").write_text("\n".join(lines) + "\n")
    figure, axes = pyplot.subplots(figsize=(7, 4), layout="constrained")
    for name, way in ways.items():
        steps = way["each_step"]
        axes.plot([step["t"] for step in steps], [step["ms"] for step in steps], label=name, linewidth=1)
    axes.set(xlabel="step", ylabel="ms a step, all environments", yscale="log")
    axes.legend()
    figure.savefig(RESULTS / "episodes.png", dpi=120)


def main() -> None:
    """Reads the arguments, measures, writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", type=int, default=8)
    parser.add_argument("--size", type=int, nargs=2, default=(400, 600), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--frames", type=int, default=16, help="of a window")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--window-steps", type=int, default=48, help="of the way that sends whole windows")
    write(measure(parser.parse_args()))
    print((RESULTS / "episodes.md").read_text())


if __name__ == "__main__":
    main()
