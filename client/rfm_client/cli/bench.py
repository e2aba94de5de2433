# SPDX-License-Identifier: MIT
"""``rfm-client bench``: ask as robots do, and measure how many answers come in time."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from queue import SimpleQueue
from typing import Any, ClassVar, Literal, TypeAlias, cast

import numpy as np

from rfm_client.cli.command import usage_errors
from rfm_client.cli.options import SYNTHETIC_TASK, asked_model
from rfm_client.cli.show import number, table, wrapped
from rfm_client.client import RewardClient
from rfm_client.contract.checks import counted
from rfm_client.contract.description import ModelInfo
from rfm_client.contract.samples import ProgressSample, random_trajectory
from rfm_client.contract.settings import ConfigError, Settings, setting
from rfm_client.frames.sampling import Sampling

WARM_UP_S = 2.0
EPISODE_STEPS = 100  # an episode keeps its frames in memory
MOST_OPEN = 20  # unanswered steps per robot; further steps count as failed, so that frames do not fill the memory
ENOUGH = 0.99  # share of steps in time for a load that is held

Ask: TypeAlias = Callable[[], "Future[Any]"]


@dataclass(frozen=True)
class Load(Settings):
    """How many robots ask how often, and about what. Raises ConfigError."""

    TITLE: ClassVar[str] = "Load"

    robots: int = setting(8, "Number of robots.", least=1, most=1000)
    hz: float = setting(10.0, "Steps of each robot per second.", least=0.01, most=1000)
    seconds: float = setting(30.0, f"Time to measure, after a warm-up of {WARM_UP_S:g} s.", least=1, most=3600)
    frames: int | None = setting(
        None, "Frames that the model sees at a step. Default: as in training.", least=1, most=9999
    )
    use_frames: bool = setting(False, "Send frames even if the model takes embeddings.")
    size: int = setting(224, "Height and width of a frame, in pixels.", least=1, most=4096)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.seconds < 1 / self.hz:
            raise ConfigError.at("seconds", f"at least {1 / self.hz:g}, which a step at this rate takes", self.seconds)

    def due(self) -> Iterator[tuple[float, int]]:
        """Yield the second at which each step is due, in order, and the robot. Robots begin at random moments."""
        phases_s = np.random.default_rng(0).uniform(0, 1 / self.hz, self.robots)
        order = phases_s.argsort().tolist()
        for step in range(math.ceil((WARM_UP_S + self.seconds) * self.hz)):
            yield from ((float(phases_s[robot]) + step / self.hz, robot) for robot in order)


@dataclass(frozen=True)
class Measured:
    """Answers to the steps after the warm-up.

    asked: what the robots asked about
    steps: how many steps were due
    in_time: share of them that were answered before the robot's next step was due
    steps_per_s: answered steps per second
    p50_ms, p99_ms: time from when a step was due until it was answered; None: no step was answered
    failures: number of failed steps by reason
    """

    asked: Literal["embeddings", "frames"]
    steps: int
    in_time: float
    steps_per_s: float
    p50_ms: float | None
    p99_ms: float | None
    failures: dict[str, int]

    @property
    def is_held(self) -> bool:
        """True if ENOUGH steps were answered in time and none failed."""
        return self.in_time >= ENOUGH and not self.failures

    def report(self, load: Load) -> str:
        """Return a table, the reasons of failures, and the verdict."""
        share, failed = f"{self.in_time:.2%}", sum(self.failures.values())
        columns = ("steps", "answered per s", "p50 ms", "p99 ms", "in time", "failed")
        row = [str(self.steps), *(number(each, 1) for each in (self.steps_per_s, self.p50_ms, self.p99_ms))]
        title = f"{counted(load.robots, 'robot')} at {load.hz:g} Hz, {self.asked}"
        lines = [table(title, columns, [[*row, share, str(failed)]])]
        lines += [f"{count} failed: {reason}" for reason, count in self.failures.items()]
        verdict = "held" if self.is_held else f"not held (expected at least {ENOUGH:.0%} in time, and none failed)"
        lines.append(f"{share} of the steps were answered within {1e3 / load.hz:.4g} ms: {verdict}")
        return "\n".join([lines[0], *map(wrapped, lines[1:])])


def measure(client: RewardClient, load: Load) -> Measured:
    """Send each step when it is due, even while earlier answers are late. Raises RewardError if a first step fails.

    The first steps, one for each robot, come before: their failure is no matter of load.
    """
    info, random = asked_model(client, use_frames=load.use_frames), np.random.default_rng(0)
    asks = [_robot(client, load, info, random) for _ in range(load.robots)]
    for ask in asks:
        ask().result()
    answers: SimpleQueue[tuple[float, float, BaseException | None]] = SimpleQueue()  # due, answered, error
    num_steps, began_s = 0, time.perf_counter()

    def note(due_s: float, future: Future[Any]) -> None:
        answers.put((due_s, time.perf_counter() - began_s, future.exception()))

    for due_s, robot in load.due():
        num_steps += 1
        left_s = began_s + due_s - time.perf_counter()
        if left_s < -client.timeout_s:
            answers.put((due_s, math.inf, TimeoutError("not sent in time: divide the robots among several machines")))
            continue
        time.sleep(max(left_s, 0.0))
        if num_steps - answers.qsize() > MOST_OPEN * load.robots:
            answers.put((due_s, math.inf, TimeoutError("not sent: too many earlier steps are unanswered")))
            continue
        asks[robot]().add_done_callback(partial(note, due_s))
    outcomes = [each for each in (answers.get() for _ in range(num_steps)) if each[0] >= WARM_UP_S]
    answered = [(due_s, answered_s) for due_s, answered_s, error in outcomes if error is None]
    took_ms = [1e3 * (answered_s - due_s) for due_s, answered_s in answered]
    ended_s = max((answered_s for _, answered_s in answered), default=0.0)
    p50_ms, p99_ms = np.percentile(took_ms, [50, 99]).tolist() if took_ms else (None, None)
    return Measured(
        asked="frames" if info.widths is None else "embeddings",
        steps=len(outcomes),
        in_time=sum(ms <= 1e3 / load.hz for ms in took_ms) / len(outcomes),
        steps_per_s=len(answered) / (max(ended_s, WARM_UP_S + load.seconds) - WARM_UP_S),
        p50_ms=p50_ms,
        p99_ms=p99_ms,
        failures=dict(Counter(getattr(error, "message", str(error)) for *_, error in outcomes if error is not None)),
    )


def _robot(client: RewardClient, load: Load, info: ModelInfo, random: np.random.Generator) -> Ask:
    """Return a function that sends a robot's next step. No server knows its frame yet."""
    with usage_errors("--frames"):
        count = cast(int, Sampling.of(None, load.frames, info.max_frames).frames)  # the rules of training have one
    if info.widths is not None:
        trajectory = random_trajectory(random, count, info.widths, task=SYNTHETIC_TASK)
        return partial(client.submit, ProgressSample(trajectory))
    episode, shape = client.episode(SYNTHETIC_TASK, frames=load.frames), (load.size, load.size, 3)

    def ask() -> Future[Any]:
        if episode.step + 1 == EPISODE_STEPS:
            episode.reset()
        episode.keep(np.frombuffer(random.bytes(math.prod(shape)), np.uint8).reshape(shape))
        return client.submit_episodes([episode])

    return ask
