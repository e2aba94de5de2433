# SPDX-License-Identifier: MIT
"""Episodes that grow frame by frame, for asyncio and for blocking code. N episodes, H x W pixels."""

from __future__ import annotations

import asyncio
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract.checks import require
from rfm_client.contract.description import FrameSize
from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.results import FRAME_SCORES
from rfm_client.contract.samples import checked_mask
from rfm_client.episodes.options import StepScore, StepScores
from rfm_client.episodes.scorer import Asked, StepScorer
from rfm_client.episodes.steps import Frame, Steps, check_cameras, copied
from rfm_client.scoring.samples import Call, CallOptions
from rfm_client.transport.threads import AsyncClosing, Closing, LoopThread, OneProcess


class AsyncEpisodes(AsyncClosing, OneProcess):
    """N episodes in step, as in vectorised environments. An async context manager.

    A step sends as few requests as possible. Episodes keep all frames until they end, because later steps show them
    again.

    begin: client method that starts a call now
    steps: one entry per episode
    """

    def __init__(self, scorer: StepScorer, begin: Callable[[CallOptions], Call], steps: list[Steps]) -> None:
        require("episodes", len(steps) > 0, "at least one", "none")
        self.steps = steps
        self._scorer, self._begin, self._options = scorer, begin, steps[0].options
        self._timed: CallOptions = {"timeout_s": self._options.timeout_s}
        self._adding = asyncio.Lock()

    def __len__(self) -> int:
        return len(self.steps)

    async def add(self, frames: Any, mask: npt.ArrayLike | None = None) -> StepScores:
        """Add a frame to each episode, and score the episodes so far.

        frames: uint8 [N, H, W, 3], an array, torch tensor or sequence; with cameras, a dict
        mask: bool [N], True for episodes with a new frame; None: all

        Raises RewardError, ``episodes[3].frame: expected X, got Y``. Then no episode has grown, and the step may be
        repeated.
        """
        asked_s, call = time.perf_counter(), self._begin(self._timed)
        async with self._adding:
            indices = _indices(mask, len(self))
            new = await self._checked(frames, indices, await self.frame_size(call))
            added = [self.steps[index] for index in indices]
            for steps, frame in zip(added, new, strict=True):
                steps.append(frame)
            try:
                scores = await self._scorer.scores([(steps, steps.newest) for steps in added], call, asked_s)
            except BaseException:
                for steps, frame in zip(added, new, strict=True):
                    steps.remove(frame)
                raise
            return self._gathered(dict(zip(indices, scores, strict=True)))

    async def reset(self, mask: npt.ArrayLike | None = None, task: str | Sequence[str] | None = None) -> None:
        """Begin new episodes, once no step is open.

        mask: bool [N], True for episodes that begin anew; None: all
        task: one for all new episodes, or a sequence; None: as before
        """
        async with self._adding:
            indices = _indices(mask, len(self))
            tasks = [task] * len(indices) if task is None or isinstance(task, str) else list(task)
            require("task", len(tasks) == len(indices), f"one for each of {len(indices)} episodes", len(tasks))
            for index, new in zip(indices, tasks, strict=True):
                self.steps[index] = self.steps[index].anew(new)

    async def close(self) -> None:
        """End the episodes, once no step is open."""
        async with self._adding:
            pass

    async def frame_size(self, call: Call | None = None) -> FrameSize | None:
        """Return the target size for frames; None: no change. Raises RewardError."""
        if not self._options.resize:
            return None
        return (await self._scorer.model_info(call or self._begin(self._timed))).frame_size

    async def _checked(self, frames: Any, indices: Sequence[int], size: FrameSize | None) -> list[tuple[Frame, ...]]:
        """Check these episodes' new frames, with at most one thread per processor."""
        given = self._given(frames, indices)

        def checked(some: Sequence[int]) -> list[tuple[Frame, ...]]:
            return [self.steps[index].checked(given[index], size) for index in some]

        count = max(1, math.ceil(len(indices) / (os.cpu_count() or 1)))
        parts = [indices[first : first + count] for first in range(0, len(indices), count)]
        making = [asyncio.create_task(asyncio.to_thread(checked, part)) for part in parts]
        await asyncio.gather(*making, return_exceptions=True)  # raises the first episode's error, not the quickest
        return [frame for part in making for frame in part.result()]

    def _given(self, frames: Any, indices: Sequence[int]) -> dict[int, Any]:
        """Return the new frame for each episode; with cameras, a dict."""
        cameras = self._options.cameras
        check_cameras("frames", frames, cameras)
        of_cameras = {f"frames[{camera!r}]": frames[camera] for camera in cameras} or {"frames": frames}
        for where, each in of_cameras.items():
            count = len(each) if hasattr(each, "__len__") else type(each).__name__
            require(where, count == len(self), f"a frame of each of {len(self)} episodes", count, InvalidSampleError)
        if not cameras:
            return {index: frames[index] for index in indices}
        return {index: {camera: frames[camera][index] for camera in cameras} for index in indices}

    def _gathered(self, scores: Mapping[int, StepScore]) -> StepScores:
        """Return scores for all episodes; NaN and False where there is none."""
        progress, success = (np.full(len(self), np.nan, np.float32) for _ in range(2))
        succeeded = np.zeros(len(self), bool)
        more: dict[str, npt.NDArray[Any]] = {}
        for index, score in scores.items():
            progress[index], success[index], succeeded[index] = score.progress, score.success, score.succeeded
            for name, value in score.more_scores.items():
                missing = np.zeros(len(self), bool) if FRAME_SCORES[name].mark else np.full_like(progress, np.nan)
                more.setdefault(name, missing)[index] = value
        steps = np.array([steps.newest for steps in self.steps], np.int64)
        ms = max((score.ms for score in scores.values()), default=0.0)
        return StepScores(progress, success, succeeded, steps, ms, more)


