# SPDX-License-Identifier: MIT
"""What a client costs, and what a served checkpoint answers. But for ``episodes``, the server runs already.

    client.py cost        CPU of the client's process a call: asyncio tasks or threads, gRPC or HTTP
    client.py payload     round trips of raw frames: gRPC, HTTP, and shared memory
    client.py episodes    a step of an RL loop: whole windows, episodes, episodes that resize; starts its own servers
    client.py throughput  samples/s of frames, 1, 8 and 32 samples asked together; how busy a GPU is

Rounds are interleaved: in each, every way is measured once, so that a machine that drifts hits all alike.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import re
import statistics
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import psutil
import report

from rfm_client import AsyncRewardClient, ProgressSample, RewardClient, Trajectory

MEASURE = "measure"  # the first word of a process that measures ``cost``
WAYS = [
    (protocol, style, callers)
    for protocol in ("gRPC", "HTTP")
    for style in ("asyncio", "threads")
    for callers in (1, 32)
]
DEMO = report.ROOT / "model_repository"
TASK = "put the red block on the plate"


def cost(arguments: argparse.Namespace) -> None:
    """Calls about one sample of 16 frames with embeddings, each way in a process of its own that stays connected."""
    rows = []
    with ExitStack() as stack:
        processes = []
        for protocol, style, callers in WAYS:
            url = arguments.grpc if protocol == "gRPC" else arguments.http
            words = [sys.executable, __file__, MEASURE, url, style, str(callers)]
            processes.append(subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
            stack.callback(processes[-1].communicate)
        for number in range(arguments.rounds + 1):  # the first one warms up
            for (protocol, style, callers), process in zip(WAYS, processes, strict=True):
                assert process.stdin is not None and process.stdout is not None
                process.stdin.write(f"{arguments.seconds}\n")
                process.stdin.flush()
                if number:
                    way = {"callers": callers, "way": f"{protocol}, {style}", "round": number}
                    rows.append(way | json.loads(process.stdout.readline()))
                else:
                    process.stdout.readline()
    report.write(
        "client_cost", f"What the client costs\n{cost.__doc__}", rows, ("callers", "way"), folder=arguments.output
    )


def measure_when_told(url: str, style: str, callers: int) -> None:
    """Answers a number of seconds, a line of standard input, with a measurement, a line of JSON."""
    with RewardClient(url) as client:
        info = client.model_info()
    random = np.random.default_rng(0)
    trajectories = [
        Trajectory(
            video_embeddings=random.standard_normal((16, info.video_dim or 1), np.float32),
            text_embedding=random.standard_normal(info.text_dim or 1, np.float32),
        )
        for _ in range(callers)
    ]
    latencies_s: list[float] = []
    end_s = 0.0

    def calls() -> Iterator[None]:
        while (before_s := time.perf_counter()) < end_s:
            yield
            latencies_s.append(time.perf_counter() - before_s)

    def tell(began_s: float, began_cpu_s: float) -> None:
        figures = {
            "cpu_us": (time.process_time() - began_cpu_s) / len(latencies_s) * 1e6,
            "samples_per_s": len(latencies_s) / (time.perf_counter() - began_s),
            "p50_ms": statistics.median(latencies_s) * 1e3,
        }
        print(json.dumps(figures), flush=True)

    async def by_tasks() -> None:
        nonlocal end_s

        async def ask(trajectory: Trajectory) -> None:
            for _ in calls():
                await client.score(ProgressSample(trajectory))

        async with AsyncRewardClient(url) as client:
            for line in sys.stdin:
                latencies_s.clear()
                began_s, began_cpu_s = time.perf_counter(), time.process_time()
                end_s = began_s + float(line)
                await asyncio.gather(*map(ask, trajectories))
                tell(began_s, began_cpu_s)

    if style == "asyncio":
        asyncio.run(by_tasks())
        return
    with RewardClient(url) as blocking:

        def ask(trajectory: Trajectory) -> None:
            for _ in calls():
                blocking.progress(trajectory)

        for line in sys.stdin:
            latencies_s.clear()
            began_s, began_cpu_s = time.perf_counter(), time.process_time()
            end_s = began_s + float(line)
            threads = [threading.Thread(target=ask, args=(trajectory,)) for trajectory in trajectories]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            tell(began_s, began_cpu_s)


def payload(arguments: argparse.Namespace) -> None:
    """Overhead: the round trip less what Triton's statistics say that the models computed for it."""
    frames = np.random.default_rng(0).integers(0, 256, (arguments.frames, *arguments.size, 3), np.uint8)
    trajectory, rows = Trajectory(frames=frames, task="stack the cups"), []
    computed_ms = _computed_ms(arguments.grpc)
    with ExitStack() as stack:
        clients = {}
        for name, url in (("gRPC", arguments.grpc), ("HTTP", arguments.http)):
            for shared in (False, True):
                client = RewardClient(url, model=arguments.model, shared_memory=shared)
                clients[name + ", shared memory" * shared] = stack.enter_context(client)
        for number in range(arguments.rounds + 1):
            for way, client in clients.items():
                before_ms, began_s = computed_ms(), time.perf_counter()
                client.progress(trajectory)
                trip_ms = (time.perf_counter() - began_s) * 1e3
                overhead_ms = trip_ms - (computed_ms() - before_ms)
                if number:
                    rows.append({"way": way, "round": number, "trip_ms": trip_ms, "overhead_ms": overhead_ms})
    told = f"Frames to the server: {frames.nbytes / 1e6:.1f} MB\n{payload.__doc__} Ratio: of the overhead."
    report.write("payload", told, rows, ("way",), "overhead_ms", arguments.output)


