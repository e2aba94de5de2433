# SPDX-License-Identifier: MIT
"""What it costs to bring frames to the server: gRPC, HTTP, and each with shared memory, in one run.

The round trip's overhead is what is not the models' own computation: the round trip less what Triton's statistics
say that the models computed for it. Rounds of the four ways are interleaved, so that a drifting machine hits all alike.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
import tritonclient.grpc

from rfm_client import RewardClient, Trajectory

MS_PER_S = 1e3
NS_PER_MS = 1e6


def main() -> None:
    """Prints a row for each way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grpc", default="grpc://localhost:8001", help="gRPC address of the server")
    parser.add_argument("--http", default="http://localhost:8000", help="its HTTP address")
    parser.add_argument("--model", default="rfm", help="name under which the checkpoint was exported")
    parser.add_argument("--frames", type=int, default=16, help="frames of a trajectory")
    parser.add_argument("--size", default="480x640", help="their height x width")
    parser.add_argument("--rounds", type=int, default=200, help="requests each way")
    arguments = parser.parse_args()

    height, width = map(int, arguments.size.split("x"))
    frames = np.random.default_rng(0).integers(0, 256, (arguments.frames, height, width, 3), np.uint8)
    trajectory = Trajectory(frames=frames, task="stack the cups")
    clients = {
        f"{url.partition(':')[0]}{', shared memory' if shared else ''}": RewardClient(
            url, model=arguments.model, shared_memory=shared
        )
        for url in (arguments.grpc, arguments.http)
        for shared in (False, True)
    }
    computed_ms = _computed_ms(arguments.grpc, arguments.model)
    trips: dict[str, list[float]] = {way: [] for way in clients}
    overheads: dict[str, list[float]] = {way: [] for way in clients}
    for client in clients.values():
        client.progress(trajectory)
    for _ in range(arguments.rounds):
        for way, client in clients.items():
            before_ms, started_s = computed_ms(), time.perf_counter()
            client.progress(trajectory)
            trip_ms = (time.perf_counter() - started_s) * MS_PER_S
            trips[way].append(trip_ms)
            overheads[way].append(trip_ms - (computed_ms() - before_ms))
    for client in clients.values():
        client.close()

    print(
        f"{arguments.frames} frames of {arguments.size} ({frames.nbytes / 1e6:.1f} MB), medians of {arguments.rounds}"
    )
    plain = statistics.median(overheads["grpc"])
    for way in clients:
        trip, overhead = statistics.median(trips[way]), statistics.median(overheads[way])
        print(
            f"{way:20} round trip {trip:6.1f} ms, overhead {overhead:6.1f} ms, {overhead / plain:.2f} of plain gRPC's"
        )


def _computed_ms(url: str, model: str) -> Callable[[], float]:
    """Milliseconds that the checkpoint's models have computed so far; an ensemble's time is that of its parts."""
    client = tritonclient.grpc.InferenceServerClient(url.removeprefix("grpc://"))
    served = {entry.name for entry in client.get_inference_statistics().model_stats}
    parts = {model, f"{model}_encoder"} & served or {f"{model}_frames"}

    def read() -> float:
        return sum(
            version.inference_stats.compute_infer.ns / NS_PER_MS
            for part in parts
            for version in client.get_inference_statistics(part).model_stats
        )

    return read


if __name__ == "__main__":
    main()