class AsyncEpisode(AsyncClosing, OneProcess):
    """One episode that grows, for asyncio. ``AsyncRewardClient.episode`` builds it. An async context manager."""

    def __init__(self, episodes: AsyncEpisodes) -> None:
        self.episodes = episodes  # holds a single episode
        self._open: asyncio.Task[StepScore] | None = None
        self._waiting: asyncio.Task[StepScore] | None = None  # waits for the open request to end

    async def add(self, frame: Any) -> StepScore:
        """Add a frame, and score the episode so far.

        Waits for an open request. Also drops a waiting frame from ``add_nowait``.

        frame: uint8 [H, W, 3]; with cameras, a dict

        Raises RewardError. Then the episode has not grown, and the step may be repeated.
        """
        await self._settle()
        return await self._add(frame)

    def add_nowait(self, frame: Any) -> asyncio.Future[StepScore]:
        """Add a frame, as in ``add``, and return a future score.

        While a request is open, the frame waits. A newer frame replaces it, and cancels its future. A frame with a
        cancelled future does not join the episode.
        """
        frame = copied(frame)
        if self._open is None or (self._open.done() and self._waiting is None):
            self._open = asyncio.create_task(self._add(frame))
            return self._open
        self._drop_waiting()
        self._waiting = asyncio.create_task(self._add_after(self._open, frame))
        return self._waiting

    async def reset(self, task: str | None = None) -> None:
        """Begin a new episode, once no request is open; drop a waiting frame. ``task``: None: as before."""
        await self._settle()
        await self.episodes.reset(task=task)

    async def close(self) -> None:
        """End the episode, once no request is open; drop a waiting frame."""
        await self._settle()
        await self.episodes.close()

    async def _settle(self) -> None:
        self._drop_waiting()
        if self._open is not None and not self._open.done():
            await asyncio.wait({self._open})  # cancelling this wait does not cancel the request

    def _drop_waiting(self) -> None:
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None

    async def _add(self, frame: Any) -> StepScore:
        frames = {camera: [each] for camera, each in frame.items()} if isinstance(frame, Mapping) else [frame]
        return (await self.episodes.add(frames)).of(0)

    async def _add_after(self, before: asyncio.Task[StepScore], frame: Any) -> StepScore:
        await asyncio.wait({before})
        self._open, self._waiting = self._waiting, None
        return await self._add(frame)


