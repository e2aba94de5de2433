# SPDX-License-Identifier: MIT
"""Threads that send requests without end, check every answer, and count outcomes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from rfm import published
from rfm.engine import Engine
from rfm_client import (
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    RewardClient,
    RewardError,
    Sample,
    SimilaritySample,
)
from tolerances import TOLERANCE
from trajectories import random_trajectory

PATIENCE_S = 60.0
PAUSE_S = 0.1  # after a failed call
WIDTHS = (64, 32)  # of the demo's checkpoint

Numbers = np.ndarray[Any, np.dtype[np.float32]]
Ask = Callable[[Sample], Numbers]


class RefusedError(Exception):
    """The gateway refused a call at once, with 503."""


@dataclass(frozen=True)
class Exam:
    """Samples, and the engine's scores of them without a server."""

    samples: Sequence[Sample]
    expected: Sequence[Numbers]

    @classmethod
    def of(cls, checkpoint: Path, *, mixed: bool, count: int = 48) -> Exam:
        """Return samples of 1 to 8 frames. mixed: True: samples of all types, else only progress samples"""
        samples: list[Sample] = []
        for index in range(count):
            first, second = (random_trajectory(2 * index + i, 1 + (5 * index + i) % 8, *WIDTHS) for i in (0, 1))
            pair = PreferenceSample if index % 3 == 1 else SimilaritySample
            samples.append(pair(first, second) if mixed and index % 3 else ProgressSample(first))
        return cls(samples, [numbers(outcome) for outcome in Engine.of(published.load(checkpoint)).evaluate(samples)])

    def is_right(self, number: int, got: Numbers) -> bool:
        """True if an answer agrees with the engine's; an answer with NaN never does."""
        expected = self.expected[number]
        if got.shape != expected.shape:
            return False
        return bool((np.abs(got - expected) <= TOLERANCE * np.maximum(1, np.abs(expected))).all())


def numbers(result: object) -> Numbers:
    """Return all scores of a result as a float array [N]. Raises the result if it is a RewardError."""
    if isinstance(result, RewardError):
        raise result
    if isinstance(result, ProgressResult):
        return np.concatenate([result.progress, result.success])
    if isinstance(result, PreferenceResult):
        return np.concatenate([[result.preference], result.first.progress, result.second.progress])
    return np.concatenate([[result.similarity], result.reference.progress, result.other.progress])  # type: ignore[attr-defined]


def direct(client: RewardClient) -> Ask:
    """Return a caller with the client's default settings."""
    return lambda sample: numbers(client.evaluate([sample])[0])


def through_gateway(session: httpx.Client) -> Ask:
    """Return a caller of the evaluation server's endpoint: progress samples as JSON. Raises RefusedError for a 503."""

    def ask(sample: Sample) -> Numbers:
        (asked,) = sample.trajectories
        assert asked.video_embeddings is not None and asked.text_embedding is not None
        arrays = {"video_embeddings": asked.video_embeddings, "text_embedding": asked.text_embedding}
        told = {name: array.tolist() for name, array in arrays.items()}
        answer = session.post("/evaluate_batch", json={"samples": [{"sample_type": "progress", "trajectory": told}]})
        if answer.status_code == 503:
            raise RefusedError
        outputs = answer.raise_for_status().json()
        progress, success = outputs["outputs_progress"]["progress_pred"], outputs.get("outputs_success")
        return np.array([*progress[0], *success["success_probs"][0]], np.float32)

    return ask


@dataclass
class Callers:
    """A context with ``count`` threads that call without end, and the outcomes of the calls.

    pause_s: time between two calls of a thread
    latencies_s: of answered calls only
    """

    ask: Ask
    exam: Exam
    count: int
    pause_s: float = 0.0
    asked: int = 0
    answered: int = 0
    refused: int = 0
    broken_off: int = 0
    wrong: int = 0
    lost: list[Exception] = field(default_factory=list)
    latencies_s: list[float] = field(default_factory=list)

    def __enter__(self) -> Callers:
        self._stop, self._lock, self._answered = threading.Event(), threading.Lock(), [0] * self.count
        self._threads = ThreadPoolExecutor(self.count)
        for caller in range(self.count):
            self._threads.submit(self._call, caller)
        try:
            self.wait_for_all()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._threads.shutdown()

    def _call(self, caller: int) -> None:
        number = caller
        while not self._stop.wait(self.pause_s):
            number = (number + self.count + 1) % len(self.exam.samples)
            began_s, got = time.perf_counter(), None
            error: Exception | None = None
            try:
                got = self.ask(self.exam.samples[number])
            except Exception as raised:  # noqa: BLE001  every error is counted
                error = raised
            with self._lock:
                self.asked += 1
                if got is not None:
                    self.answered += 1
                    self._answered[caller] += 1
                    self.latencies_s.append(time.perf_counter() - began_s)
                    self.wrong += not self.exam.is_right(number, got)
                elif isinstance(error, RefusedError):
                    self.refused += 1
                elif isinstance(error, httpx.TransportError):
                    self.broken_off += 1
                elif error is not None:
                    self.lost.append(error)
            if error is not None:
                self._stop.wait(PAUSE_S)

    def wait_for_all(self) -> None:
        """Wait until each thread has two more answers, the second to a request sent after now. Raises TimeoutError."""
        before, until_s = list(self._answered), time.monotonic() + PATIENCE_S
        while not all(now > then + 1 for now, then in zip(self._answered, before, strict=True)):
            if time.monotonic() > until_s:
                raise TimeoutError(f"callers: expected answers, got none within {PATIENCE_S:g} s, but {self.lost[:1]}")
            time.sleep(0.02)
