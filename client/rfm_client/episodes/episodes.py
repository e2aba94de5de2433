# SPDX-License-Identifier: MIT
"""Episodes that grow frame by frame. N episodes, H x W pixels."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from rfm_client.contract.checks import require
from rfm_client.contract.description import FrameSize
from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.results import FRAME_SCORES
from rfm_client.contract.samples import checked_mask
from rfm_client.episodes.options import StepScore, StepScores
from rfm_client.episodes.scorer import Asked
from rfm_client.episodes.steps import Steps, check_cameras
from rfm_client.transport.threads import Closing, LoopThread, OneProcess

if TYPE_CHECKING:
    from rfm_client.async_client import AsyncRewardClient


class Episodes(Closing, OneProcess):
    """N episodes in step, as in vectorised environments. ``RewardClient.episodes`` builds it. A context manager.

    A step sends as few requests as possible. Episodes keep all frames until they end, because later steps show them
    again.

    loop: runs ``client``
    owner: stays alive as long as the episodes
    """

    def __init__(self, client: AsyncRewardClient, loop: LoopThread, owner: object, steps: list[Steps]) -> None:
        require("episodes", len(steps) > 0, "at least one", "none")
        self.steps = steps
        self._client, self._loop, self._owner = client, loop, owner
        self._options = steps[0].options
        self._adding = threading.Lock()
        self._checking = ThreadPoolExecutor(min(len(steps), os.cpu_count() or 1))

    def __len__(self) -> int:
        return len(self.steps)

    def add(self, frames: Any, mask: npt.ArrayLike | None = None) -> StepScores:
        """Add a frame to each episode, and score the episodes so far.

        frames: uint8 [N, H, W, 3], an array, torch tensor or sequence; with cameras, a dict
        mask: bool [N], True for episodes with a new frame; None: all

        Raises RewardError, ``episodes[3].frame: expected X, got Y``. Then no episode has grown, and the step may be
        repeated.
        """
        asked_s = time.perf_counter()
        with self._adding:
            indices = _indices(mask, len(self))
            given, size = self._given(frames, indices), self.frame_size()
            new = list(self._checking.map(lambda index: self.steps[index].checked(given[index], size), indices))
            added = [self.steps[index] for index in indices]
            for steps, frame in zip(added, new, strict=True):
                steps.append(frame)
            try:
                asked = [(steps, steps.newest) for steps in added]
                scores = self._loop.wait(self._client.score_steps(asked, asked_s, timeout_s=self._options.timeout_s))
            except BaseException:
                for steps, frame in zip(added, new, strict=True):
                    steps.remove(frame)
                raise
            return self._gathered(dict(zip(indices, scores, strict=True)))

    def reset(self, mask: npt.ArrayLike | None = None, task: str | Sequence[str] | None = None) -> None:
        """Begin new episodes, once no step is open.

        mask: bool [N], True for episodes that begin anew; None: all
        task: one for all new episodes, or a sequence; None: as before
        """
        with self._adding:
            indices = _indices(mask, len(self))
            tasks = [task] * len(indices) if task is None or isinstance(task, str) else list(task)
            require("task", len(tasks) == len(indices), f"one for each of {len(indices)} episodes", len(tasks))
            for index, new in zip(indices, tasks, strict=True):
                self.steps[index] = self.steps[index].anew(new)

    def close(self) -> None:
        """End the episodes. Sends nothing."""

    def frame_size(self) -> FrameSize | None:
        """Return the target size for frames; None: no change. Raises RewardError."""
        if not self._options.resize:
            return None
        info = self._client.model_info(frames=True, timeout_s=self._options.timeout_s)
        return self._loop.wait(info).frame_size

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


class Episode(Closing, OneProcess):
    """One episode that grows. ``RewardClient.episode`` builds it. A context manager."""

    def __init__(self, episodes: Episodes) -> None:
        self._episodes = episodes  # holds a single episode
        self._size: FrameSize | None = None  # ``keep`` shrinks frames to this size

    @property
    def asked(self) -> Asked:
        """The question about the newest frame, for ``RewardClient.score_episodes``."""
        steps = self._episodes.steps[0]
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
        if newest < 0:
            self._size = self._episodes.frame_size()
        steps.append(steps.checked(frame, self._size))

    def add(self, frame: Any) -> StepScore:
        """Add a frame, and score the episode so far.

        frame: uint8 [H, W, 3]; with cameras, a dict

        Raises RewardError. Then the episode has not grown, and the step may be repeated.
        """
        frames = {camera: [each] for camera, each in frame.items()} if isinstance(frame, Mapping) else [frame]
        return self._episodes.add(frames).of(0)

    def reset(self, task: str | None = None) -> None:
        """Begin a new episode, once no step is open. ``task``: None: as before."""
        self._episodes.reset(task=task)

    def close(self) -> None:
        """End the episode. Sends nothing."""


def _indices(mask: npt.ArrayLike | None, count: int) -> list[int]:
    """Return the indices of the episodes in a mask. Raises ValueError unless it is bool [count]."""
    if mask is None:
        return list(range(count))
    return [int(index) for index in np.flatnonzero(checked_mask("mask", mask, count))]