class Episodes(Closing, OneProcess):
    """AsyncEpisodes without ``await``. ``RewardClient.episodes`` builds it. A context manager."""

    def __init__(self, episodes: AsyncEpisodes, loop: LoopThread, client: object) -> None:
        self._episodes, self._loop, self._client = episodes, loop, client

    def __len__(self) -> int:
        return len(self._episodes)

    def add(self, frames: Any, mask: npt.ArrayLike | None = None) -> StepScores:
        """Add a frame to each episode, and return the scores, like ``AsyncEpisodes.add``. Raises RewardError."""
        return self._loop.wait(self._episodes.add(frames, mask))

    def reset(self, mask: npt.ArrayLike | None = None, task: str | Sequence[str] | None = None) -> None:
        """Begin new episodes, like ``AsyncEpisodes.reset``. mask: bool [N]."""
        self._loop.wait(self._episodes.reset(mask, task))

    def close(self) -> None:
        """End the episodes, like ``AsyncEpisodes.close``."""
        self._loop.wait(self._episodes.close())


class Episode(Closing, OneProcess):
    """AsyncEpisode without ``await``, and frames without a request. ``RewardClient.episode`` builds it.

    A context manager.
    """

    def __init__(self, episode: AsyncEpisode, loop: LoopThread, client: object) -> None:
        self._episode, self._loop, self._client = episode, loop, client
        self._size: FrameSize | None = None  # ``keep`` shrinks frames to this size
        self._is_queued = False  # an ``add_nowait`` request may be open

    @property
    def asked(self) -> Asked:
        """The question about the newest frame, for ``RewardClient.score_episodes``."""
        steps = self._episode.episodes.steps[0]
        return steps, steps.newest

    @property
    def step(self) -> int:
        """The newest frame's index, from 0; -1: none yet."""
        return self.asked[1]

    def keep(self, frame: Any) -> None:
        """Add a frame without a request: ``RewardClient.score_episodes`` scores it. frame: as in ``add``.

        Raises InvalidSampleError; RewardError if the server does not report the size for ``resize``.
        """
        steps, newest = self.asked
        if newest < 0 and steps.options.resize:
            self._size = self._loop.wait(self._episode.episodes.frame_size())
        steps.append(steps.checked(frame, self._size))

    def add(self, frame: Any) -> StepScore:
        """Add a frame, uint8 [H, W, 3], and return the score, like ``AsyncEpisode.add``. Raises RewardError."""
        return self._loop.wait(self._episode.add(frame))

    def add_nowait(self, frame: Any) -> Future[StepScore]:
        """Add a frame, and return a future score at once, like ``AsyncEpisode.add_nowait``."""
        frame = copied(frame)
        self._is_queued = True

        async def answer() -> StepScore:
            return await self._episode.add_nowait(frame)

        return self._loop.start(answer())

    def reset(self, task: str | None = None) -> None:
        """Begin a new episode, like ``AsyncEpisode.reset``. ``task``: None: as before."""
        self._loop.wait(self._episode.reset(task))

    def close(self) -> None:
        """End the episode, like ``AsyncEpisode.close``."""
        if self._is_queued:
            self._loop.wait(self._episode.close())


def _indices(mask: npt.ArrayLike | None, count: int) -> list[int]:
    """Return the indices of the episodes in a mask. Raises ValueError unless it is bool [count]."""
    if mask is None:
        return list(range(count))
    return [int(index) for index in np.flatnonzero(checked_mask("mask", mask, count))]
