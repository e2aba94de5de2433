# SPDX-License-Identifier: MIT
"""Episodes that grow frame by frame, for asyncio. N episodes, H x W pixels."""

from __future__ import annotations

import asyncio
import math
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from rfm_client.contract.errors import InvalidSampleError, RewardError
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.results import ProgressResult, Result
from rfm_client.contract.samples import UInt8Array, as_array
from rfm_client.data.camera_fusion import FUSES
from rfm_client.data.orientation import turned
from rfm_client.data.resize import resize_frames
from rfm_client.data.sampling import Prefix, Sampling, of_frames
from rfm_client.episodes.frames import checked_frame, copied, orientations_of
from rfm_client.episodes.live import LiveEpisode
from rfm_client.episodes.options import EpisodeOptions
from rfm_client.episodes.scores import StepScore, StepScores
from rfm_client.episodes.windows import NamedFrame, Window
from rfm_client.transport.deadline import Deadline
from rfm_client.transport.one_process import OneProcess

if TYPE_CHECKING:
    import numpy.typing as npt

ONLY_CAMERA = ""  # of episodes whose camera has no name


class Windows(Protocol):
    """What episodes need of a client."""

    async def score_windows(
        self, windows: Sequence[Window], *, timeout_s: float | None = None
    ) -> list[Result | RewardError]:
        """The result or error of each window."""

    async def model_info(self, *, frames: bool = False, timeout_s: float | None = None) -> ModelInfo:
        """What the server says of its model."""


