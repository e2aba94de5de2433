# SPDX-License-Identifier: MIT
"""A labelling run as a person watches it: what was decided, a progress bar, a summary."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from rfm_client.cli.label_flags import LabelFlags
from rfm_client.cli.options import ExitCode
from rfm_client.cli.show import print_tables, table
from rfm_client.contract.errors import RewardError
from rfm_client.data.datasets.opening import open_dataset
from rfm_client.data.datasets.protocol import Dataset, DatasetEpisode
from rfm_client.integrations.episode_recordings import record_episodes
from rfm_client.integrations.recording import load_rerun
from rfm_client.labelling.episode_scores import FrameMemory, episode_columns
from rfm_client.labelling.finished_episodes import Parts
from rfm_client.labelling.label import Outputs, Report, check_frames, label, label_with_ray, plan_labels
from rfm_client.labelling.options import LabelOptions
from rfm_client.labelling.plan import Item, Plan, selected
from rfm_client.labelling.ray_engine import Connect
from rfm_client.labelling.run import Watch
from rfm_client.labelling.scorer import Scorer
from rfm_client.labelling.summary import Summary, summarise

_MIB = 2**20

Say = Callable[[str], None]


class ProgressBar(Watch):
    """Shows a run: lines on standard error and, on a terminal, a bar with frames a second and the time left."""

    def __init__(self, say: Say) -> None:
        console = Console(stderr=True)
        self._say = say
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task: TaskID | None = None
        self._num_scored = 0
        self._began_s = 0.0
        self.num_begun = 0

    def __enter__(self) -> ProgressBar:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._bar.stop()

    def note(self, text: str) -> None:
        """Writes a line of its own."""
        self._say(f"note: {text}")

    def checking(self, num_episodes: int) -> None:
        """The bar counts the episodes that are checked."""
        self._next("checking episodes", num_episodes, 0)

    def checked(self, episode: DatasetEpisode) -> None:
        """The bar advances by one episode."""
        self._advance(1)

    def begin(self, num_frames: int, num_finished: int) -> None:
        """The bar counts frames of labels."""
        if num_finished:
            self.note(f"{num_finished} of {num_frames} frames are labelled already")
        self._began_s, self._num_scored, self.num_begun = time.monotonic(), 0, num_frames
        self._next("labelling frames", num_frames, num_finished)

    def scored(self, episode: DatasetEpisode) -> None:
        """The episode's frames more."""
        self._num_scored += episode.num_frames
        took_s = time.monotonic() - self._began_s
        self._advance(episode.num_frames, rate=f"{self._num_scored / max(took_s, 1e-9):.1f} frames/s")

    def failed(self, episode: DatasetEpisode, error: RewardError) -> None:
        """Writes a line with the reason."""
        text = str(error)
        self._say(text if text.startswith(episode.name) else f"{episode.name}: {text}")
        self._advance(episode.num_frames)

    def _next(self, text: str, total: int, completed: int) -> None:
        if self._task is not None:
            self._bar.remove_task(self._task)
        self._task = self._bar.add_task(text, total=total, completed=completed, rate="")

    def _advance(self, by: int, rate: str = "") -> None:
        if self._task is not None:
            self._bar.update(self._task, advance=by, rate=rate)


def run(source: str, flags: LabelFlags, connect: Connect, say: Say) -> ExitCode:
    """Does what the flags say: label, try, or only report. Raises RewardError, OSError and ImportError."""
    options = flags.options()
    if flags.report:
        return _report(source, flags, options, say)
    if flags.dry_run:
        return _dry_run(source, flags, connect, say)
    if flags.rrd is not None:
        load_rerun()  # or it would be found missing when all is labelled
        flags.rrd.mkdir(parents=True, exist_ok=True)
    watch = ProgressBar(say)
    try:
        with watch:
            if flags.engine == "ray":
                report = label_with_ray(source, connect, options, watch, ray=flags.ray, **flags.opening)
            else:
                dataset = open_dataset(source, **flags.opening)
                with connect() as scorer:
                    report = label(dataset, scorer, options, watch)
    except (RewardError, OSError, KeyboardInterrupt):
        if watch.num_begun:
            say("what is finished stays: the same command goes on with the rest")
        raise
    status = _tell(report, flags, options, say)
    if flags.rrd is not None:
        dataset = open_dataset(source, **flags.opening)
        chosen = {episode.index for episode in selected(dataset, options)}
        plan = replace(report.plan, items=[item for item in report.plan.items if item.episode.index in chosen])
        for file in record_episodes(flags.rrd, dataset, plan, Parts(report.parts)):
            typer.echo(f"{file}")
    return status


