# SPDX-License-Identifier: MIT
"""``rfm-client score`` and ``compare``: trajectories from files, their scores from the server."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import TYPE_CHECKING, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from rfm_client.cli import options
from rfm_client.cli.options import ExitCode, Server, missing_package
from rfm_client.cli.show import Panel, number, table
from rfm_client.client import RewardClient
from rfm_client.contract.errors import InvalidSampleError, RewardError
from rfm_client.contract.results import FrameScores, PreferenceResult, ProgressResult, Result
from rfm_client.contract.samples import PreferenceSample, ProgressSample, Sample, Trajectory
from rfm_client.data.fitting import fitted, with_frame_indices
from rfm_client.data.prefixes import of_prefixes, prefix_samples
from rfm_client.data.sampling import Rule, Sampling

if TYPE_CHECKING:
    from rich.table import Table

PREFIXES_AT_A_TIME = 64  # of one video: their frames lie in memory
WORKERS = 8  # videos that are read, and lie in memory, at a time

Times = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Question:
    """The settings with which each source is scored.

    max_frames: frames that are sent at most, besides the checkpoint's own limit, which ``subsample`` applies
    sampling, sampled_frames: each frame is scored on its prefix, sampled by this rule to so many frames (None: as the
        checkpoint was trained); None: the frames are scored together
    """

    task: str
    fps: float
    max_frames: int | None = None
    frame_steps: int = 0
    subsample: bool = True
    resize: bool = False
    sampling: Rule | None = None
    sampled_frames: int | None = None


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

        if not is_url(name) and PurePath(name).suffix.lower() in ARRAY_SUFFIXES:
            return cls(name, load_trajectory(name, task=question.task), None)
        trajectory = load_trajectory(name, task=question.task, fps=question.fps)
        # What is behind a URL is gone once it is read.
        return cls(name, trajectory, None if is_url(name) else frame_times_s(name, trajectory.num_frames))

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
        """The row of this source in ``scored_table``."""
        progress, success = self.result.progress, self.result.success
        frames = str(len(progress)) if len(progress) == self.num_frames else f"{len(progress)} of {self.num_frames}"
        seconds = "-" if self.times_s is None else f"{self.times_s[-1]:.1f}"
        version = self.result.model_version or "-"
        return (self.name, number(progress[-1]), number(success[-1]), frames, seconds, f"{self.took_s:.2f}", version)


@dataclass(frozen=True)
class Failed:
    """A source that has no scores."""

    name: str
    error: Exception
    message: str


Outcome: TypeAlias = Scored | Failed


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two sources, and what the model says of them."""

    first: Source
    second: Source
    result: PreferenceResult

    @property
    def sides(self) -> tuple[tuple[Source, FrameScores, float], ...]:
        """Each source, its scores, and the probability that it is preferred."""
        preference = self.result.preference
        return (self.first, self.result.first, preference), (self.second, self.result.second, 1 - preference)

    def table(self) -> Table:
        """A table of the two sources, one row for each."""
        rows = [
            (
                source.name,
                number(share),
                number(scores.progress[-1]),
                number(scores.success[-1]),
                str(len(scores.progress)),
            )
            for source, scores, share in self.sides
        ]
        return table("", ("video", "P(preferred)", "last progress", "last success", "frames"), rows)

    def panels(self) -> list[Panel]:
        """What a plot shows of it."""
        titles = (f"{PurePath(source.name).name}: preferred with P = {share:.3f}" for source, _, share in self.sides)
        return [source.panel(title, scores) for title, (source, scores, _) in zip(titles, self.sides, strict=True)]


def score_all(server: Server, names: Sequence[str], question: Question) -> list[Outcome]:
    """The outcome of each source, in order. Raises RewardError if the server gives no answer at all."""
    with ThreadPoolExecutor(WORKERS) as pool, server.connected() as client, _progress_bar(len(names)) as advance:
        futures: list[Future[Outcome]] = []
        try:
            for name in names:
                futures.append(pool.submit(_score, client, name, question))
                futures[-1].add_done_callback(lambda _future: advance())
            return [future.result() for future in futures]
        except BaseException:  # an interrupt: what has not begun shall not
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def exit_code_of(outcomes: Sequence[Outcome]) -> ExitCode:
    """The exit code of a command with these outcomes."""
    failures = [outcome.error for outcome in outcomes if isinstance(outcome, Failed)]
    return options.exit_code_of(failures, some_succeeded=len(failures) < len(outcomes))


def compare(server: Server, names: tuple[str, str], question: Question) -> Comparison:
    """Which source does the task of the first better. Raises RewardError."""
    with server.connected() as client:
        first, second = (Source.read(name, question) for name in names)
        sample = PreferenceSample(first.trajectory, second.trajectory)
        return Comparison(first, second, cast(PreferenceResult, _evaluate(client, sample, question)))


def scored_table(scored: Sequence[Scored]) -> Table:
    """A table of the scored sources, one row for each."""
    columns = ("video", "last progress", "last success", "frames", "last at s", "took s", "version")
    return table("", columns, [outcome.row() for outcome in scored])


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


def _score(client: RewardClient, name: str, question: Question) -> Outcome:
    started_s = time.monotonic()
    try:
        source = Source.read(name, question)
        result = cast(ProgressResult, _evaluate(client, ProgressSample(source.trajectory), question))
    except ImportError as error:
        return Failed(name, error, missing_package(error))
    except (RewardError, OSError) as error:
        return Failed(name, error, str(error).removesuffix(f" ({name})"))  # the report names the source in any case
    return Scored(
        name=name,
        result=result,
        num_frames=source.trajectory.num_frames,
        times_s=times_of(source, result),
        panel=source.panel(f'{PurePath(name).name}: "{question.task}"', result),
        took_s=time.monotonic() - started_s,
    )


def _evaluate(client: RewardClient, sample: Sample, question: Question) -> Result:
    """The result of one sample, with frames left out as the question and the checkpoint require.

    The frames are left out here: the client knows of no other limit than the checkpoint's.
    """
    info = client.model_info(frames=sample.trajectories[0].frames is not None)
    dense = question.frame_steps > 0 or question.sampling is not None  # then each prefix is sampled
    limits = (question.max_frames, info.max_frames if question.subsample and not dense else None)
    limit = min((frames for frames in limits if frames is not None), default=None)
    fit = fitted(sample, replace(info, max_frames=limit), subsample=True, resize=question.resize)
    sent = fit.sample
    if isinstance(sent, ProgressSample) and question.sampling is not None:
        sampling = _sampling(question, question.sampling, info.max_frames)
        return with_frame_indices(_prefix_result(client, sent.trajectory, sampling), fit.frame_indices)
    if isinstance(sent, ProgressSample):
        sent = replace(sent, frame_steps=question.frame_steps)
    return with_frame_indices(client.evaluate([sent])[0], fit.frame_indices)


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
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("scoring", total=total)
        yield lambda: bar.advance(task)