class AsyncEpisodes(OneProcess):
    """N episodes that grow side by side, as those of vectorised environments; as few requests a step as fit. An async
    context manager that closes it.

    All frames of the running episodes are kept, as later ones are shown with them.

    tasks: of each episode
    timeout_s: the longest that a step may take, retries included; None: the client's
    """

    def __init__(
        self, client: Windows, tasks: Sequence[str], options: EpisodeOptions, timeout_s: float | None = None
    ) -> None:
        if not tasks:
            raise ValueError("episodes: expected at least one, got none")
        self._client = client
        self._options = options
        self._timeout_s = timeout_s
        self._cameras = options.cameras or (ONLY_CAMERA,)
        self._orientations = dict(zip(self._cameras, orientations_of(options.orient, options.cameras), strict=True))
        self._tasks = list(tasks)
        self._frames: list[dict[str, list[NamedFrame]]] = [self._none() for _ in tasks]
        self._live: dict[int, LiveEpisode] = {}  # of those that are watched
        self._sampling: Sampling | None = None
        self._info: ModelInfo | None = None
        self._adding = asyncio.Lock()

    def __len__(self) -> int:
        return len(self._tasks)

    async def add(self, frames: Any, mask: npt.ArrayLike | None = None) -> StepScores:
        """Adds a frame to each episode, and gives the scores of the episodes so far.

        frames: uint8 [N, H, W, 3], an array, a torch tensor or a sequence of frames; with cameras, such by name
        mask: bool [N], which episodes have a new frame; None: all

        Raises RewardError, ``episodes[3].frame: expected X, got Y``. Then no episode has grown: the step may be tried
        again.
        """
        started_s = time.perf_counter()
        deadline = None if self._timeout_s is None else Deadline(self._timeout_s)
        async with self._adding:
            added = _indices(mask, len(self))
            await self._prepare(deadline)
            new = await self._all_named(frames, added)
            for index, of_cameras in zip(added, new, strict=True):
                for camera, frame in of_cameras.items():
                    self._frames[index][camera].append(frame)
            try:
                results = await self._results(added, deadline)
            except BaseException:
                for index in added:
                    for kept in self._frames[index].values():
                        kept.pop()
                raise
            scores = self._scores(added, results, (time.perf_counter() - started_s) * 1e3)
            self._report(added, scores)
            return scores

    async def reset(self, mask: npt.ArrayLike | None = None, task: str | Sequence[str] | None = None) -> None:
        """Begins new episodes, when no step is open.

        mask: bool [N], which ones; None: all
        task: of all of these, or of each; None: as before
        """
        async with self._adding:
            self._begin(mask, task)

    async def close(self) -> None:
        """Returns when no step is open. Who watches is told that the episodes have ended."""
        async with self._adding:
            self._end_live(range(len(self)))

    async def __aenter__(self) -> AsyncEpisodes:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.close()

    def _end_live(self, indices: Iterable[int]) -> None:
        for index in indices:
            if index in self._live:
                self._live.pop(index).end()

    def _report(self, indices: Sequence[int], scores: StepScores) -> None:
        view = self._options.live
        if view is None:
            return
        for index in indices:
            if index not in self._live:
                self._live[index] = view.episode(self._tasks[index], index, self._options.success.threshold)
            newest = next(iter(self._frames[index].values()))[-1]
            self._live[index].add(newest.pixels, scores.of(index))

    def _begin(self, mask: npt.ArrayLike | None, task: str | Sequence[str] | None) -> None:
        indices = _indices(mask, len(self))
        tasks = [task] * len(indices) if task is None or isinstance(task, str) else list(task)
        if len(tasks) != len(indices):
            raise ValueError(f"task: expected one for each of {len(indices)} episodes, got {len(tasks)}")
        self._end_live(indices)
        for index, new in zip(indices, tasks, strict=True):
            self._frames[index] = self._none()
            if new is not None:
                self._tasks[index] = new

    def _none(self) -> dict[str, list[NamedFrame]]:
        return {camera: [] for camera in self._cameras}

    async def _prepare(self, deadline: Deadline | None) -> None:
        """Finds out what the checkpoint reads. The client knows it, until another version of the checkpoint answers."""
        asked = self._options
        if not asked.resize and asked.sampling is not None and asked.frames is not None:
            self._sampling = Sampling(asked.sampling, asked.frames)
            return
        self._info = info = await self._client.model_info(frames=True, timeout_s=_left_s(deadline))
        self._sampling = Sampling.of(
            asked.sampling, asked.frames, info.max_frames, trained_padding=info.trained_padding
        )

    def _given(self, frames: Any, index: int) -> Mapping[str, Any]:
        """The new frame of one episode, by camera."""
        if not self._options.cameras:
            if isinstance(frames, Mapping):
                expected = "frames of one camera (cameras=... names several)"
                raise InvalidSampleError.at("frames", expected, f"frames of {sorted(frames)}")
            return {ONLY_CAMERA: self._one_of(frames, index, "frames")}
        if not isinstance(frames, Mapping) or set(frames) != set(self._cameras):
            got = sorted(frames) if isinstance(frames, Mapping) else type(frames).__name__
            raise InvalidSampleError.at("frames", f"frames of the cameras {list(self._cameras)}", str(got))
        return {camera: self._one_of(frames[camera], index, f"frames[{camera!r}]") for camera in self._cameras}

    def _one_of(self, frames: Any, index: int, where: str) -> Any:
        if not hasattr(frames, "__len__") or len(frames) != len(self):
            got = f"{len(frames)}" if hasattr(frames, "__len__") else type(frames).__name__
            raise InvalidSampleError.at(where, f"a frame of each of {len(self)} episodes", got)
        return frames[index]

    async def _all_named(self, frames: Any, added: Sequence[int]) -> list[dict[str, NamedFrame]]:
        """The new frame of each camera of these episodes, in as many threads as there are processors."""

        def named(indices: Sequence[int]) -> list[dict[str, NamedFrame]]:
            return [self._named(self._given(frames, index), index) for index in indices]

        size = max(1, math.ceil(len(added) / (os.cpu_count() or 1)))
        parts = [added[first : first + size] for first in range(0, len(added), size)]
        making = [asyncio.create_task(asyncio.to_thread(named, part)) for part in parts]
        await asyncio.gather(*making, return_exceptions=True)  # then the first error is raised, not the quickest
        return [of_cameras for part in making for of_cameras in part.result()]

    def _named(self, frames: Mapping[str, Any], index: int) -> dict[str, NamedFrame]:
        """The new frames of one episode, checked, and resized if that is asked. Raises InvalidSampleError."""
        named = {}
        for camera, frame in frames.items():
            where = f"frame[{camera!r}]" if camera else "frame"
            try:
                pixels = self._sized(turned(checked_frame(frame, where), self._orientations[camera]))
                before = self._frames[index][camera]
                if before and before[0].pixels.shape != pixels.shape:
                    expected = f"uint8 {list(before[0].pixels.shape)}, as the episode's first"
                    if self._options.resize:  # by now another checkpoint may be served
                        expected += ", or a reset"
                    raise InvalidSampleError.at(where, expected, f"uint8 {list(pixels.shape)}")
            except InvalidSampleError as error:
                raise self._located(error, index) from None
            named[camera] = NamedFrame(pixels)
        return named

    def _sized(self, frame: UInt8Array) -> UInt8Array:
        size = None if self._info is None else self._info.frame_size
        return resize_frames(frame[np.newaxis], size)[0] if self._options.resize and size is not None else frame

    async def _results(
        self, indices: Sequence[int], deadline: Deadline | None
    ) -> list[list[tuple[Prefix, ProgressResult]]]:
        """Of each of these episodes, what each camera's frames so far were answered. Raises RewardError."""
        assert self._sampling is not None  # prepared
        windows, prefixes = [], []
        for index in indices:
            for kept in self._frames[index].values():
                prefixes.append(self._sampling.prefix(len(kept) - 1))
                windows.append(Window(tuple(kept[shown] for shown in prefixes[-1].indices), self._tasks[index]))
        outcomes = await self._client.score_windows(windows, timeout_s=_left_s(deadline))
        count = len(self._cameras)
        for number, outcome in enumerate(outcomes):
            if isinstance(outcome, RewardError):
                raise self._located(outcome, indices[number // count])
        answered = list(zip(prefixes, cast("list[ProgressResult]", outcomes), strict=True))
        return [answered[start : start + count] for start in range(0, len(answered), count)]

    def _scores(
        self, indices: Sequence[int], results: Sequence[Sequence[tuple[Prefix, ProgressResult]]], ms: float
    ) -> StepScores:
        fuse, rule = FUSES[self._options.fuse], self._options.success
        progress, success = (np.full(len(self), np.nan, np.float32) for _ in range(2))
        succeeded = np.zeros(len(self), bool)
        for index, of_cameras in zip(indices, results, strict=True):
            shown = [of_frames(result, prefix) for prefix, result in of_cameras]
            progress[index] = fuse([each.progress[-1] for each in shown])
            fused = fuse([each.success for each in shown], axis=0)
            success[index] = fused[-1]
            whole = replace(shown[0], success=np.asarray(fused, np.float32))
            is_predicted = not np.isnan(fused).any()
            succeeded[index] = is_predicted and whole.succeeded(last=rule.last, threshold=rule.threshold)
        step = np.array([len(next(iter(kept.values()))) - 1 for kept in self._frames], np.int64)
        return StepScores(progress, success, succeeded, step, ms)

    def _located(self, error: RewardError, index: int) -> RewardError:
        if len(self) == 1 or not isinstance(error, InvalidSampleError):
            return error
        return error.inside(f"episodes[{index}]")


class AsyncEpisode(OneProcess):
    """One episode that grows, for asyncio. Built by ``AsyncRewardClient.episode``."""

    def __init__(self, client: Windows, task: str, options: EpisodeOptions, timeout_s: float | None = None) -> None:
        self._episodes = AsyncEpisodes(client, [task], options, timeout_s)
        self._waiting: tuple[Any, asyncio.Future[StepScore]] | None = None
        self._asking: asyncio.Task[None] | None = None

    async def add(self, frame: Any) -> StepScore:
        """Adds a frame, uint8 [H, W, 3] or such by camera, and gives the score of the episode so far. It waits for a
        question that is open; a frame that waits for that, too, is dropped.

        Raises RewardError. Then the episode has not grown: the step may be tried again.
        """
        await self._settle()
        return await self._add(frame)

    def add_nowait(self, frame: Any) -> asyncio.Future[StepScore]:
        """Adds a frame, and gives the score to come. While a question is open the frame waits; if another comes
        meanwhile, the newer one takes its place, and the older's answer is cancelled: that frame is not part of the
        episode.
        """
        frame = copied(frame)
        answer: asyncio.Future[StepScore] = asyncio.get_running_loop().create_future()
        if self._asking is None or self._asking.done():
            self._asking = asyncio.create_task(self._ask(frame, answer))
        else:
            self._drop_waiting()
            self._waiting = frame, answer
        return answer

    async def reset(self, task: str | None = None) -> None:
        """Begins a new episode, when no question is open; a frame that waits is dropped. ``task``: None: as before."""
        await self._settle()
        await self._episodes.reset(task=task)

    async def close(self) -> None:
        """Returns when no question is open; a frame that waits is dropped. Who watches is told that it has ended."""
        await self._settle()
        await self._episodes.close()

    async def _settle(self) -> None:
        self._drop_waiting()
        if self._asking is not None and not self._asking.done():
            await asyncio.wait({self._asking})  # who stops to wait does not stop the question

    async def __aenter__(self) -> AsyncEpisode:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.close()

    async def _add(self, frame: Any) -> StepScore:
        frames = {camera: [each] for camera, each in frame.items()} if isinstance(frame, Mapping) else [frame]
        return (await self._episodes.add(frames)).of(0)

    def _drop_waiting(self) -> None:
        if self._waiting is not None:
            self._waiting[1].cancel()
            self._waiting = None

    async def _ask(self, frame: Any, answer: asyncio.Future[StepScore]) -> None:
        """Asks about a frame, and then about the newest until none waits."""
        waiting: tuple[Any, asyncio.Future[StepScore]] | None = (frame, answer)
        while waiting is not None:
            frame, answer = waiting
            try:
                score = await self._add(frame)
            except Exception as error:  # noqa: BLE001  whatever it is, who waits for the answer is told
                if not answer.done():
                    answer.set_exception(error)
            except BaseException:
                answer.cancel()
                self._drop_waiting()
                raise
            else:
                if not answer.done():
                    answer.set_result(score)
            waiting, self._waiting = self._waiting, None


def _left_s(deadline: Deadline | None) -> float | None:
    return None if deadline is None else deadline.remaining_s()


def _indices(mask: npt.ArrayLike | None, count: int) -> list[int]:
    """Which of the episodes a mask names. Raises ValueError for a mask that is none."""
    if mask is None:
        return list(range(count))
    array = np.asarray(as_array(mask))
    if array.dtype != np.bool_ or array.shape != (count,):
        raise ValueError(f"mask: expected bool [{count}], got {array.dtype} {list(array.shape)}")
    return [int(index) for index in np.flatnonzero(array)]