def _dry_run(source: str, flags: LabelFlags, connect: Connect, say: Say) -> ExitCode:
    """Checks everything, measures a few episodes, writes nothing."""
    options = flags.options()
    dataset = open_dataset(source, **flags.opening)
    with connect() as scorer, ProgressBar(say) as watch:
        plan = plan_labels(dataset, scorer, options, watch)
        num_bytes = check_frames(dataset, plan.recipe, plan.items, watch)
        took_s = _measured_s(plan, dataset, scorer, options.workers)
    _print(_plan_rows(plan, dataset, num_bytes, took_s))
    return ExitCode.OK


def _tell(report: Report, flags: LabelFlags, options: LabelOptions, say: Say) -> ExitCode:
    if report.failures:
        say(f"{len(report.failures)} episodes failed, so no file was written; the others are kept in {report.parts}")
        return ExitCode.FAILED
    if report.summary is None:
        say(f"this shard is labelled; the same command without --shard writes the files from {report.parts}")
        return ExitCode.OK
    _show(report.summary, report.files[0], flags, options)
    for file in report.files:
        typer.echo(f"{file}")
    return ExitCode.OK


def _report(source: str, flags: LabelFlags, options: LabelOptions, say: Say) -> ExitCode:
    """The summary of labels that are there: of a dataset, or a file."""
    path = Path(source)
    if path.is_dir() or options.output is not None:
        outputs = Outputs(options.output or path, options)
        files = [file for file in (*outputs.progress, *outputs.signals) if file.exists()]
        path = (files or [*outputs.progress, *outputs.signals])[0]
    _show(summarise(path), path, flags, options)
    return ExitCode.OK


def _show(summary: Summary, file: Path, flags: LabelFlags, options: LabelOptions) -> None:
    _print(summary.rows())
    if flags.picture:
        from rfm_client.cli.label_picture import draw_summary

        folder = options.output or (file.parent.parent if file.parent.name == "reward_signals" else file.parent)
        picture = folder / f"{options.name}_summary.png"
        draw_summary(picture, summary)
        typer.echo(f"{picture}")


def _measured_s(plan: Plan, dataset: Dataset, scorer: Scorer, workers: int) -> float:
    """How long the plan takes, after the first episodes, as many as are under way at a time."""
    first = plan.items[:workers]
    memory = FrameMemory()

    def score(item: Item) -> None:
        episode_columns(dataset, item.episode, scorer, plan.recipe, memory=memory, go_on=lambda: None)

    score(first[0])  # once without the clock, so that what happens once does not count
    began_s = time.monotonic()
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(score, first))
    took_s = time.monotonic() - began_s
    return took_s * plan.num_frames / sum(item.episode.num_frames for item in first)


def _plan_rows(plan: Plan, dataset: Dataset, num_bytes: int, took_s: float) -> list[tuple[str, str]]:
    tasks = sorted({item.episode.task for item in plan.items})
    cameras = plan.recipe.cameras
    return [
        ("dataset", f"{dataset.kind}: {dataset.source}" + (f"@{dataset.revision}" if dataset.revision else "")),
        ("episodes", str(len(plan.items))),
        ("frames", f"{plan.num_frames}, of {len(cameras)} cameras: {plan.num_frames * len(cameras)} to be decoded"),
        ("to be decoded", f"{num_bytes / _MIB:.1f} MiB"),
        (f"tasks: {len(tasks)}", "; ".join(tasks[:5]) + (" ..." if len(tasks) > 5 else "")),
        ("it will take about", f"{took_s:.0f} s"),
    ]


def _print(rows: Sequence[tuple[str, str]]) -> None:
    print_tables(table("", ("labels", ""), rows))
    sys.stdout.flush()