def _computed_ms(url: str) -> Callable[[], float]:
    """Milliseconds that all models of the server have computed so far; an ensemble's time is that of its parts."""
    import tritonclient.grpc

    client = tritonclient.grpc.InferenceServerClient(url.removeprefix("grpc://"))

    def read() -> float:
        models = client.get_inference_statistics().model_stats
        steps = [model for model in models if model.inference_stats.compute_infer.count]
        return sum(model.inference_stats.compute_infer.ns / 1e6 for model in steps)

    return read


def episodes(arguments: argparse.Namespace) -> None:
    """Random pixels of vectorised environments, the demo's checkpoint. sent_kb: on the loopback, in both directions."""
    from rfm.config import ExportConfig
    from rfm.launch.temporary import temporary_server
    from rfm_export import export

    rows, kept = [], []
    random = np.random.default_rng(0)
    with TemporaryDirectory(prefix="rfm-bench-") as name, ExitStack() as stack:
        ways = {}
        for way in ("windows", "episodes", "episodes, resized"):
            folders = {
                f"{kind}_encoder": str(DEMO / "rfm_encoder" / "1" / f"{kind}_encoder") for kind in ("image", "text")
            }
            cache = {"feature_cache_mb": 0} if way == "windows" else {}  # as before there were episodes
            export(DEMO / "rfm" / "1" / "checkpoint", Path(name) / way, ExportConfig(num_gpus=0, **folders, **cache))
            ends = stack.enter_context(temporary_server(Path(name) / way, Path(name) / f"{way}.log"))
            client = stack.enter_context(RewardClient(ends.grpc_url))
            resize = way == "episodes, resized"
            ways[way] = (
                client,
                client.episodes(arguments.envs, TASK, frames=arguments.frames, resize=resize),
                ends.metrics_url,
            )
        encoded = {way: _encoded(url) for way, (*_, url) in ways.items()}
        for number in range(arguments.rounds):
            frames = random.integers(0, 256, (arguments.envs, *arguments.size, 3), np.uint8)
            kept.append(frames)
            shown = np.rint(np.linspace(0, number, arguments.frames)).astype(int)
            for way, (client, growing, _) in ways.items():
                before, began_s = _loopback_bytes(), time.perf_counter()
                if way == "windows":
                    films = [np.stack([kept[step][env] for step in shown]) for env in range(arguments.envs)]
                    client.evaluate([ProgressSample(Trajectory(frames=film, task=TASK)) for film in films])
                else:
                    growing.add(frames)
                took_ms, sent = (time.perf_counter() - began_s) * 1e3, _loopback_bytes() - before
                if number >= arguments.frames:  # whose windows are full
                    rows.append({"way": way, "round": number, "ms": took_ms, "sent_kb": sent / 1e3})
        time.sleep(1)  # in which a model tells Triton what it has counted
        told = {way: (_encoded(url) - encoded[way]) / arguments.rounds for way, (*_, url) in ways.items()}
    about = (
        f"A step of {arguments.envs} environments\nWindows of {arguments.frames}. Encoded a step: {told}. Ratio: of ms."
    )
    report.write("episodes", about, rows, ("way",), "ms", arguments.output)


