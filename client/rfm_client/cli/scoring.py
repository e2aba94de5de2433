# SPDX-License-Identifier: MIT
"""``rfm-client score``: read trajectories from files, score them, show the results in file order."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import PurePath
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from rfm_client.cli.command import ExitCode, exit_code, exit_code_of, missing_package, report, user_message
from rfm_client.cli.options import PrefixOptions, VideoOptions
from rfm_client.cli.pictures import Panel
from rfm_client.cli.show import Table, at_end, number, title_at_end
from rfm_client.client import RewardClient
from rfm_client.contract.checks import is_blank
from rfm_client.contract.description import ModelInfo
from rfm_client.contract.errors import (
    DeadlineExceededError,
    InvalidSampleError,
    InvalidValueError,
    ProcessEndedError,
    RewardError,
    ServerUnavailableError,
)
from rfm_client.contract.results import FrameScores, ProgressResult
from rfm_client.contract.samples import Trajectory
from rfm_client.frames.inputs import ARRAY_SUFFIXES, load_trajectory
from rfm_client.frames.sampling import Sampling
from rfm_client.frames.video import frame_times_s
from rfm_client.recording import Recording
from rfm_client.scoring.samples import CallOptions

WORKERS = 8  # videos in memory at a time
PROBE_S = 2.0  # timeout for checking that a server is alive
COMPARE_LOG_PROB = "compare log_prob at the last frame (rfm-client score --json)"
NOT_ASKED = "not asked, since no server answers any more"

Times = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Source:
    """A trajectory with all T frames that were read. times_s: float64 [T]; None: unknown."""

    name: str
    trajectory: Trajectory
    times_s: Times | None

    @classmethod
    def read(cls, name: str, video: VideoOptions) -> Source:
        """Read the source from a file. Raises InvalidSampleError."""
        are_arrays = PurePath(name).suffix.lower() in ARRAY_SUFFIXES
        fps = None if are_arrays else video.fps
        trajectory = load_trajectory(
            name, task=video.task, fps=fps, orient=video.orient, channels=video.channels, **video.more
        )
        if trajectory.frames is not None and is_blank(trajectory.task):
            own = repr(trajectory.task) if trajectory.task.strip() else "none"
            raise InvalidSampleError.at("task", "a sentence with frames", f'{own}: add --task "SENTENCE"')
        return cls(name, trajectory, None if are_arrays else frame_times_s(name, trajectory.num_frames))

    def times_of(self, scores: FrameScores) -> Times | None:
        """Return the scored frames' times in the video, float64 [T]; None: unknown."""
        return None if self.times_s is None else self.times_s[scores.scored_frames]


@dataclass(frozen=True, eq=False)
class Scored:
    """A source's scores, ready to show.

    num_frames: frames that were read
    times_s: float64 [T], times of the T scored frames; None: unknown
    """

    name: str
    info: ModelInfo
    result: ProgressResult
    num_frames: int
    times_s: Times | None
    panel: Panel
    took_s: float

    def table(self, names: Sequence[str]) -> Table:
        """Return a table for this source and others with these names."""
        columns = ("video", title_at_end(self.result), "final success", "frames", "last at s", "took s", "version")
        return Table(columns, [names, *(["-" * width] for width in (8, 7, 13, 7, 6, 7))])

    @property
    def row(self) -> tuple[str, ...]:
        """The source's cells in ``table``."""
        count, success = len(self.result.progress), number(self.result.success[-1])
        frames = str(count) if count == self.num_frames else f"{count} of {self.num_frames}"
        seconds = "-" if self.times_s is None else f"{self.times_s[-1]:.1f}"
        version = self.result.model_version or "-"
        return (self.name, at_end(self.result), success, frames, seconds, f"{self.took_s:.2f}", version)


@dataclass(frozen=True)
class Failed:
    """A source without scores. is_server_gone: True: because no server answers any more."""

    name: str
    error: Exception
    message: str
    is_server_gone: bool = False


Outcome: TypeAlias = Scored | Failed
Tell = Callable[[Outcome], None]


