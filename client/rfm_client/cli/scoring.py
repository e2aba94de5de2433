# SPDX-License-Identifier: MIT
"""``rfm-client score``: trajectories from files, their scores from the server, each as soon as it is there."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import TypeAlias, cast

import numpy as np
import numpy.typing as npt

from rfm_client.cli import options
from rfm_client.cli.options import ExitCode, Server, missing_package
from rfm_client.cli.show import Panel, number
from rfm_client.client import RewardClient
from rfm_client.contract.errors import (
    DeadlineExceededError,
    InvalidSampleError,
    ProcessEndedError,
    RewardError,
    ServerUnavailableError,
)
from rfm_client.contract.results import FrameScores, ProgressResult, Result
from rfm_client.contract.samples import ProgressSample, Trajectory
from rfm_client.data.fitting import FittedSample, fitted, with_frame_indices
from rfm_client.data.orientation import Orientation
from rfm_client.data.sampling import Rule, Sampling, of_prefixes, prefix_samples

PREFIXES_AT_A_TIME = 64  # of one video: their frames lie in memory
WORKERS = 8  # videos that are read, and lie in memory, at a time
PROBE_S = 2.0  # within which a server that is there says so
COLUMNS = (  # of ``Scored.row``, and how wide they are
    *(("video", 0), ("last progress", 8), ("last success", 7), ("frames", 13)),
    *(("last at s", 7), ("took s", 6), ("version", 7)),
)

Times = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Question:
    """The settings with which each source is scored.

    max_frames: frames that are sent at most, besides the checkpoint's own limit, which ``subsample`` applies
    sampling, sampled_frames: each frame is scored on its prefix, sampled by this rule to so many frames (None: as the
        checkpoint was trained); None: the frames are scored together
    orient: how frames are turned, so that they are upright
    """

    task: str
    fps: float
    max_frames: int | None = None
    frame_steps: int = 0
    subsample: bool = True
    resize: bool = False
    sampling: Rule | None = None
    sampled_frames: int | None = None
    orient: Orientation = "none"

    @property
    def rule(self) -> str:
        """Which frames decide the score of a frame, as a line for people."""
        if self.frame_steps:
            return f"Each frame is scored on its prefix: linspace_trunc, {self.frame_steps} frames."
        if self.sampling is not None:
            frames = f", {self.sampled_frames} frames" if self.sampled_frames else ""
            return f"Each frame is scored on its prefix: {self.sampling}{frames}."
        return "All frames in one pass; labels and the page score each prefix (--sampling)."


@dataclass(frozen=True, eq=False)
class Source:
    """A trajectory as it was read, before any frame was left out; times_s: float64 [T], None if not known."""

    name: str
    trajectory: Trajectory
    times_s: Times | None

    @classmethod
    def read(cls, name: str, question: Question) -> Source:
        """The source that a file or URL holds. Raises InvalidSampleError."""
        from rfm_client.data.inputs import ARRAY_SUFFIXES, load_trajectory
        from rfm_client.data.video import frame_times_s, is_url

        are_arrays = not is_url(name) and PurePath(name).suffix.lower() in ARRAY_SUFFIXES
        fps = None if are_arrays else question.fps
        trajectory = _with_task(load_trajectory(name, task=question.task, fps=fps, orient=question.orient))
        # What is behind a URL is gone once it is read.
        has_times = not are_arrays and not is_url(name)
        return cls(name, trajectory, frame_times_s(name, trajectory.num_frames) if has_times else None)

    def panel(self, title: str, scores: FrameScores) -> Panel:
        """What a plot shows of it."""
        return Panel.of(title, scores, self.trajectory.frames, self.times_s)


@dataclass(frozen=True, eq=False)
class Scored:
    """A source's scores. num_frames: those that were read; times_s: float64 [T] of those that were scored."""

    name: str
    result: ProgressResult
    num_frames: int
    times_s: Times | None
    panel: Panel
    took_s: float

    def row(self) -> tuple[str, ...]:
        """The cells of this source under ``COLUMNS``."""
        progress, success = self.result.progress, self.result.success
        frames = str(len(progress)) if len(progress) == self.num_frames else f"{len(progress)} of {self.num_frames}"
        seconds = "-" if self.times_s is None else f"{self.times_s[-1]:.1f}"
        version = self.result.model_version or "-"
        return (self.name, number(progress[-1]), number(success[-1]), frames, seconds, f"{self.took_s:.2f}", version)


