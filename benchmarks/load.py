# SPDX-License-Identifier: MIT
"""Program that calls one server. Reads each Load as a JSON line from standard input, and writes Calls as a JSON line.

Closed loop: each caller makes a call and waits for the answer. Open loop: calls begin at random times (Poisson), even
while earlier answers are late, so that a slow answer does not hide the calls behind it. Latency counts from the time
when the call was due. Each caller stands for a separate client, so calls are not joined.

Raw frames are distinct by default: no frame repeats, so the server's cache never has a frame's features.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import sys
import time
from collections.abc import AsyncIterator, Callable, Sequence
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
    Sample,
    SimilaritySample,
    Trajectory,
)

NUM_SAMPLES = 256
NUM_FILMED = 16  # distinct raw frame samples in a load that repeats them
IN_FLIGHT = 4096  # more than any load needs, so that clients never hold calls back
KEEP_ALIVE_S = 3.0  # peers close a connection after 5 idle seconds, perhaps just as a call reuses it
MS_PER_S = 1e3
PEERS = {
    "FastAPI": clients.fastapi_npy,
    "gateway": clients.fastapi_npy,
    "mosec": lambda session, url: clients.by_msgpack(session, f"{url}/inference"),
}
SHARED_MEMORY = "shared memory"  # a way


@dataclass(frozen=True)
class Load:
    """A load on a server. Either ``callers`` or ``rate_per_s`` is 0.

    callers: concurrent callers in the closed loop
    seconds: duration
    frames: smallest and largest frame count per sample
    mixed: True: all three sample types in turn; False: only progress
    rate_per_s: calls per second in the open loop
    together: samples per call
    frame_px: raw frame height and width; None: embeddings
    repeated: True: cycle through NUM_FILMED raw frame samples; False: each frame is new
    warm_up_s: time before calls count
    """

    callers: int
    seconds: float
    frames: tuple[int, int]
    mixed: bool = False
    rate_per_s: float = 0.0
    together: int = 1
    frame_px: tuple[int, int] | None = None
    repeated: bool = False
    warm_up_s: float = 0.0


@dataclass(frozen=True)
class Calls:
    """One process's calls after the warm-up.

    latencies_s: for answered calls
    failed: samples without scores
    took_s: duration, up to the last answer
    """

    latencies_s: Sequence[float]
    failed: int
    took_s: float


@dataclass(frozen=True)
class Measured:
    """Call rate and latencies under a load.

    samples_per_s: scored samples per second
    failed: samples without scores
    p50_ms, p99_ms: latencies for answered calls
    took_s: duration, up to the last answer
    """

    samples_per_s: float
    failed: int
    p50_ms: float
    p99_ms: float
    took_s: float

    @classmethod
    def of(cls, calls: Sequence[Calls], together: int = 1) -> Measured:
        """Combine the results from processes that called at the same time. together: samples per call."""
        latencies_s = [latency_s for each in calls for latency_s in each.latencies_s]
        rate = sum(len(each.latencies_s) * together / each.took_s for each in calls)
        p50, p99 = np.percentile(latencies_s, [50, 99]) * MS_PER_S if latencies_s else (float("nan"),) * 2
        failed, took_s = sum(each.failed for each in calls), max(each.took_s for each in calls)
        return cls(rate, failed, float(p50), float(p99), took_s)


def samples(load: Load, video_dim: int, text_dim: int) -> Callable[[int], Sample]:
    """Return a function that makes a sample from its number.

    Embeddings are equal for every server. A pair has as many frames as a single trajectory.
    """
    random = np.random.default_rng(0)
    lengths = random.integers(load.frames[0], load.frames[1] + 1, NUM_SAMPLES).tolist()
    trajectory = _filmed(load) if load.frame_px else _embedded(random, video_dim, text_dim)

    def made(index: int) -> Sample:
        num_frames = lengths[index % NUM_SAMPLES]
        kind = index % 3 if load.mixed and num_frames > 1 else 0
        if kind == 0:
            return ProgressSample(trajectory(index, 0, num_frames))
        half = num_frames // 2
        pair = trajectory(index, 0, half), trajectory(index, half, num_frames - half)
        return PreferenceSample(*pair) if kind == 1 else SimilaritySample(*pair)

    if load.frame_px:
        return made
    kept = [made(index) for index in range(NUM_SAMPLES)]
    return lambda index: kept[index % NUM_SAMPLES]


def _embedded(random: np.random.Generator, video_dim: int, text_dim: int) -> Callable[[int, int, int], Trajectory]:
    def trajectory(_index: int, _first: int, num_frames: int) -> Trajectory:
        return Trajectory(
            video_embeddings=random.standard_normal((num_frames, video_dim), np.float32),
            text_embedding=random.standard_normal(text_dim, np.float32),
        )

    return trajectory


def _filmed(load: Load) -> Callable[[int, int, int], Trajectory]:
    """Return a function that makes a trajectory from a sample's number, its first frame and its frame count.

    Frames are views into random bytes. Each video starts one byte after the previous one, so a frame costs nothing.
    """
    assert load.frame_px is not None
    size = 3 * load.frame_px[0] * load.frame_px[1]
    pool = np.random.default_rng().integers(0, 256, (load.frames[1] + 1) * size, np.uint8)
    shifts = itertools.count()

    def trajectory(index: int, first: int, num_frames: int) -> Trajectory:
        begin = first * size + (index % NUM_FILMED if load.repeated else next(shifts) % size)
        frames = pool[begin : begin + num_frames * size].reshape(num_frames, *load.frame_px, 3)
        return Trajectory(frames=frames, task="put the block in the bowl")

    return trajectory


@asynccontextmanager
async def connected(way: str, url: str) -> AsyncIterator[Ask]:
    """Yield a function that scores samples in one call."""
    if way in PEERS:
        async with aiohttp.ClientSession(
            connector=aiohttp.TCPConnector(limit=0, keepalive_timeout=KEEP_ALIVE_S)
        ) as session:
            yield PEERS[way](session, url)
        return
    memory = way == SHARED_MEMORY
    async with AsyncRewardClient(url, shared_memory=memory, max_in_flight=IN_FLIGHT, retry=False) as client:

        async def ask(samples: Sequence[Sample]) -> list[float]:
            return [_score(result) for result in await client.evaluate(samples)]

        yield ask


def _score(result: Result) -> float:
    if isinstance(result, ProgressResult):
        seconds = getattr(result, "remaining_s", None)  # from RynnValue; older commits lack it
        return result.last_progress if seconds is None else float(seconds[-1])
    return result.preference if isinstance(result, PreferenceResult) else result.similarity


async def measure(ask: Ask, load: Load, sample: Callable[[int], Sample]) -> Calls:
    """Apply a load to a server, with each caller in its own task, and measure it."""
    latencies_s: list[float] = []
    failed = 0
    started_s = time.perf_counter() + load.warm_up_s
    end_s = started_s + load.seconds

    async def answered(index: int, due_s: float) -> None:
        nonlocal failed
        try:
            await ask([sample(index * load.together + i) for i in range(load.together)])
            now_s = time.perf_counter()
            if now_s > started_s:
                latencies_s.append(now_s - due_s)
        except Exception as error:  # noqa: BLE001  every error counts as failed samples
            if not failed:
                print(f"first error: {error!r:.500}", file=sys.stderr)
            failed += load.together

    async def call(index: int) -> None:
        while time.perf_counter() < end_s:
            await answered(index, time.perf_counter())
            index += load.callers

    if load.rate_per_s:
        random = np.random.default_rng(1)
        num_calls = int(load.rate_per_s * (load.warm_up_s + load.seconds))
        due_s = started_s - load.warm_up_s + np.cumsum(random.exponential(1 / load.rate_per_s, num_calls))
        calls = []
        for index, moment_s in enumerate(due_s.tolist()):
            await asyncio.sleep(max(moment_s - time.perf_counter(), 0))
            calls.append(asyncio.create_task(answered(index, moment_s)))
        await asyncio.gather(*calls)
    else:
        await asyncio.gather(*map(call, range(load.callers)))
    return Calls(latencies_s, failed, time.perf_counter() - started_s)


async def main(way: str, url: str, video_dim: int, text_dim: int) -> None:
    """Apply loads from standard input until it ends."""
    async with connected(way, url) as ask:
        while line := await asyncio.to_thread(sys.stdin.readline):
            load = Load(**json.loads(line))
            sample = samples(load, video_dim, text_dim)
            for index in range(3):  # opens connections, and warms up each sample type
                await ask([sample(index)])
            print(json.dumps(asdict(await measure(ask, load, sample))), flush=True)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])))
