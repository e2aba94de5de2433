# SPDX-License-Identifier: MIT
"""Episodes that grow frame by frame, for code that waits. N episodes, H x W pixels."""

from __future__ import annotations

from collections.abc import Coroutine, Sequence
from concurrent.futures import Future
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from rfm_client.episodes.async_episodes import AsyncEpisode, AsyncEpisodes
from rfm_client.episodes.frames import copied
from rfm_client.episodes.scores import StepScore, StepScores
from rfm_client.transport.one_process import OneProcess

if TYPE_CHECKING:
    import numpy.typing as npt

Given = TypeVar("Given")


class Loop(Protocol):
    """The event loop of a client, in a thread of its own."""

    def wait(self, work: Coroutine[Any, Any, Given]) -> Given:
        """What the coroutine gives."""

    def start(self, work: Coroutine[Any, Any, Given]) -> Future[Given]:
        """What the coroutine will give."""


class Episodes(OneProcess):
    """AsyncEpisodes without ``await``. Built by ``RewardClient.episodes``, whose client lives as long as this.

    A context manager that closes it.
    """

    def __init__(self, episodes: AsyncEpisodes, loop: Loop, client: object) -> None:
        self._episodes, self._loop, self._client = episodes, loop, client

    def __len__(self) -> int:
        return len(self._episodes)

    def add(self, frames: Any, mask: npt.ArrayLike | None = None) -> StepScores:
        """Adds a frame to each episode, and gives the scores of the episodes so far.

        frames: uint8 [N, H, W, 3], an array, a torch tensor or a sequence of frames; with cameras, such by name
        mask: bool [N], which episodes have a new frame; None: all

        Raises RewardError. Then no episode has grown: the step may be tried again.
        """
        return self._loop.wait(self._episodes.add(frames, mask))

    def reset(self, mask: npt.ArrayLike | None = None, task: str | Sequence[str] | None = None) -> None:
        """Begins new episodes: those in ``mask``, bool [N], or all. ``task``: of all of these, or of each."""
        self._loop.wait(self._episodes.reset(mask, task))

    def close(self) -> None:
        """Returns when no step is open. Who watches is told that the episodes have ended."""
        self._loop.wait(self._episodes.close())

    def __enter__(self) -> Episodes:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


class Episode(OneProcess):
    """One episode that grows. Built by ``RewardClient.episode``, whose client lives as long as this. A context manager
    that closes it.
    """

    def __init__(self, episode: AsyncEpisode, loop: Loop, client: object) -> None:
        self._episode, self._loop, self._client = episode, loop, client

    def add(self, frame: Any) -> StepScore:
        """Adds a frame, uint8 [H, W, 3] or such by camera, and gives the score of the episode so far. It waits for a
        question that is open; a frame that waits for that, too, is dropped.

        Raises RewardError. Then the episode has not grown: the step may be tried again.
        """
        return self._loop.wait(self._episode.add(frame))

    def add_nowait(self, frame: Any) -> Future[StepScore]:
        """Adds a frame and returns at once. While a question is open the frame waits; if another comes meanwhile, the
        newer one takes its place, and the older's future is cancelled: that frame is not part of the episode.

        The future raises RewardError.
        """
        frame = copied(frame)

        async def answer() -> StepScore:
            return await self._episode.add_nowait(frame)

        return self._loop.start(answer())

    def reset(self, task: str | None = None) -> None:
        """Begins a new episode; a frame that waits is dropped. ``task``: None: as before."""
        self._loop.wait(self._episode.reset(task))

    def close(self) -> None:
        """Returns when no question is open; a frame that waits is dropped. Who watches is told that it has ended."""
        self._loop.wait(self._episode.close())

    def __enter__(self) -> Episode:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