@dataclass(frozen=True)
class Failed:
    """A source that has no scores. is_server_gone: since no server answers any more."""

    name: str
    error: Exception
    message: str
    is_server_gone: bool = False


Outcome: TypeAlias = Scored | Failed


Tell = Callable[[int, Outcome], None]  # is called with the number of a source, and what came of it
Record = Callable[[int, Source, FrameScores], None]  # with its frames, too, before they are forgotten; by any thread


def score_all(
    server: Server, names: Sequence[str], question: Question, tell: Tell, record: Record | None = None
) -> list[Outcome]:
    """The outcome of each source, in order; each is told when it is there. Raises RewardError if no server answers."""
    with ThreadPoolExecutor(WORKERS) as pool, server.connected() as client, _progress_bar(len(names)) as advance:
        asking = _Asking(client, question, record)
        try:
            numbers: dict[Future[Outcome], int] = {
                pool.submit(asking.outcome, number, name): number for number, name in enumerate(names)
            }
            for future in as_completed(numbers):
                tell(numbers[future], future.result())
                advance()
        except BaseException:  # an interrupt, or a full disk: what has not begun shall not
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [future.result() for future in numbers]


class _Asking:
    """Asks about one source after the other, until no server answers any more. For several threads."""

    def __init__(self, client: RewardClient, question: Question, record: Record | None) -> None:
        self._client = client
        self._question = question
        self._record = record
        self._gone: RewardError | None = None

    def outcome(self, number: int, name: str) -> Outcome:
        """The scores of the source of this number, or why there are none."""
        started_s = time.monotonic()
        try:
            self._go_on()
            source = Source.read(name, self._question)
            self._go_on()
            result = _evaluate(self._client, ProgressSample(source.trajectory), self._question)
        except _NotAskedError as error:
            return Failed(name, error.cause, "not asked, since no server answers any more", is_server_gone=True)
        except ImportError as error:
            return Failed(name, error, missing_package(error))
        except (RewardError, OSError) as error:
            message = str(error).removesuffix(f" ({name})")  # the report names the source in any case
            return Failed(name, error, message, is_server_gone=self._is_server_gone(error))
        if self._record is not None:
            self._record(number, source, result)
        return Scored(
            name=name,
            result=result,
            num_frames=source.trajectory.num_frames,
            times_s=times_of(source, result),
            panel=source.panel(f'{PurePath(name).name}: "{self._question.task}"', result),
            took_s=time.monotonic() - started_s,
        )

    def _go_on(self) -> None:
        if self._gone is not None:
            raise _NotAskedError(self._gone)

    def _is_server_gone(self, error: Exception) -> bool:
        """Whether the error comes of servers that are gone, and not of what one of them was asked."""
        if isinstance(error, ProcessEndedError) or not isinstance(
            error, (ServerUnavailableError, DeadlineExceededError)
        ):
            return False
        if self._gone is None and not self._client.is_ready(timeout_s=PROBE_S):
            self._gone = error
        return self._gone is not None


class _NotAskedError(Exception):
    """No server answers any more, as ``cause`` has told."""

    def __init__(self, cause: RewardError) -> None:
        super().__init__(cause)
        self.cause = cause


