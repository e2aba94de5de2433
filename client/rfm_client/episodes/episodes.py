# SPDX-License-Identifier: MIT
"""An episode that grows frame by frame. H x W pixels."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

from rfm_client.contract.description import FrameSize, ModelInfo
from rfm_client.episodes.options import StepScore
from rfm_client.episodes.scorer import Asked
from rfm_client.episodes.steps import Steps
from rfm_client.transport.limits import Deadline
from rfm_client.transport.threads import Closing, OneProcess


class Episode(Closing, OneProcess):
    """One episode that grows. ``RewardClient.episode`` builds it. A context manager.

    It keeps all frames until it ends, because later steps show them again.

    begin: returns the deadline for a step that begins now. Raises RuntimeError in a future's callback
    score: scores steps before a deadline
    model_info: describes the model
    """

    def __init__(
        self,
        steps: Steps,
        begin: Callable[[float | None], Deadline],
        score: Callable[[Sequence[Asked], Deadline], list[StepScore]],
        model_info: Callable[..., ModelInfo],
    ) -> None:
        self._begin, self._score, self._model_info = begin, score, model_info
        self._steps = steps
        self._size: FrameSize | None = None  # frames shrink to this size
        self._adding = threading.Lock()

    @property
    def asked(self) -> Asked:
        """The question about the newest frame, for ``RewardClient.score_episodes``."""
        return self._steps, self._steps.newest

    @property
    def step(self) -> int:
        """The newest frame's index, from 0; -1: none yet."""
        return self._steps.newest

    def keep(self, frame: Any) -> None:
        """Add a frame without a request: ``RewardClient.score_episodes`` scores it. frame: as in ``add``.

        Raises InvalidSampleError; RewardError if the server does not report the size for ``resize``.
        """
        if self.step < 0:
            self._size = self._frame_size(self._steps.options.timeout_s)
        self._steps.frames.append(self._steps.checked(frame, self._size))

    def add(self, frame: Any) -> StepScore:
        """Add a frame, and score the episode so far.

        frame: uint8 [H, W, 3]; with cameras, a dict

        Raises RewardError. Then the episode has not grown, and the step may be repeated.
        """
        deadline = self._begin(self._steps.options.timeout_s)
        if not self._adding.acquire(timeout=deadline.remaining_s()):
            raise deadline.exceeded()
        try:
            self._size = self._frame_size(deadline.remaining_s())
            steps, new = self._steps, self._steps.checked(frame, self._size)
            steps.frames.append(new)
            try:
                (score,) = self._score([self.asked], deadline)
                return score
            except BaseException:
                steps.frames.remove(new)
                raise
        finally:
            self._adding.release()

    def reset(self, task: str | None = None) -> None:
        """Begin a new episode, once no step is open. ``task``: None: as before."""
        self._begin(None)  # in a callback, the open step would wait for this one
        with self._adding:
            self._steps = self._steps.anew(task)

    def close(self) -> None:
        """End the episode. Sends nothing."""

    def _frame_size(self, timeout_s: float | None) -> FrameSize | None:
        """Return the target size for frames; None: no change. Raises RewardError."""
        if not self._steps.options.resize:
            return None
        return self._model_info(frames=True, timeout_s=timeout_s).frame_size
