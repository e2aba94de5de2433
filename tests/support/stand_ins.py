# SPDX-License-Identifier: MIT
"""Servers that stand in for real ones, whose answers a test gives by hand, and a clock that it sets."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Collection, Coroutine, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from rfm_client import (
    AsyncRewardClient,
    DeadlineExceededError,
    InvalidSampleError,
    ProgressResult,
    ProgressSample,
    Result,
    RewardError,
    Sample,
    Trajectory,
)
from rfm_client.contract import wire
from rfm_client.contract.model_info import ModelInfo
from rfm_client.transport.calls import Answer
from rfm_client.transport.deadline import timeout

WITHIN_S = 10.0
LIMIT = 2  # of one server of one instance
BAD = -1.0  # in the embeddings of a sample that a stand-in refuses


def sample_of(value: float, num_frames: int = 3) -> ProgressSample:
    """One that a stand-in answers with this value."""
    embeddings = np.full((num_frames, 4), value, np.float32)
    return ProgressSample(Trajectory(video_embeddings=embeddings, text_embedding=np.ones(2, np.float32)))


@dataclass
class Asked:
    """A request that has come, and when it is answered."""

    inputs: wire.Tensors
    outputs: Collection[str]
    timeout_s: float
    request_id: str
    gate: asyncio.Future[None]
    is_cancelled: bool = False

    @property
    def values(self) -> list[float]:
        return [float(value) for value in self.inputs[wire.VIDEO_EMBEDDINGS][:, 0, 0]]

    def answer(self) -> None:
        self.gate.set_result(None)

    def fail(self, error: Exception) -> None:
        self.gate.set_exception(error)


@dataclass
class Stand:
    """A server that answers each frame with its first number, when a request is answered. is_open: at once"""

    url: str = "grpc://stand:1"
    instances: int = 1
    max_batch_size: int = 64
    is_open: bool = False
    info_error: RewardError | None = None
    asked: list[Asked] = field(default_factory=list)
    num_infos: int = 0

    @property
    def waiting(self) -> list[Asked]:
        return [asked for asked in self.asked if not asked.gate.done()]

    async def infer(
        self, model: str, inputs: wire.Tensors, outputs: Collection[str], timeout_s: float, *, request_id: str = ""
    ) -> Answer:
        asked = Asked(inputs, outputs, timeout_s, request_id, asyncio.get_running_loop().create_future())
        self.asked.append(asked)
        if self.is_open:
            asked.answer()
        try:
            async with timeout(timeout_s):
                await asked.gate
        except (asyncio.TimeoutError, TimeoutError):  # in Python 3.10 two
            raise DeadlineExceededError("no answer in time") from None
        except asyncio.CancelledError:
            asked.is_cancelled = True
            raise
        if BAD in asked.values:
            raise InvalidSampleError("video_embeddings: expected good ones, got bad ones")
        scores = inputs[wire.VIDEO_EMBEDDINGS][:, :, 0]
        per_sample = {wire.PREFERENCE, wire.SIMILARITY}
        return Answer({name: scores[:, :1] if name in per_sample else scores for name in outputs}, "1")

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        self.num_infos += 1
        if self.info_error is not None:
            raise self.info_error
        none = dict.fromkeys(("max_frames", "frame_size", "video_dim", "text_dim", "progress_bins"))
        return ModelInfo(model, ("1",), self.max_batch_size, **none, instances=self.instances)  # type: ignore[arg-type]

    async def is_ready(self, model: str, timeout_s: float) -> bool:
        return True

    async def close(self) -> None:
        pass


async def until(is_so: Callable[[], object]) -> None:
    async def poll() -> None:
        while not is_so():
            await asyncio.sleep(0)

    await asyncio.wait_for(poll(), WITHIN_S)


class Calls:
    """A client of stand-ins that knows their limits, and calls that are under way."""

    def __init__(self, *stands: Stand, **options: Any) -> None:
        self.stands = stands or (Stand(),)
        self.client = AsyncRewardClient("", transports=self.stands, **{"join": True, **options})
        self.tasks: list[asyncio.Task[Result]] = []

    @property
    def stand(self) -> Stand:
        return self.stands[0]

    @property
    def asked(self) -> list[Asked]:
        return [asked for stand in self.stands for asked in stand.asked]

    async def begin(self, *samples: Sample, **options: Any) -> list[asyncio.Task[Result]]:
        """Calls about these samples, which have come as far as they come by themselves."""
        tasks = [asyncio.create_task(self.client.score(sample, **options)) for sample in samples]
        self.tasks += tasks
        for _ in range(20):
            await asyncio.sleep(0)
        return tasks

    async def fill(self, limit: int = LIMIT) -> None:
        """As many calls as go at once, so that the next ones wait."""
        await self.begin(*(sample_of(100 + number) for number in range(limit)))
        assert [asked.values for asked in self.asked] == [[100.0 + number] for number in range(limit)]

    async def answer_all(self) -> list[Result | BaseException]:
        """The outcomes of all calls; requests are answered as they come."""

        async def answering() -> None:
            while True:
                for stand in self.stands:
                    for asked in stand.waiting:
                        asked.answer()
                await asyncio.sleep(0)

        answers = asyncio.create_task(answering())
        try:
            return await asyncio.wait_for(asyncio.gather(*self.tasks, return_exceptions=True), WITHIN_S)
        finally:
            answers.cancel()

    async def __aenter__(self) -> Calls:
        with suppress(RewardError):
            await self.client.model_info()
        return self

    async def __aexit__(self, *_: object) -> None:
        for task in self.tasks:
            task.cancel()
        await asyncio.gather(*self.tasks, return_exceptions=True)
        await self.client.close()


def run(test: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(asyncio.wait_for(test(), 3 * WITHIN_S))


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples wait until a request has ended, however long that takes."""
    monkeypatch.setattr("rfm_client.joining.LONGEST_WAIT_S", 1e3)


class Clock:
    """Time that may leap."""

    def __init__(self) -> None:
        self.ahead_s = 0.0
        self._real = time.monotonic

    def monotonic(self) -> float:
        return self._real() + self.ahead_s

    def advance(self, seconds: float) -> None:
        self.ahead_s += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """That of event loops and deadlines."""
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock.monotonic)
    return clock


def values_of(outcomes: Sequence[object]) -> list[float | None]:
    return [float(o.progress[0]) if isinstance(o, ProgressResult) else None for o in outcomes]
