# SPDX-License-Identifier: MIT
"""Labels the episodes of a plan that have no part yet, several at a time, beside other processes that do the same."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum, auto

from rfm_client.contract.errors import (
    AccessDeniedError,
    DeadlineExceededError,
    InferenceFailedError,
    InvalidSampleError,
    ModelNotFoundError,
    ProcessEndedError,
    RewardError,
    ServerUnavailableError,
)
from rfm_client.data.datasets.protocol import Dataset, Episode
from rfm_client.labelling.claims import Claims
from rfm_client.labelling.episode_scores import episode_columns
from rfm_client.labelling.finished_episodes import Parts
from rfm_client.labelling.frame_memory import FrameMemory
from rfm_client.labelling.plan import Item, Plan
from rfm_client.labelling.scorer import Scorer

POLL_S = 0.5  # how often episodes that others work on are looked at
NOT_ABOUT_ONE_EPISODE = (ServerUnavailableError, DeadlineExceededError, ModelNotFoundError, AccessDeniedError)


class Watch:
    """What a caller sees of a run. This one shows nothing; override what you want to see."""

    def note(self, text: str) -> None:
        """Something that was decided, or that the caller should know."""

    def checking(self, num_episodes: int) -> None:
        """So many episodes are about to be checked."""

    def checked(self, episode: Episode) -> None:
        """All frames of the episode are there."""

    def begin(self, num_frames: int, num_finished: int) -> None:
        """So many frames are about to be scored, of which some are finished already."""

    def scored(self, episode: Episode) -> None:
        """The episode is finished, here or by another process."""

    def failed(self, episode: Episode, error: RewardError) -> None:
        """The episode cannot be labelled."""


@dataclass(frozen=True)
class Failure:
    """An episode that has no labels, and why."""

    episode: Episode
    error: RewardError


class _Fate(Enum):
    FINISHED = auto()
    CLAIMED = auto()  # by another process
    NOT_NOW = auto()  # it failed, or the run is stopping


class _StoppedError(RewardError):
    """The run is stopping; the episode is left to the next one."""


class Run:
    """One process's share of a plan."""

    def __init__(self, plan: Plan, dataset: Dataset, scorer: Scorer, parts: Parts, watch: Watch) -> None:
        self._plan, self._dataset, self._scorer, self._parts, self._watch = plan, dataset, scorer, parts, watch
        self._memory = FrameMemory()
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._failures: list[Failure] = []
        self._cause: Exception | None = None
        self._waited_for: set[str] = set()

    def finish_all(self, workers: int) -> list[Failure]:
        """Labels what has no part; waits for episodes that other processes have claimed. Gives what failed.

        Raises, after the episodes under way have ended, what no episode is to blame for: a server that is gone
        (RewardError), a full disk (OSError).
        """
        finished = self._parts.finished(self._plan.items)
        num_finished = sum(item.episode.num_frames for item in self._plan.items if item.key in finished)
        self._watch.begin(self._plan.num_frames, num_finished)
        pending = [item for item in self._plan.items if item.key not in finished]
        with Claims(self._parts) as claims:
            while pending:
                fates = self._attempt(pending, claims, workers)
                if self._cause is not None:
                    raise self._cause
                claimed = [item for item, fate in zip(pending, fates, strict=True) if fate is _Fate.CLAIMED]
                if len(claimed) == len(pending):
                    self._wait_for(claimed[0], claims)
                pending = claimed
        return sorted(self._failures, key=lambda failure: failure.episode.index)

    def _wait_for(self, item: Item, claims: Claims) -> None:
        if item.key not in self._waited_for:
            self._waited_for.add(item.key)
            self._watch.note(f"waiting for {item.episode.name}: {claims.told(item)}")
        self._stopping.wait(POLL_S)

    def _attempt(self, items: Sequence[Item], claims: Claims, workers: int) -> list[_Fate]:
        with ThreadPoolExecutor(workers, thread_name_prefix="rfm-label") as pool:
            try:
                return list(pool.map(lambda item: self._label(item, claims), items))
            except BaseException:
                self._stopping.set()
                pool.shutdown(wait=False, cancel_futures=True)
                raise

    def _label(self, item: Item, claims: Claims) -> _Fate:
        if self._stopping.is_set():
            return _Fate.NOT_NOW
        try:
            if not self._parts.has(item):
                if not claims.take(item):
                    return _Fate.CLAIMED
                try:
                    self._score(item)
                finally:
                    claims.give_back(item)
        except _StoppedError:
            return _Fate.NOT_NOW
        except RewardError as error:
            is_of_one = isinstance(error, ProcessEndedError)  # after the client has asked twice
            if isinstance(error, NOT_ABOUT_ONE_EPISODE) and not is_of_one:
                return self._stop(error)
            with self._lock:
                self._failures.append(Failure(item.episode, error))
            self._watch.failed(item.episode, error)
            return _Fate.NOT_NOW
        except (OSError, ImportError) as error:
            return self._stop(error)
        self._watch.scored(item.episode)
        return _Fate.FINISHED

    def _score(self, item: Item) -> None:
        if self._parts.has(item):  # another process has finished it meanwhile
            return
        try:
            columns = episode_columns(
                self._dataset,
                item.episode,
                self._scorer,
                self._plan.recipe,
                memory=self._memory,
                go_on=self._go_on,
            )
        except InferenceFailedError:  # perhaps of a checkpoint that came meanwhile
            self._check_checkpoint()
            raise
        self._check_checkpoint()
        self._parts.write(item, columns)

    def _check_checkpoint(self) -> None:
        """Raises _StoppedError, and stops the run, where another checkpoint is served by now."""
        try:
            planned, now = self._plan.recipe.checkpoint, self._scorer.checkpoint()
            for name in ("weights_digest", "settings_digest"):
                if getattr(now, name) != getattr(planned, name):
                    raise InvalidSampleError.at(name, getattr(planned, name), getattr(now, name))
        except InvalidSampleError as error:
            self._stop(error)
            raise _StoppedError from error

    def _stop(self, cause: Exception) -> _Fate:
        with self._lock:
            self._cause = self._cause or cause
        self._stopping.set()
        return _Fate.NOT_NOW

    def _go_on(self) -> None:
        if self._stopping.is_set():
            raise _StoppedError
