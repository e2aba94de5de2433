# SPDX-License-Identifier: MIT
"""Callers for the fault suite: they ask a server on and on, compare every answer, and count what became of each call."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from array import array
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np

from rfm.engine import Engine
from rfm_client import (
    AsyncRewardClient,
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    RewardError,
    Sample,
    SimilaritySample,
    Trajectory,
)
from rfm_gateway.scoring import FRAME_STEPS

TOLERANCE = 1e-5  # of numbers up to 1; of a larger one, which only similarity can be, this share of it
PATIENCE_S = 60.0
PAUSE_S = 0.1  # of a caller that was refused
VIDEO_DIM, TEXT_DIM = 64, 32  # of the demo's checkpoint
MOST_FRAMES = 32
NUM_SAMPLES = 48

Numbers = np.ndarray[Any, np.dtype[np.float32]]
Ask = Callable[[Sample], Awaitable[Numbers]]
Connect = Callable[[], AbstractAsyncContextManager[Ask]]


class RefusedError(Exception):
    """The gateway told the caller at once that this call is not answered."""


class BrokenOffError(Exception):
    """The connection ended before the answer."""


@dataclass(frozen=True)
class Exam:
    """Samples, and what the engine answers without a server."""

    samples: Sequence[Sample]
    expected: Sequence[Numbers]

    @classmethod
    def of(cls, checkpoint: Path, samples: Sequence[Sample]) -> Exam:
        """What this checkpoint says of the samples."""
        outcomes = Engine.from_checkpoint(checkpoint).evaluate(samples)
        return cls(samples, [numbers(outcome) for outcome in outcomes])

    def is_right(self, number: int, got: Numbers) -> bool:
        """Whether an answer is the engine's; NaN never is."""
        expected = self.expected[number]
        if got.shape != expected.shape:
            return False
        return bool((np.abs(got - expected) <= TOLERANCE * np.maximum(1, np.abs(expected))).all())


def trajectory(random: np.random.Generator, num_frames: int) -> Trajectory:
    """Of noise."""
    return Trajectory(
        video_embeddings=random.standard_normal((num_frames, VIDEO_DIM), np.float32),
        text_embedding=random.standard_normal(TEXT_DIM, np.float32),
    )


