# SPDX-License-Identifier: MIT
"""Episodes of parallel environments, the basis of every wrapper. ``gym.py`` states the rules."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded

from rfm_client import InvalidSampleError, RewardClient, as_array
from rfm_client.options import InvalidValueError
from rfm_rl.rewards import RewardedEpisode, RewardOptions

ClientSource: TypeAlias = RewardClient | Callable[[], RewardClient]
Mask: TypeAlias = npt.NDArray[np.bool_]
Frames: TypeAlias = Callable[[int], Any]  # from an environment's number to its frame, or frames by camera

INFO = "reward_model"  # key in info
_LOST = "an earlier call failed before its frame was kept"
_INSIDE = (
    "put the time limit inside the wrapper: RewardModelWrapper(TimeLimit(env, steps), ...), "
    "or gymnasium.make(..., max_episode_steps=steps)"
)

logger = logging.getLogger("rfm_client")


class RewardedEnvs:
    """Running episodes of several environments; one request scores all newest frames. Connects at the first request.

    A wrapper calls ``check_reset``, resets its environments, and calls ``begin``; or calls ``check_step``, steps them,
    and calls ``keep``. After an error between the two, the environments need a reset.

    tasks: task sentence for each environment's next episode
    final: what errors call an episode's last frame if the environment has reset in the same step
    remedy: for a step that needs a reset
    returns_copies: True: no environment draws over a frame that it has returned
    is_only: True: errors do not name the environment
    """

    def __init__(
        self,
        client: ClientSource,
        options: RewardOptions,
        tasks: list[str],
        *,
        remedy: str,
        final: str = "",
        returns_copies: bool = False,
        is_only: bool = False,
    ) -> None:
        if not (isinstance(client, RewardClient) or callable(client)):
            got = type(client).__name__
            raise TypeError(f"client: expected a RewardClient or a function that makes one, got {got}")
        self.tasks = tasks
        self.episodes: dict[int, RewardedEpisode] = {}
        self.ended: Mask = np.zeros(len(tasks), np.bool_)  # a step would follow the end of their episode
        self._whole: Mask = np.zeros(len(tasks), np.bool_)  # all frames of the episode are kept
        self._kept: Mask = self._whole  # those that stay whole in the current reset
        self._resetting: Mask = self.ended  # in the current reset or step
        self._source, self._options = client, options
        self._remedy, self._final, self._is_only = remedy, final, is_only
        self._returning_copies = set(range(len(tasks))) if returns_copies else set()  # environments by number
        self._made: RewardClient | None = None
        self._has_dropped = False  # the last reset dropped a reward, and no episode has ended since
        self._has_warned = False
        self._has_failed = False  # the last request failed

    @property
    def succeeded(self) -> Mask:
        """Environments whose episode a success has ended."""
        return np.array([episode.succeeded for _, episode in sorted(self.episodes.items())], np.bool_)

    def check_reset(self, mask: Mask) -> None:
        """Warn once if a reset drops the reward of unended episodes, except after an error. Call this before the reset.

        Raises ValueError in mode ``final`` for the second such reset in a row: episodes that end outside the wrapper
        would never be paid. An end or an error between the resets allows the second.
        """
        running = [self.episodes[index] for index in _numbers(mask & self._whole)]
        unpaid = next((episode for episode in running if episode.is_unpaid), None)
        if unpaid is not None and not self._has_failed:
            self._check_dropped(unpaid)
        self._resetting, self._kept = mask, self._whole & ~mask
        self._whole = np.zeros_like(mask)

    def begin(self, first: Frames) -> None:
        """Begin episodes after a reset, and score their first frames. Raises RewardError."""
        self._whole, self.ended = self._kept, self.ended & ~self._resetting
        fresh = self._begin(self._resetting, first, {})
        self._score(dict.fromkeys(fresh, False))

    def check_step(self, resetting: Mask) -> None:
        """Raise ResetNeeded if an environment needs a reset before the next step.

        Score first frames that a failed call left without a score. Raises RewardError before the environments step.

        resetting: environments that only reset in this step
        """
        if len(self.episodes) != len(self.tasks):
            every = "a reset" if self._is_only else "a reset of every environment"
            raise ResetNeeded(f"step: expected {every} before it")
        over = (self.ended | self.succeeded) & ~resetting
        has_ended = "the episode has ended" if self._is_only else "their episodes have ended"
        for indices, reason in ((over, has_ended), (~self._whole & ~resetting, _LOST)):
            if indices.any():
                which = "" if self._is_only else f" of the environments {_numbers(indices)}"
                expected = f"expected a reset{which}, since {reason}, got another step"
                raise ResetNeeded(f"step: {expected}; {self._remedy}")
        self._score({episode: False for episode in self.episodes.values() if episode.known is None})
        self._resetting, self._whole = resetting, np.zeros_like(self._whole)

    def keep(
        self,
        shown: Frames,
        env_rewards: npt.ArrayLike,
        terminated: npt.ArrayLike,
        truncated: npt.ArrayLike,
        *,
        final: Frames | None = None,
    ) -> tuple[npt.NDArray[np.float64], dict[int, RewardedEpisode]]:
        """Add the frames after a step, and score what is due. Raises RewardError.

        A frame is kept as soon as it is made, because the next may reuse its array.

        shown: the frames after the step
        final: the last frames of episodes whose environments have reset in this step; None: they have not
        Returns the rewards, float64 [num_envs], 0 for a reset, and the stepped episodes
        """
        terminated, ended = np.asarray(terminated, np.bool_), np.logical_or(terminated, truncated)
        stepped = {index: self.episodes[index] for index in _numbers(~self._resetting)}
        at_once = ended & ~self._resetting & (final is not None)
        self.ended = ended & ~at_once
        last = {}
        for index, episode in stepped.items():
            frame = final(index) if final is not None and at_once[index] else shown(index)
            if at_once[index]:
                last[index] = frame = _copied(frame)
            episode.steps.keep(frame)
            self._whole[index] = not at_once[index]
        fresh = self._begin(self._resetting | at_once, shown, last)
        self._score({episode: bool(ended[index]) for index, episode in stepped.items()} | dict.fromkeys(fresh, False))
        rewards, paid = np.zeros(len(self.tasks)), np.asarray(env_rewards)
        for index, episode in stepped.items():
            rewards[index] = episode.reward(float(paid[index]), bool(terminated[index]))
        return rewards, stepped

    def close(self) -> None:
        """Cancel open requests; close the client if it was made here."""
        for episode in self.episodes.values():
            episode.end()
        if self._made is not None:
            self._made.close()

    def _check_dropped(self, unpaid: RewardedEpisode) -> None:
        where = "reset" if unpaid.index is None else f"envs[{unpaid.index}]: reset"
        got = f"one after {unpaid.steps.step} steps, whose reward is lost"
        self._has_dropped = not self._has_dropped  # a third reset may go on
        if not self._has_dropped and self._options.mode == "final":
            expected = "the end of an episode before it, where mode 'final' pays"
            raise InvalidValueError.at(where, expected, f"{got}, for the second time in a row", _INSIDE)
        if not self._has_warned:
            self._has_warned = True
            logger.warning("%s: expected the end of the episode before it, got %s; %s", where, got, _INSIDE)

    def _begin(self, mask: Mask, first: Frames, last: Mapping[int, Any]) -> list[RewardedEpisode]:
        """Begin an episode in each masked environment. last: copies of the last frames of the episodes before"""
        fresh = []
        for index in _numbers(mask):
            if index in self.episodes and index not in last:
                self.episodes[index].end()
            frame, number = first(index), None if self._is_only else index
            steps = self._client.episode(self.tasks[index], env=number, **self._options.scoring)
            steps.keep(frame)
            self.episodes[index] = RewardedEpisode(self._options, steps, number)
            self._whole[index] = True
            fresh.append(self.episodes[index])
            if index in last and index not in self._returning_copies:
                self._check_differ(index, last[index], _copied(frame))
        return fresh

    def _check_differ(self, index: int, last: Any, first: Any) -> None:
        """Raise InvalidSampleError if a reset may have drawn over the previous episode's last frame.

        An environment that draws into one array shows equal frames at every end.
        """
        pairs = [(last[camera], first[camera]) for camera in last] if isinstance(last, Mapping) else [(last, first)]
        if any(np.array_equal(*pair) for pair in pairs):
            got = "the first frame of the next one: the environment ended where it begins, or drew over its last frame"
            remedy = "wrap each environment in rfm_rl.CopiedObservation, which pays both"
            where = self._final.format(index)
            raise InvalidSampleError.at(where, "the last frame of the ended episode", f"{got}; {remedy}")
        self._returning_copies.add(index)

    def _score(self, episodes: Mapping[RewardedEpisode, bool]) -> None:
        """Collect known scores, and request those that are due for newest frames. Raises RewardError.

        episodes: True for an episode whose newest frame is its last
        """
        has_dropped, self._has_dropped = self._has_dropped, False
        self._has_failed = True  # after an error, a reset may drop a reward
        try:
            self._ask(episodes)
            self._has_dropped, self._has_failed = has_dropped, False
        finally:
            for episode in (episode for episode, ends in episodes.items() if ends or episode.succeeded):
                episode.end()
                self._has_dropped = False

    def _ask(self, episodes: Mapping[RewardedEpisode, bool]) -> None:
        awaited = []
        for episode, ends in episodes.items():
            episode.collect()
            ends = ends or episode.succeeded
            is_first = episode.known is None
            due = ends or is_first or self._options.is_due(episode.steps.step)
            waits = self._options.blocking or is_first or ends
            if ends:
                episode.cancel()
            if due and waits:
                awaited.append(episode)
            elif due and len(episode.pending) >= self._options.max_pending:
                episode.num_skipped += 1
            elif due:
                episode.pending.append(self._client.submit_episodes([episode.steps]))
        if awaited:
            scores = self._client.score_episodes([episode.steps for episode in awaited])
            for episode, score in zip(awaited, scores, strict=True):
                episode.learn(score)

    @property
    def _client(self) -> RewardClient:
        if isinstance(self._source, RewardClient):
            return self._source
        if self._made is None:
            self._made = self._source()
        return self._made


def _numbers(mask: Mask) -> list[int]:
    numbers: list[int] = np.flatnonzero(mask).tolist()
    return numbers


def _copied(frame: Any) -> Any:
    """Return a copy of a frame, or of a dict of frames by camera."""
    if isinstance(frame, Mapping):
        return {camera: np.array(as_array(each)) for camera, each in frame.items()}
    return np.array(as_array(frame))
