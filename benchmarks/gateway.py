# SPDX-License-Identifier: MIT
"""What the gateway costs: samples a second through its npy endpoint and by gRPC, in one run.

Each caller asks about one sample at a time and waits for the answer. Rounds of the two ways are interleaved, so that a
drifting machine hits both alike. Callers of the gateway are as the FastAPI evaluation server's own client: a .npy file
and a form a request.
"""

from __future__ import annotations

import argparse
import asyncio
import io
import json
import statistics
import time
from collections.abc import Awaitable, Callable

import aiohttp
import numpy as np

from rfm_client import AsyncRewardClient, Trajectory

Ask = Callable[[Trajectory], Awaitable[float]]


async def main() -> None:
    """Prints a row for each way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grpc", default="grpc://localhost:8001", help="gRPC address of the server")
    parser.add_argument("--gateway", default="http://localhost:8100", help="address of its gateway")
    parser.add_argument("--model", default="rfm", help="name under which the checkpoint was exported")
    parser.add_argument("--callers", type=int, default=32, help="at a time")
    parser.add_argument("--frames", type=int, default=16, help="frames of a trajectory")
    parser.add_argument("--rounds", type=int, default=7, help="of each way")
    parser.add_argument("--seconds", type=float, default=5.0, help="of a round")
    arguments = parser.parse_args()

    async with (
        AsyncRewardClient(arguments.grpc, model=arguments.model) as client,
        aiohttp.ClientSession(connector=aiohttp.TCPConnector(limit=0)) as session,
    ):
        info = await client.model_info()
        assert info.video_dim is not None and info.text_dim is not None
        random = np.random.default_rng(0)
        trajectories = [
            Trajectory(
                video_embeddings=random.standard_normal((arguments.frames, info.video_dim), np.float32),
                text_embedding=random.standard_normal(info.text_dim, np.float32),
            )
            for _ in range(arguments.callers)
        ]

        async def by_grpc(trajectory: Trajectory) -> float:
            return (await client.progress(trajectory)).last_progress

        async def by_gateway(trajectory: Trajectory) -> float:
            async with session.post(f"{arguments.gateway}/evaluate_batch_npy", data=_form(trajectory)) as answer:
                answer.raise_for_status()
                outputs = await answer.json()
            return float(outputs["outputs_progress"]["progress_pred"][0][-1])

        ways: dict[str, Ask] = {"gRPC": by_grpc, "gateway": by_gateway}
        for trajectory in trajectories:
            scores = [await ask(trajectory) for ask in ways.values()]
            assert max(scores) - min(scores) < 1e-5, scores
        rates: dict[str, list[float]] = {way: [] for way in ways}
        for _ in range(arguments.rounds):
            for way, ask in ways.items():
                rates[way].append(await _rate(ask, trajectories, arguments.seconds))
    print(f"{arguments.callers} callers, one sample of {arguments.frames} frames at a time")
    for way, measured in rates.items():
        print(f"{way:8} {statistics.median(measured):7.0f} samples/s ({min(measured):.0f}..{max(measured):.0f})")
    ratio = statistics.median(by / direct for by, direct in zip(rates["gateway"], rates["gRPC"], strict=True))
    print(f"gateway / gRPC: {ratio:.2f} (median of {arguments.rounds} rounds)")


def _form(trajectory: Trajectory) -> aiohttp.FormData:
    """One request, as the evaluation server's client writes it."""
    form = aiohttp.FormData()
    places = {}
    for name in ("video_embeddings", "text_embedding"):
        file = io.BytesIO()
        np.save(file, getattr(trajectory, name))
        key = f"sample_0_trajectory_{name}"
        form.add_field(key, file.getvalue(), filename=f"{key}.npy", content_type="application/octet-stream")
        places[name] = {"__numpy_file__": key}
    form.add_field("sample_0", json.dumps({"sample_type": "progress", "trajectory": places}))
    return form


async def _rate(ask: Ask, trajectories: list[Trajectory], seconds: float) -> float:
    """Samples a second; each trajectory has a caller of its own."""
    started_s = time.perf_counter()
    done = 0

    async def call(trajectory: Trajectory) -> None:
        nonlocal done
        while time.perf_counter() - started_s < seconds:
            await ask(trajectory)
            done += 1

    await asyncio.gather(*map(call, trajectories))
    return done / (time.perf_counter() - started_s)


if __name__ == "__main__":
    asyncio.run(main())