def mixed_samples() -> list[Sample]:
    """All types, several lengths."""
    random = np.random.default_rng(0)
    samples: list[Sample] = []
    for index in range(NUM_SAMPLES):
        num_frames = int(random.integers(1, MOST_FRAMES // 2 + 1))
        first, second = trajectory(random, num_frames), trajectory(random, MOST_FRAMES // 2 - num_frames + 1)
        kinds = (ProgressSample(first), PreferenceSample(first, second), SimilaritySample(first, second))
        samples.append(kinds[index % len(kinds)])
    return samples


def progress_samples() -> list[Sample]:
    """Of one type, several lengths."""
    random = np.random.default_rng(1)
    return [ProgressSample(trajectory(random, 1 + index % MOST_FRAMES)) for index in range(NUM_SAMPLES)]


def numbers(result: object) -> Numbers:
    """All scores of a result, one after the other."""
    if isinstance(result, ProgressResult):
        return np.concatenate([result.progress, result.success])
    if isinstance(result, PreferenceResult):
        return np.concatenate([[result.preference], result.first.progress, result.second.progress])
    if isinstance(result, RewardError):
        raise result
    return np.concatenate([[result.similarity], result.reference.progress, result.other.progress])  # type: ignore[attr-defined]


def direct(url: str) -> Connect:
    """The client as it is by default."""

    @asynccontextmanager
    async def connect() -> AsyncIterator[Ask]:
        async with AsyncRewardClient(url) as client:

            async def ask(sample: Sample) -> Numbers:
                return numbers(await client.score(sample))

            yield ask

    return connect


def through_gateway(url: str) -> Connect:
    """A caller of the FastAPI server: progress samples as JSON. A 503 is a refusal."""

    @asynccontextmanager
    async def connect() -> AsyncIterator[Ask]:
        bodies: dict[int, bytes] = {}  # by sample
        connector, timeout = aiohttp.TCPConnector(limit=0), aiohttp.ClientTimeout(PATIENCE_S)
        headers = {"Content-Type": "application/json"}
        async with aiohttp.ClientSession(connector=connector, timeout=timeout, headers=headers) as session:

            async def ask(sample: Sample) -> Numbers:
                if id(sample) not in bodies:
                    bodies[id(sample)] = _body(sample)
                try:
                    async with session.post(f"{url}/evaluate_batch", data=bodies[id(sample)]) as answer:
                        if answer.status == 503:
                            raise RefusedError
                        answer.raise_for_status()
                        outputs = await answer.json()
                except (aiohttp.ClientConnectionError, aiohttp.ClientPayloadError) as error:
                    raise BrokenOffError from error
                progress, success = outputs["outputs_progress"]["progress_pred"], outputs["outputs_success"]
                return np.array([*progress[0], *success["success_probs"][0]], np.float32)

            yield ask

    return connect


def _body(sample: Sample) -> bytes:
    """Of the request that asks for it."""
    (only,) = sample.trajectories
    assert isinstance(sample, ProgressSample)
    assert sample.frame_steps in (0, FRAME_STEPS)
    assert only.video_embeddings is not None
    assert only.text_embedding is not None
    arrays = {"video_embeddings": only.video_embeddings.tolist(), "text_embedding": only.text_embedding.tolist()}
    samples = [{"sample_type": "progress", "trajectory": arrays}]
    return json.dumps({"samples": samples, "use_frame_steps": sample.frame_steps > 0}).encode()


@dataclass
class Tally:
    """What became of calls. Times in seconds; a latency counts from when its call was due."""

    exam: Exam
    asked: int = 0
    answered: int = 0
    refused: int = 0
    wrong: int = 0
    broken_off: int = 0
    lost: list[str] = field(default_factory=list)
    latencies_s: array[float] = field(default_factory=lambda: array("d"))  # of answered calls

    @property
    def p99_s(self) -> float:
        """Of answered calls."""
        return float(np.percentile(self.latencies_s, 99))

    async def call(self, ask: Ask, number: int, due_s: float) -> bool:
        """Asks, and counts; whether there was an answer."""
        number %= len(self.exam.samples)
        self.asked += 1
        try:
            got = await ask(self.exam.samples[number])
        except RefusedError:
            self.refused += 1
            return False
        except BrokenOffError:
            self.broken_off += 1
            return False
        except Exception as error:  # noqa: BLE001  whatever it is, the call is lost
            self.lost.append(repr(error))
            return False
        self.latencies_s.append(time.perf_counter() - due_s)
        self.answered += 1
        self.wrong += not self.exam.is_right(number, got)
        return True

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.exam,
            self.asked + other.asked,
            self.answered + other.answered,
            self.refused + other.refused,
            self.wrong + other.wrong,
            self.broken_off + other.broken_off,
            self.lost + other.lost,
            self.latencies_s + other.latencies_s,
        )


class Callers:
    """So many callers, each with one call at a time, in a thread of their own. A context manager.

    interval_s: a caller's calls are due so far apart; 0: it asks again at once
    """

    def __init__(self, connect: Connect, exam: Exam, count: int, *, interval_s: float = 0.0) -> None:
        self.tally = Tally(exam)
        self._connect = connect
        self._interval_s = interval_s
        self._answered = [0] * count
        self._stop = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._call_all()))

    async def _call_all(self) -> None:
        async with self._connect() as ask:
            await asyncio.gather(*(self._call(ask, caller) for caller in range(len(self._answered))))

    async def _call(self, ask: Ask, caller: int) -> None:
        number = caller
        due_s = time.perf_counter() + self._interval_s * caller / len(self._answered)
        while not self._stop.is_set():
            if self._interval_s:
                await asyncio.sleep(max(due_s - time.perf_counter(), 0))
            else:
                due_s = time.perf_counter()
            if await self.tally.call(ask, number, due_s):
                self._answered[caller] += 1
            else:
                await asyncio.sleep(PAUSE_S)
            due_s += self._interval_s
            number += len(self._answered) + 1

    def wait_for_all(self) -> None:
        """Returns when each has been answered twice more: the second answer is to a question that was asked from now on."""
        before, until_s = list(self._answered), time.monotonic() + PATIENCE_S
        while not all(now > then + 1 for now, then in zip(self._answered, before, strict=True)):
            assert time.monotonic() < until_s, "callers are not answered"
            time.sleep(0.02)

    def __enter__(self) -> Callers:
        self._thread.start()
        try:
            self.wait_for_all()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


def closed_loop(connect: Connect, exam: Exam, callers: int, seconds: float) -> tuple[Tally, float]:
    """What became of the calls of so many callers, and how many were answered a second."""
    with Callers(connect, exam, callers) as asking:
        first, started_s = asking.tally.answered, time.perf_counter()
        time.sleep(seconds)
        rate_per_s = (asking.tally.answered - first) / (time.perf_counter() - started_s)
    return asking.tally, rate_per_s