@dataclass
class SourceScorer:
    """Scores sources, in several threads, until no server answers any more.

    recording: gets each source's frames and scores, before memory is freed; None: no recording
    """

    client: RewardClient
    video: VideoOptions
    prefix: PrefixOptions
    recording: Recording | None = None
    _gone: RewardError | None = None

    def score_all(self, names: Sequence[str], tell: Tell) -> list[Outcome]:
        """Return the outcomes for all sources, in order. ``tell`` gets an outcome once all before it have arrived."""
        with ThreadPoolExecutor(WORKERS) as pool:
            try:
                futures = [pool.submit(self.outcome, *each) for each in zip(names, unique_stems(names), strict=True)]
                for future in futures:
                    tell(future.result())
            except BaseException:  # an interrupt, or a full disk: start no other source
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        return [future.result() for future in futures]

    def outcome(self, name: str, stem: str) -> Outcome:
        """Return a source's scores, or why it failed. stem: its name in the recording."""
        started_s = time.monotonic()
        if self._gone is not None:
            return Failed(name, self._gone, NOT_ASKED, is_server_gone=True)
        try:
            source = Source.read(name, self.video)
            if self._gone is not None:
                return Failed(name, self._gone, NOT_ASKED, is_server_gone=True)
            result = _evaluate(self.client, source.trajectory, self.video, self.prefix)
            info = self.client.model_info(frames=source.trajectory.frames is not None)
        except ImportError as error:
            return Failed(name, error, missing_package(error))
        except (RewardError, OSError) as error:
            if isinstance(error, InvalidSampleError) and error.source == name:  # the report already names it
                error.source = ""
            return Failed(name, error, user_message(error), is_server_gone=self._is_server_gone(error))
        if self.recording is not None:
            self.recording.add(stem, result, source.trajectory.frames, source.times_s)
        return Scored(
            name=name,
            info=info,
            result=result,
            num_frames=source.trajectory.num_frames,
            times_s=source.times_of(result),
            panel=Panel.of(PurePath(name).name, result, source.trajectory.frames, source.times_s),
            took_s=time.monotonic() - started_s,
        )

    def _is_server_gone(self, error: Exception) -> bool:
        """True if the error means that no server answers any more, not that this source fails."""
        if isinstance(error, ProcessEndedError) or not isinstance(
            error, (ServerUnavailableError, DeadlineExceededError)
        ):
            return False
        if self._gone is None and not self.client.is_ready(timeout_s=PROBE_S):
            self._gone = error
        return self._gone is not None


def report_warnings(infos: Iterable[ModelInfo]) -> None:
    """Report what everyone who sees these checkpoints' scores must know, once."""
    for note in dict.fromkeys(f"{info.warning}; {info.remedy}" for info in infos if info.warning):
        report(f"note: {note}")


def exit_code_of_outcomes(outcomes: Sequence[Outcome]) -> ExitCode:
    """Return the exit code of a command with these outcomes."""
    failures = [outcome for outcome in outcomes if isinstance(outcome, Failed)]
    codes = {exit_code(failure.error) for failure in failures if failure.is_server_gone}
    if codes:
        return min(codes)  # UNAVAILABLE before DEADLINE, which a lost server also causes
    return exit_code_of([failure.error for failure in failures], some_succeeded=len(failures) < len(outcomes))


def unique_stems(names: Sequence[str]) -> list[str]:
    """Return a short name for each source: the file's without suffix, all numbered if one repeats."""
    stems = [PurePath(name).stem for name in names]
    is_unique = len(set(stems)) == len(stems)
    return stems if is_unique else [f"{number}_{stem}" for number, stem in enumerate(stems, 1)]


def _evaluate(
    client: RewardClient, trajectory: Trajectory, video: VideoOptions, prefix: PrefixOptions
) -> ProgressResult:
    info = client.model_info(frames=trajectory.frames is not None)
    options: CallOptions = {"resize": video.resize}
    # When an episode is scored as a whole, all frames are shown at once.
    if prefix.sampling is None or (info.needs_whole_episode and prefix.sampling == "all"):
        options["subsample"] = video.subsample and prefix.sampling is None
        return client.progress(trajectory, **options)
    try:
        sampling = Sampling.of(prefix.sampling, prefix.frames, info.max_frames)
    except InvalidValueError as error:  # the options are valid: the checkpoint lacks the count
        raise InvalidSampleError.like(error, where=f"--{error.where}") from error
    return client.curve(trajectory, sampling, **options)


def heading(task: str, infos: Iterable[ModelInfo], caption: str | None = None) -> str:
    """Return a figure's title: the caption, else the task and the checkpoints; below it their warnings."""
    infos = list(infos)
    title = [f'"{task}"' * (not is_blank(task)), checkpoint_names(infos)] if caption is None else [caption]
    return "\n".join(filter(None, [*title, *dict.fromkeys(info.warning for info in infos)]))


def checkpoint_names(infos: Iterable[ModelInfo]) -> str:
    """Return the names of these checkpoints, each once."""
    return ", ".join(dict.fromkeys(map(checkpoint_name, infos)))


def rule(infos: Sequence[ModelInfo], prefix: PrefixOptions) -> str:
    """Return a line for the user: which checkpoints scored, and which frames decide a frame's score."""
    names = checkpoint_names(infos)
    if any(info.needs_whole_episode for info in infos):
        return f"{names} scored each video as a whole episode. Do not compare videos by progress: {COMPARE_LOG_PROB}."
    if prefix.sampling is None:
        return f"{names} scored these frames in one pass; labels and the page score each prefix (--sampling)."
    frames = f", {prefix.frames} frames" if prefix.frames else ""
    return f"{names} scored each frame on its prefix: {prefix.sampling}{frames}."


def checkpoint_name(info: ModelInfo) -> str:
    """Return where the checkpoint comes from, else the model's name."""
    source = info.source or info.name
    run = source.removesuffix("/checkpoint")  # a name, unless the folder is a version
    return source if run.isdecimal() else run
