# SPDX-License-Identifier: MIT
"""What the Python client costs: CPU of its process for each request.

    rfm serve --repository model_repository
    python benchmarks/client_cost.py

Callers ask about one sample with embeddings at a time, as asyncio tasks or as threads of one process. Rounds are
interleaved: in each, every way is measured once, by a process of its own that stays connected, so that a machine that
drifts hits all alike. Writes client_cost.json and client_cost.md.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from rfm_client import AsyncRewardClient, ProgressSample, RewardClient, Trajectory

RESULTS = Path(__file__).parent / "results"
NUM_FRAMES = 16
NUM_SAMPLES = 64
MS_PER_S, US_PER_S = 1e3, 1e6
MEASURE = "measure"  # the first word of a process that measures


@dataclass(frozen=True)
class Way:
    """How the server is asked. style: asyncio or threads"""

    protocol: str
    style: str
    callers: int


@dataclass(frozen=True)
class Measured:
    """cpu_us: of this process for a call; samples_per_s: answered"""

    cpu_us: float
    samples_per_s: float
    p50_ms: float


class Clock:
    """Times calls until the end of a window."""

    def __init__(self, seconds: float) -> None:
        self._cpu_s = time.process_time()
        self._started_s = time.perf_counter()
        self._end_s = self._started_s + seconds
        self._latencies_s: list[float] = []

    def calls(self) -> Iterator[None]:
        """One turn a call of one caller, until the window ends."""
        while (before_s := time.perf_counter()) < self._end_s:
            yield
            self._latencies_s.append(time.perf_counter() - before_s)

    def measured(self) -> Measured:
        """What the calls took."""
        count = len(self._latencies_s)
        cpu_us = (time.process_time() - self._cpu_s) / count * US_PER_S
        rate = count / (time.perf_counter() - self._started_s)
        return Measured(cpu_us, rate, statistics.median(self._latencies_s) * MS_PER_S)


class Process:
    """A process that measures one way, when it is told to."""

    def __init__(self, way: Way, url: str) -> None:
        words = [sys.executable, __file__, MEASURE, json.dumps(asdict(way)), url]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def measure(self, seconds: float) -> Measured:
        """Raises RuntimeError if the process ends."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(f"{seconds}\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"expected a measurement, got exit status {self._process.wait()}")
        return Measured(**json.loads(line))

    def close(self) -> None:
        """Ends the process."""
        self._process.communicate()


def measure_when_told(way: Way, url: str) -> None:
    """Answers a number of seconds, a line of standard input, with a measurement, a line of JSON."""
    samples = _samples(url)
    if way.style == "threads":
        with RewardClient(url) as client:
            for line in sys.stdin:
                print(json.dumps(asdict(_by_threads(client, way.callers, samples, float(line)))), flush=True)
        return

    async def measure() -> None:
        async with AsyncRewardClient(url) as client:
            for line in sys.stdin:
                print(json.dumps(asdict(await _by_tasks(client, way.callers, samples, float(line)))), flush=True)

    asyncio.run(measure())


def _samples(url: str) -> list[ProgressSample]:
    """In the widths of the model, which a client of its own asks for."""
    with RewardClient(url) as client:
        info = client.model_info()
    assert info.video_dim is not None and info.text_dim is not None
    random = np.random.default_rng(0)
    return [
        ProgressSample(
            Trajectory(
                video_embeddings=random.standard_normal((NUM_FRAMES, info.video_dim), np.float32),
                text_embedding=random.standard_normal(info.text_dim, np.float32),
            )
        )
        for _ in range(NUM_SAMPLES)
    ]


async def _by_tasks(
    client: AsyncRewardClient, callers: int, samples: Sequence[ProgressSample], seconds: float
) -> Measured:
    clock = Clock(seconds)

    async def ask(sample: ProgressSample) -> None:
        for _ in clock.calls():
            await client.score(sample)

    await asyncio.gather(*(ask(samples[number % len(samples)]) for number in range(callers)))
    return clock.measured()


def _by_threads(client: RewardClient, callers: int, samples: Sequence[ProgressSample], seconds: float) -> Measured:
    clock = Clock(seconds)

    def ask(sample: ProgressSample) -> None:
        for _ in clock.calls():
            client.progress(sample.trajectory)

    threads = [threading.Thread(target=ask, args=(samples[number % len(samples)],)) for number in range(callers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return clock.measured()


def measure_all(ways: Sequence[Way], urls: dict[str, str], rounds: int, seconds: float) -> dict[Way, list[Measured]]:
    """A measurement of each way in each round, after one that is not counted."""
    rows: dict[Way, list[Measured]] = {way: [] for way in ways}
    with ExitStack() as stack:
        processes = {}
        for way in ways:
            processes[way] = Process(way, urls[way.protocol])
            stack.callback(processes[way].close)
        for number in range(rounds + 1):
            for way, process in processes.items():
                measured = process.measure(seconds)
                if number:
                    rows[way].append(measured)
    return rows


def table(rows: dict[Way, list[Measured]]) -> list[str]:
    """Medians of each way."""

    def median(way: Way, column: str) -> str:
        values = [getattr(measured, column) for measured in rows[way]]
        digits = 2 if column == "p50_ms" else 0
        return f"{statistics.median(values):.{digits}f} ({min(values):.{digits}f}..{max(values):.{digits}f})"

    lines = [
        "| | callers | CPU us a call | samples/s | p50 ms |",
        "|---|---|---|---|---|",
    ]
    for way in rows:
        medians = [median(way, column) for column in ("cpu_us", "samples_per_s", "p50_ms")]
        cells = [f"{way.protocol}, {way.style}", str(way.callers), *medians]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def main() -> None:
    """Measures, writes and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grpc", default="grpc://localhost:8001", help="gRPC address of the server")
    parser.add_argument("--http", default="http://localhost:8000", help="its HTTP address")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=1.0, help="of each measurement")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder for the results")
    options = parser.parse_args()
    ways = [
        Way(protocol, style, callers)
        for protocol in ("gRPC", "HTTP")
        for style in ("asyncio", "threads")
        for callers in (1, 32)
    ]
    rows = measure_all(ways, {"gRPC": options.grpc, "HTTP": options.http}, options.rounds, options.seconds)
    lines = [
        "# What the client costs",
        "",
        f"Calls about one sample of {NUM_FRAMES} frames with embeddings. CPU is that of the client's process, in user "
        f"and kernel. Medians of {options.rounds} interleaved rounds of {options.seconds:g} s, with the smallest and "
        "largest. The server runs on the same cores.",
        "",
        *table(rows),
    ]
    options.output.mkdir(parents=True, exist_ok=True)
    measured = [{**asdict(way), "rounds": [asdict(one) for one in of_way]} for way, of_way in rows.items()]
    (options.output / "client_cost.json").write_text(json.dumps(measured, indent=1) + "\n")
    (options.output / "client_cost.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    if sys.argv[1:2] == [MEASURE]:
        measure_when_told(Way(**json.loads(sys.argv[2])), sys.argv[3])
    else:
        main()
