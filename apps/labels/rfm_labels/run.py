# SPDX-License-Identifier: MIT
"""Label the episodes of a plan that have no part yet, several at a time."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from rfm_client import (
    AccessDeniedError,
    DeadlineExceededError,
    InferenceFailedError,
    InvalidSampleError,
    ModelNotFoundError,
    ProcessEndedError,
    RewardError,
    ServerUnavailableError,
)
from rfm_labels.cost import Cost
from rfm_labels.datasets.dataset import Dataset, DatasetEpisode
from rfm_labels.episode_scores import FrameMemory, episode_scores
from rfm_labels.finished_episodes import Parts
from rfm_labels.plan import Item, Plan
from rfm_labels.scorer import IDENTITY, Scorer

_NOT_ABOUT_ONE_EPISODE = (ServerUnavailableError, DeadlineExceededError, ModelNotFoundError, AccessDeniedError)


class Watch:
    """Callbacks of a run. They do nothing here; override those that you need."""

    def note(self, text: str) -> None:
        """Callback with a line for the user: a decision, or a warning."""

    def checking(self, num_episodes: int) -> None:
        """Callback before the check of all episodes."""

    def checked(self, episode: DatasetEpisode) -> None:
        """Callback when all frames of an episode are found."""

    def begin(self, num_frames: int, num_finished: int) -> None:
        """Callback before the first score, with the frames of the run, and those already finished."""

    def scored(self, episode: DatasetEpisode) -> None:
        """Callback when the episode is finished."""

    def failed(self, episode: DatasetEpisode, error: RewardError) -> None:
        """Callback when the episode has failed."""


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
        pending = begin(self._plan, self._parts, self._watch)
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
            for name in IDENTITY:
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


def begin(plan: Plan, parts: Parts, watch: Watch) -> list[Item]:
    """Return the items without a part, and report the number of frames to ``watch``."""
    finished = parts.finished(plan.items)
    watch.begin(plan.num_frames, sum(item.episode.num_frames for item in plan.items if item.key in finished))
    return [item for item in plan.items if item.key not in finished]


def by_episode(failures: Sequence[FailedEpisode]) -> list[FailedEpisode]:
    """Return the failures in the order of their episodes."""
    return sorted(failures, key=lambda failure: failure.episode.index)
