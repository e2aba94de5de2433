# SPDX-License-Identifier: MIT
"""Measure the cost of a client.

    client.py cost        CPU of the client's process a call, by tasks or threads, gRPC or HTTP; needs a server
    client.py episodes    a step of an RL loop: whole windows, episodes, resized episodes; starts its own servers

Each round measures every way once, so that drift of the machine affects all alike.
"""

from __future__ import annotations

import argparse
import re
import time
import urllib.request
from contextlib import ExitStack, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import psutil
import report
from contestants import DEMO, DEMO_ENCODERS, Contestant
from load import THREADS, Load

from rfm.config import ExportConfig
from rfm.launch.temporary import temporary_server
from rfm_client import ProgressSample, RewardClient, Trajectory
from rfm_export import export

TASK = "put the red block on the plate"


def cost(arguments: argparse.Namespace) -> None:
    """Calls with one sample, the embeddings of 16 frames. Each way has its own process, which stays connected."""
    rows = []
    with RewardClient(arguments.grpc) as client:
        info = client.model_info()
    with ExitStack() as stack:
        ways = {}
        for protocol, url in (("gRPC", arguments.grpc), ("HTTP", arguments.http)):
            for style, way in (("asyncio", protocol), ("threads", THREADS)):
                contestant = Contestant(way, nullcontext(url), (info.video_dim or 1, info.text_dim or 1))
                ways[f"{protocol}, {style}"] = stack.enter_context(contestant)
        for number in range(arguments.rounds + 1):  # round 0 warms up
            for callers in (1, 32):
                for way, contestant in ways.items():
                    told = contestant.measure(Load(callers, arguments.seconds, (16, 16)))
                    figures = {name: told[name] for name in ("client_us", "samples_per_s", "failed", "p50_ms")}
                    rows += [{"callers": callers, "way": way, "round": number, **figures}] if number else []
    about = f"What the client costs\n{cost.__doc__}"
    report.write("client_cost", about, rows, ("callers", "way"), folder=arguments.output)


def episodes(arguments: argparse.Namespace) -> None:
    """Measure environment steps with random pixels and the demo's checkpoint. sent_kb: loopback, both directions."""
    rows, kept = [], []
    random = np.random.default_rng(0)
    with TemporaryDirectory(prefix="rfm-bench-") as name, ExitStack() as stack:
        ways = {}
        for way in ("windows", "episodes", "episodes, resized"):
            cache = {"feature_cache_mib": 0} if way == "windows" else {}  # windows alone, as before episodes existed
            settings = ExportConfig(num_gpus=0, **DEMO_ENCODERS, **cache)
            repository = Path(name) / way.replace(", ", "_")  # Triton accepts no path with spaces
            export(DEMO / "rfm" / "1" / "checkpoint", repository, settings)
            ends = stack.enter_context(temporary_server(repository, repository.with_suffix(".log")))
            client = stack.enter_context(RewardClient(ends.grpc_url))
            growing = client.episodes(arguments.envs, TASK, frames=arguments.frames, resize="resized" in way)
            ways[way] = client, growing, ends.metrics_url
        encoded = {way: _encoded(url) for way, (*_, url) in ways.items()}
        for number in range(arguments.rounds):
            frames = random.integers(0, 256, (arguments.envs, *arguments.size, 3), np.uint8)
            kept.append(frames)
            shown = np.rint(np.linspace(0, number, arguments.frames)).astype(int)
            for way, (client, growing, _) in ways.items():
                before, began_s = _loopback_bytes(), time.perf_counter()
                if way == "windows":
                    videos = [np.stack([kept[step][env] for step in shown]) for env in range(arguments.envs)]
                    client.evaluate([ProgressSample(Trajectory(frames=video, task=TASK)) for video in videos])
                else:
                    growing.add(frames)
                took_ms, sent = (time.perf_counter() - began_s) * 1e3, _loopback_bytes() - before
                if number >= arguments.frames:  # from here on, windows are full
                    rows.append({"way": way, "round": number, "ms": took_ms, "sent_kb": sent / 1e3})
        time.sleep(1)  # until models have reported their counts to Triton
        told = {way: (_encoded(url) - encoded[way]) / arguments.rounds for way, (*_, url) in ways.items()}
    about = f"A step of {arguments.envs} environments\nWindows of {arguments.frames}. Encoded a step: {told}."
    report.write("episodes", f"{about} Ratio: of ms.", rows, ("way",), "ms", arguments.output)


def _loopback_bytes() -> int:
    return int(psutil.net_io_counters(pernic=True)["lo"].bytes_sent)


def _encoded(metrics_url: str) -> float:
    return sum(_metric(metrics_url, "rfm_frames_encoded_total"))


def _metric(url: str, name: str) -> list[float]:
    with urllib.request.urlopen(url, timeout=10) as answer:
        text = answer.read().decode()
    return [float(value) for value in re.findall(rf"^{name}\{{[^}}]*\}} (\S+)$", text, re.MULTILINE)]


def main() -> None:
    """Run the chosen benchmark, then write and print its results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    programs = {each.__name__: each for each in (cost, episodes)}
    parser.add_argument("what", choices=programs)
    parser.add_argument("--grpc", default="grpc://localhost:8001", help="gRPC address of the server")
    parser.add_argument("--http", default="http://localhost:8000", help="its HTTP address")
    parser.add_argument("--rounds", type=int, help="9 of cost, 48 steps of episodes")
    parser.add_argument("--seconds", type=float, default=1.0, help="of each measurement of cost")
    parser.add_argument("--frames", type=int, default=16, help="of a window")
    parser.add_argument("--size", type=int, nargs=2, default=(400, 600), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--envs", type=int, default=8)
    parser.add_argument("--output", type=Path, default=report.RESULTS, help="folder for the results")
    arguments = parser.parse_args()
    arguments.rounds = arguments.rounds or {"cost": 9, "episodes": 48}[arguments.what]
    programs[arguments.what](arguments)


if __name__ == "__main__":
    main()
