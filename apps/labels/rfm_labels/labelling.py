# SPDX-License-Identifier: MIT
"""Label a dataset: plan, score several episodes at a time, write the label files."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from rfm_client import (
    AccessDeniedError,
    DeadlineExceededError,
    InferenceFailedError,
    InvalidSampleError,
    ModelNotFoundError,
    ProcessEndedError,
    RewardError,
    ServerUnavailableError,
    unclear_answers,
)
from rfm_labels.datasets.dataset import Dataset, DatasetEpisode
from rfm_labels.episode_scores import UNCLEAR, FrameMemory, episode_scores
from rfm_labels.metadata import Cost, blank_from_metadata, blank_lines
from rfm_labels.options import DEFAULTS, QUIET, LabelOptions, Watch
from rfm_labels.outputs import Outputs, prepared
from rfm_labels.plan import Item, Plan
from rfm_labels.scorer import DECISIVE, Scorer
from rfm_labels.summary import Summary, summary_of
from rfm_labels.writing import Parts

_NOT_ABOUT_ONE_EPISODE = (ServerUnavailableError, DeadlineExceededError, ModelNotFoundError, AccessDeniedError)


@dataclass(frozen=True)
class Report:
    """The result of a labelling run.

    files: label files that were written; empty if an episode failed, or for a shard
    failures: episodes without labels
    parts: folder or URL of the finished episodes
    summary: None: no file was written
    plan: the episodes to label, and the recipe
    """

    files: Sequence[Path]
    failures: Sequence[FailedEpisode]
    parts: str
    summary: Summary | None
    plan: Plan


def label(dataset: Dataset, scorer: Scorer, options: LabelOptions = DEFAULTS, watch: Watch = QUIET) -> Report:
    """Label every frame of the chosen episodes, and write the label files.

    If an episode fails, the report names it, and no label file is written. The same call then labels only the missing
    episodes.

    Raises DatasetError, before the first score, for a contradictory dataset or a label file that this run may not
    replace; RewardError if the scorer is gone; OSError for a full disk.
    """
    outputs, plan, earlier = prepared(dataset, scorer, options, watch)
    run = Run(plan, dataset, scorer, outputs.parts, watch)
    failures = run.finish_all(options.workers)
    return put_together(plan, outputs, failures, run.cost or earlier, watch)


def put_together(
    plan: Plan, outputs: Outputs, failures: Sequence[FailedEpisode], cost: Cost | None, watch: Watch
) -> Report:
    """Write the label files, unless an episode failed or the run labelled only a shard."""
    report = Report([], failures, outputs.parts.url, None, plan)
    if failures or outputs.options.shard is not None:
        return report
    labels = outputs.parts.read_all(plan)
    blank = blank_from_metadata(labels.schema.metadata)
    for line in blank_lines(blank, len(plan.items)):
        watch.note(line)
    files = outputs.write(plan, labels, cost, watch)
    if UNCLEAR in labels.column_names and (marks := labels[UNCLEAR].to_numpy()).any():
        watch.note(f"{unclear_answers(marks)}; the column {UNCLEAR} marks them")
    assert outputs.dataset is not None  # ``prepared`` sets it
    num_episodes = len(outputs.dataset.numbers)
    if len(plan.items) < num_episodes:
        others = "; LeRobot's reader gives frames of the others the weight 1.0" if outputs.progress else ""
        watch.note(f"{len(plan.items)} of the dataset's {num_episodes} episodes have labels{others}")
    return replace(report, files=files, summary=summary_of(labels))


@dataclass(frozen=True)
class FailedEpisode:
    """An episode without labels, and the reason."""

    episode: DatasetEpisode
    error: RewardError


class _StoppedError(RewardError):
    """The run is stopping; the next run labels the episode."""


class Run:
    """The labelling of a plan with threads of this process."""

    def __init__(self, plan: Plan, dataset: Dataset, scorer: Scorer, parts: Parts, watch: Watch) -> None:
        self._plan, self._dataset, self._scorer, self._parts, self._watch = plan, dataset, scorer, parts, watch
        self._memory = FrameMemory()
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._failures: list[FailedEpisode] = []
        self._cause: Exception | None = None
        self._frames_scored, self._seconds = 0, 0.0

    @property
    def cost(self) -> Cost | None:
        """What ``finish_all`` scored, and its time; None: it scored nothing."""
        return Cost(self._frames_scored, self._seconds) if self._frames_scored else None

    def finish_all(self, workers: int) -> list[FailedEpisode]:
        """Label all items without a part, ``workers`` at a time, and return the failures.

        Raises, once the episodes in progress have ended, RewardError if the server is gone, OSError for a full disk.
        """
        pending = unfinished(self._plan, self._parts, self._watch)
        began_s = time.monotonic()
        with ThreadPoolExecutor(workers, thread_name_prefix="rfm-label") as pool:
            try:
                list(pool.map(self._label, pending))
            except BaseException:
                self._stopping.set()
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        self._seconds = time.monotonic() - began_s
        if self._cause is not None:
            raise self._cause
        return by_episode(self._failures)

    def _label(self, item: Item) -> None:
        try:
            self._go_on()
            if not self._parts.has(item):  # another process may have finished it
                self._score(item)
            self._watch.scored(item.episode)
        except _StoppedError:
            return
        except RewardError as error:
            is_of_one = isinstance(error, ProcessEndedError)  # at both tries of the client
            if isinstance(error, _NOT_ABOUT_ONE_EPISODE) and not is_of_one:
                self._stop(error)
                return
            with self._lock:
                self._failures.append(FailedEpisode(item.episode, error))
            self._watch.failed(item.episode, error)
        except (OSError, ImportError) as error:
            self._stop(error)

    def _score(self, item: Item) -> None:
        recipe, memory = self._plan.recipe, self._memory
        try:
            scores = episode_scores(self._dataset, item.episode, self._scorer, recipe, memory=memory, go_on=self._go_on)
        except InferenceFailedError:  # the cause may be a new checkpoint
            self._check_checkpoint()
            raise
        self._check_checkpoint()
        self._parts.write(item, scores.columns, scores.blank)
        with self._lock:
            self._frames_scored += item.episode.num_frames

    def _check_checkpoint(self) -> None:
        """Stop the run and raise _StoppedError if another checkpoint is served now."""
        try:
            planned, now = self._plan.recipe.checkpoint, self._scorer.checkpoint()
            for name in DECISIVE:
                if getattr(now, name) != getattr(planned, name):
                    raise InvalidSampleError.at(name, getattr(planned, name), getattr(now, name))
        except InvalidSampleError as error:
            self._stop(error)
            raise _StoppedError from error

    def _stop(self, cause: Exception) -> None:
        with self._lock:
            self._cause = self._cause or cause
        self._stopping.set()

    def _go_on(self) -> None:
        if self._stopping.is_set():
            raise _StoppedError


def unfinished(plan: Plan, parts: Parts, watch: Watch) -> list[Item]:
    """Return the items without a part, and report the number of frames to ``watch``."""
    finished = parts.finished(plan.items)
    watch.begin(plan.num_frames, sum(item.episode.num_frames for item in plan.items if item.key in finished))
    return [item for item in plan.items if item.key not in finished]


def by_episode(failures: Sequence[FailedEpisode]) -> list[FailedEpisode]:
    """Return the failures in the order of their episodes."""
    return sorted(failures, key=lambda failure: failure.episode.index)