def exit_code_of(outcomes: Sequence[Outcome]) -> ExitCode:
    """The exit code of a command with these outcomes."""
    failures = [outcome for outcome in outcomes if isinstance(outcome, Failed)]
    codes = {options.exit_code(failure.error) for failure in failures if failure.is_server_gone}
    if codes:
        return min(codes)  # unavailable before out of time, which some may be of a server that is gone
    return options.exit_code_of([failure.error for failure in failures], some_succeeded=len(failures) < len(outcomes))


def times_of(source: Source, scores: FrameScores) -> Times | None:
    """float64 [T], when in the video each scored frame is."""
    if source.times_s is None or scores.frame_indices is None:
        return source.times_s
    return source.times_s[scores.frame_indices]


def unique_stems(names: Sequence[str]) -> list[str]:
    """A name for files about each source: its own without folder and ending, numbered where that is taken."""
    stems: list[str] = []
    for name in names:
        stem = PurePath(name.partition("?")[0]).stem or "video"
        numbered = (f"{stem}_{number}" for number in itertools.count(2))
        stems.append(next(free for free in itertools.chain([stem], numbered) if free not in stems))
    return stems


def fitted_to(client: RewardClient, sample: ProgressSample, question: Question) -> FittedSample:
    """The sample with frames left out as the question and the checkpoint require.

    The frames are left out here: the client knows of no other limit than the checkpoint's.
    """
    info = client.model_info(frames=sample.trajectory.frames is not None)
    dense = question.frame_steps > 0 or question.sampling is not None  # then each prefix is sampled
    limits = (question.max_frames, info.max_frames if question.subsample and not dense else None)
    limit = min((frames for frames in limits if frames is not None), default=None)
    return fitted(sample, replace(info, max_frames=limit), subsample=True, resize=question.resize)


def _with_task(trajectory: Trajectory) -> Trajectory:
    """The trajectory, if frames have a task. Raises InvalidSampleError."""
    if trajectory.frames is not None and not trajectory.task.strip():
        raise InvalidSampleError.at("task", "a sentence with frames", 'none: add --task "what is to be done"')
    return trajectory


def _evaluate(client: RewardClient, sample: ProgressSample, question: Question) -> ProgressResult:
    fit = fitted_to(client, sample, question)
    sent = cast(ProgressSample, fit.sample)
    if question.sampling is None:
        (result,) = client.evaluate([replace(sent, frame_steps=question.frame_steps)])
    else:
        trained_frames = client.model_info(frames=sent.trajectory.frames is not None).max_frames
        result = _prefix_result(client, sent.trajectory, _sampling(question, question.sampling, trained_frames))
    return cast(ProgressResult, with_frame_indices(result, fit.frame_indices))


def _sampling(question: Question, rule: Rule, trained_frames: int | None) -> Sampling:
    try:
        return Sampling.of(rule, question.sampled_frames, trained_frames)
    except ValueError as error:  # the options are checked: only the checkpoint leaves it open
        raise InvalidSampleError(f"--{error}") from error


def _prefix_result(client: RewardClient, trajectory: Trajectory, sampling: Sampling) -> ProgressResult:
    samples = prefix_samples(trajectory, sampling)
    results: list[Result] = []
    while part := list(itertools.islice(samples, PREFIXES_AT_A_TIME)):
        results += client.evaluate(part)
    return of_prefixes(cast("list[ProgressResult]", results), sampling)


@contextmanager
def _progress_bar(total: int) -> Iterator[Callable[[], None]]:
    """A progress bar on standard error, shown only on a terminal. It gives a function to call after each source."""
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress

    console = Console(stderr=True)
    columns = (*Progress.get_default_columns(), MofNCompleteColumn())
    is_hidden, shares_terminal = not console.is_terminal, sys.stdout.isatty()
    with Progress(*columns, console=console, transient=True, disable=is_hidden, redirect_stdout=shares_terminal) as bar:
        task = bar.add_task("scoring", total=total)
        yield lambda: bar.advance(task)