def _loopback_bytes() -> int:
    return int(psutil.net_io_counters(pernic=True)["lo"].bytes_sent)


def _encoded(metrics_url: str) -> float:
    return sum(_metric(metrics_url, "rfm_frames_encoded_total"))


def _metric(url: str, name: str) -> list[float]:
    with urllib.request.urlopen(url, timeout=10) as answer:
        return [
            float(value) for value in re.findall(rf"^{name}\{{[^}}]*\}} (\S+)$", answer.read().decode(), re.MULTILINE)
        ]


def throughput(arguments: argparse.Namespace) -> None:
    """Medians of rounds; collate and forward of the last sample's batch, as the server tells them."""
    random, rows = np.random.default_rng(0), []
    frames = [random.integers(0, 256, (8, 256, 256, 3), np.uint8) for _ in range(32)]
    samples = [ProgressSample(Trajectory(frames=film, task=f"task {index}")) for index, film in enumerate(frames)]
    with RewardClient(arguments.grpc, model=arguments.model, timeout_s=600) as client:
        client.evaluate(samples)  # warm
        for number in range(arguments.rounds):
            for count in (1, 8, 32):
                began_s = time.perf_counter()
                timing: Any = client.evaluate(samples[:count], timing=True)[-1].timing
                figures = {"samples_per_s": count / (time.perf_counter() - began_s)}
                figures |= {"collate_ms": timing.collate_ms, "forward_ms": timing.forward_ms}
                figures["gpu_busy"] = max(_metric(arguments.metrics, "nv_gpu_utilization"), default=float("nan"))
                rows.append({"way": f"{count} together", "round": number, **figures})
    report.write(
        "throughput", f"Frames of 256 x 256, 8 a sample\n{throughput.__doc__}", rows, ("way",), folder=arguments.output
    )


def main() -> None:
    """Measures, writes and shows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    programs = {each.__name__: each for each in (cost, payload, episodes, throughput)}
    parser.add_argument("what", choices=programs)
    parser.add_argument("--grpc", default="grpc://localhost:8001", help="gRPC address of the server")
    parser.add_argument("--http", default="http://localhost:8000", help="its HTTP address")
    parser.add_argument("--metrics", default="http://localhost:8002/metrics", help="of its metrics")
    parser.add_argument("--model", default="rfm")
    parser.add_argument("--rounds", type=int, help="9 of cost, 200 of payload, 48 steps of episodes, 5 of throughput")
    parser.add_argument("--seconds", type=float, default=1.0, help="of each measurement of cost")
    parser.add_argument("--frames", type=int, default=16, help="of a trajectory or window")
    parser.add_argument("--size", type=int, nargs=2, default=(480, 640), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--envs", type=int, default=8)
    parser.add_argument("--output", type=Path, default=report.RESULTS, help="folder for the results")
    arguments = parser.parse_args()
    arguments.rounds = arguments.rounds or {"cost": 9, "payload": 200, "episodes": 48, "throughput": 5}[arguments.what]
    programs[arguments.what](arguments)


if __name__ == "__main__":
    if sys.argv[1:2] == [MEASURE]:
        measure_when_told(sys.argv[2], sys.argv[3], int(sys.argv[4]))
    else:
        main()
