# SPDX-License-Identifier: MIT
"""Callers of one server, as a program. Reads a Load as a line of JSON from standard input, writes a line of JSON.

Closed loop: each caller makes a call and waits for the answer. Open loop: calls begin at random times (Poisson), even
while earlier answers are late, so that a slow answer does not hide the calls behind it. A latency counts from the time
when the call was due. Each caller stands for a separate client, so calls are not joined.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from collections.abc import AsyncIterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import asdict, dataclass

import aiohttp
import numpy as np
from peers import clients
from peers.clients import Ask

from rfm_client import (
    AsyncRewardClient,
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Result,
    RewardClient,
    Sample,
    SimilaritySample,
    Trajectory,
)

NUM_SAMPLES = 256
NUM_FILMED = 16
IN_FLIGHT = 4096  # more than any load needs, so that no client holds calls back
KEEP_ALIVE_S = 3.0  # peers close a connection after 5 idle seconds, perhaps just as a call reuses it
MS_PER_S = 1e3
PEERS = {
    "FastAPI": clients.fastapi_npy,
    "gateway": clients.fastapi_npy,
    "LitServe": lambda session, url: clients.by_msgpack(session, f"{url}/predict"),
    "mosec": lambda session, url: clients.by_msgpack(session, f"{url}/inference"),
}
SHARED_MEMORY, THREADS = "shared memory", "threads"  # ways; "threads": the blocking client in each thread


@dataclass(frozen=True)
class Load:
    """A load on a server. Either ``callers`` or ``rate_per_s`` is 0.

    callers: concurrent callers of the closed loop
    seconds: duration
    frames: least and greatest number of frames of a sample
    mixed: True: all three sample types in turn; False: only progress
    rate_per_s: calls a second of the open loop
    together: samples of a call
    frame_px: height and width of raw frames; 0: embeddings
    """

    callers: int
    seconds: float
    frames: tuple[int, int]
    mixed: bool = False
    rate_per_s: float = 0.0
    together: int = 1
    frame_px: int = 0


@dataclass(frozen=True)
class Measured:
    """Rate and latencies of calls under a load.

    samples_per_s: scored samples a second
    failed: number of samples without scores
    p50_ms, p99_ms: latencies of answered calls
    took_s: duration, up to the last answer
    """

    samples_per_s: float
    failed: int
    p50_ms: float
    p99_ms: float
    took_s: float


def samples(load: Load, video_dim: int, text_dim: int) -> list[Sample]:
    """Return the samples of a load, equal for every server. A pair has as many frames as a single trajectory."""
    random = np.random.default_rng(0)

    def trajectory(num_frames: int) -> Trajectory:
        if load.frame_px:
            frames = random.integers(0, 256, (num_frames, load.frame_px, load.frame_px, 3), np.uint8)
            return Trajectory(frames=frames, task="put the block in the bowl")
        return Trajectory(
            video_embeddings=random.standard_normal((num_frames, video_dim), np.float32),
            text_embedding=random.standard_normal(text_dim, np.float32),
        )

    made: list[Sample] = []
    for index in range(NUM_FILMED if load.frame_px else NUM_SAMPLES):
        num_frames = int(random.integers(load.frames[0], load.frames[1] + 1))
        kind = index % 3 if load.mixed and num_frames > 1 else 0
        if kind == 0:
            made.append(ProgressSample(trajectory(num_frames)))
        else:
            pair = trajectory(num_frames // 2), trajectory(num_frames - num_frames // 2)
            made.append(PreferenceSample(*pair) if kind == 1 else SimilaritySample(*pair))
    return made


@asynccontextmanager
async def connected(way: str, url: str) -> AsyncIterator[Ask]:
    """Yield a function that scores samples in one call."""
    if way in PEERS:
        async with aiohttp.ClientSession(
            connector=aiohttp.TCPConnector(limit=0, keepalive_timeout=KEEP_ALIVE_S)
        ) as session:
            yield PEERS[way](session, url)
        return
    if way == THREADS:
        with RewardClient(url, max_in_flight=IN_FLIGHT, retry=False) as blocking:

            async def ask_blocking(samples: Sequence[Sample]) -> list[float]:
                return [_score(result) for result in blocking.evaluate(samples)]

            yield ask_blocking
        return
    memory = way == SHARED_MEMORY
    async with AsyncRewardClient(url, shared_memory=memory, max_in_flight=IN_FLIGHT, retry=False) as client:

        async def ask(samples: Sequence[Sample]) -> list[float]:
            return [_score(result) for result in await client.evaluate(samples)]

        yield ask


def _score(result: Result) -> float:
    if isinstance(result, ProgressResult):
        return result.last_progress
    return result.preference if isinstance(result, PreferenceResult) else result.similarity


async def measure(ask: Ask, load: Load, asked: Sequence[Sample], *, threads: bool = False) -> Measured:
    """Apply a load to a server, with each caller in its own task or thread, and measure it."""
    latencies_s: list[float] = []
    failed = 0
    started_s = time.perf_counter()
    end_s = started_s + load.seconds

    async def answered(index: int, due_s: float) -> None:
        nonlocal failed
        try:
            await ask([asked[(index * load.together + i) % len(asked)] for i in range(load.together)])
            latencies_s.append(time.perf_counter() - due_s)
        except Exception:  # noqa: BLE001  every error counts as failed samples
            failed += load.together

    async def call(index: int) -> None:
        while time.perf_counter() < end_s:
            await answered(index, time.perf_counter())
            index += load.callers

    if load.rate_per_s:
        random = np.random.default_rng(1)
        due_s = started_s + np.cumsum(random.exponential(1 / load.rate_per_s, int(load.rate_per_s * load.seconds)))
        calls = []
        for index, moment_s in enumerate(due_s.tolist()):
            await asyncio.sleep(max(moment_s - time.perf_counter(), 0))
            calls.append(asyncio.create_task(answered(index, moment_s)))
        await asyncio.gather(*calls)
    elif threads:
        with ThreadPoolExecutor(load.callers) as pool:
            list(pool.map(lambda index: asyncio.run(call(index)), range(load.callers)))
    else:
        await asyncio.gather(*map(call, range(load.callers)))
    took_s = time.perf_counter() - started_s
    p50, p99 = np.percentile(latencies_s, [50, 99]) * MS_PER_S if latencies_s else (float("nan"),) * 2
    return Measured(len(latencies_s) * load.together / took_s, failed, float(p50), float(p99), took_s)


async def main(way: str, url: str, video_dim: int, text_dim: int) -> None:
    """Apply the loads from standard input until it ends."""
    async with connected(way, url) as ask:
        while line := await asyncio.to_thread(sys.stdin.readline):
            load = Load(**json.loads(line))
            asked = samples(load, video_dim, text_dim)
            for sample in asked[:3]:  # opens connections, and warms up each sample type
                await ask([sample])
            print(json.dumps(asdict(await measure(ask, load, asked, threads=way == THREADS))), flush=True)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])))
