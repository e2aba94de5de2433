# SPDX-License-Identifier: MIT
"""Score episodes that have no part yet, several at a time. T frames, H x W pixels.

For each camera, an episode is decoded once and its frames are scored. Then the camera scores are fused.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from traceback import clear_frames
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client import (
    AccessDeniedError,
    DeadlineExceededError,
    Float32Array,
    FrameScores,
    InferenceFailedError,
    InvalidSampleError,
    ModelNotFoundError,
    ProcessEndedError,
    ProgressResult,
    ProgressSample,
    RewardError,
    ServerUnavailableError,
    Trajectory,
    UInt8Array,
)
from rfm_client.frames import BlankFrames
from rfm_client.options import InvalidValueError
from rfm_labels.datasets.dataset import Dataset, DatasetEpisode
from rfm_labels.metadata import SCORES, Columns
from rfm_labels.options import Watch
from rfm_labels.plan import Item, Plan, Recipe
from rfm_labels.scorer import DECISIVE, CurveScorer, Scorer
from rfm_labels.writing import Parts

FRAMES_AT_A_TIME = 64  # per encoder request, as in the encoder's forward pass
MAX_FRAME_BYTES = 2 * 2**30  # for all workers in the process

_NOT_ABOUT_ONE_EPISODE = (ServerUnavailableError, DeadlineExceededError, ModelNotFoundError, AccessDeniedError)


@dataclass(frozen=True)
class FailedEpisode:
    """An episode that got no labels, and why."""

    episode: DatasetEpisode
    error: RewardError


class _StoppedError(RewardError):
    """The run is stopping; the next run labels the episode."""


class Run:
    """Labels a plan with threads in this process."""

    def __init__(self, plan: Plan, dataset: Dataset, scorer: Scorer, parts: Parts, watch: Watch) -> None:
        self._plan, self._dataset, self._scorer, self._parts, self._watch = plan, dataset, scorer, parts, watch
        self._memory = FrameMemory()
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._failures: list[FailedEpisode] = []
        self._cause: Exception | None = None

    def finish_all(self, workers: int) -> list[FailedEpisode]:
        """Label all items without a part, ``workers`` at a time, and return the failures.

        Raises RewardError if the server is gone, OSError if the disk is full, after the current episodes have ended.
        """
        pending = unfinished(self._plan, self._parts, self._watch)
        with ThreadPoolExecutor(workers, thread_name_prefix="rfm-label") as pool:
            try:
                list(pool.map(self._label, pending))
            except BaseException:
                self._stopping.set()
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        if self._cause is not None:
            raise self._cause
        return sorted(self._failures, key=lambda failure: failure.episode.index)

    def _label(self, item: Item) -> None:
        try:
            self._go_on()
            if not self._parts.has(item):  # another process may have finished it
                self._score(item)
            self._watch.scored(item.episode)
        except _StoppedError:
            return
        except RewardError as error:
            is_of_one = isinstance(error, ProcessEndedError)  # the client's retry failed as well
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
            columns, blank = episode_scores(
                self._dataset, item.episode, self._scorer, recipe, memory=memory, go_on=self._go_on
            )
        except InferenceFailedError:  # perhaps another checkpoint is served now
            self._check_checkpoint()
            raise
        self._check_checkpoint()
        self._parts.write(item, columns, blank)

    def _check_checkpoint(self) -> None:
        """Stop the run and raise _StoppedError if the server now has another checkpoint."""
        try:
            planned, now = self._plan.recipe.checkpoint, self._scorer.checkpoint()
            for name in DECISIVE:
                if getattr(now, name) != getattr(planned, name):
                    remedy = "the server changed its checkpoint; the same command scores all episodes by the new one"
                    raise InvalidSampleError.at(name, getattr(planned, name), getattr(now, name), remedy)
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
    """Return the items without a part, and report frame counts to ``watch``."""
    finished = parts.finished(plan.items)
    watch.begin(plan.num_frames, sum(item.episode.num_frames for item in plan.items if item.key in finished))
    return [item for item in plan.items if item.key not in finished]


class FrameMemory:
    """Limits how many bytes of frames all workers hold together; a larger video is held alone."""

    def __init__(self, max_bytes: int = MAX_FRAME_BYTES) -> None:
        self._max_bytes = max_bytes
        self._held_bytes = 0
        self._changed = threading.Condition()

    @contextmanager
    def holding(self, num_bytes: int) -> Iterator[None]:
        """Wait until ``num_bytes`` fit, and hold them during the block. Nested calls can deadlock."""
        with self._changed:
            self._changed.wait_for(lambda: not self._held_bytes or self._held_bytes + num_bytes <= self._max_bytes)
            self._held_bytes += num_bytes
        try:
            yield
        except Exception as error:
            clear_frames(error.__traceback__)  # otherwise the traceback keeps the frames in memory
            raise
        finally:
            with self._changed:
                self._held_bytes -= num_bytes
                self._changed.notify_all()


def episode_scores(
    dataset: Dataset,
    episode: DatasetEpisode,
    scorer: Scorer,
    recipe: Recipe,
    *,
    memory: FrameMemory,
    go_on: Callable[[], None],
) -> tuple[Columns, dict[str, int]]:
    """Return an episode's label columns, float32 [T] each, and each blank camera's brightest value. Raises RewardError.

    Columns: ``progress``, and every other score in ``SCORES`` that the checkpoint gives; a mark is 1 if it is 1 for any
    camera. Several cameras add ``progress.<camera>`` and so on.

    memory: shared by all workers, for one camera's frames at a time; unused if the checkpoint encodes frames
    go_on: called between requests; may raise to end the episode

    Each stretch of frames with one task is scored separately, as an episode with this task.
    """
    by_camera: dict[str, list[ProgressResult]] = {}
    shown = {camera: BlankFrames() for camera in recipe.decoded_cameras}
    for camera in recipe.cameras:
        together = [_noted(dataset.frames(episode, each), shown[each]) for each in (camera, *recipe.views)]
        for number, (task, count) in enumerate(episode.stretches, 1):
            is_last = number == len(episode.stretches)  # reads on, to detect surplus frames
            stretch = together if is_last else [itertools.islice(frames, count) for frames in together]
            sized = [_resized(frames, recipe, go_on) for frames in stretch]
            if recipe.checkpoint.encodes:
                result = _scores(_encoded(sized[0], task, scorer), scorer, recipe, go_on)
            else:
                firsts = [next(each) for each in sized]
                with memory.holding(sum(first.nbytes for first in firsts) * count):
                    result = _scores(_held(firsts, sized, task, count, recipe), scorer, recipe, go_on)
            by_camera.setdefault(camera, []).append(result)
    highest = {camera: frames.highest for camera, frames in shown.items()}
    blank = {camera: value for camera, value in highest.items() if value is not None}
    return _columns(by_camera, episode, recipe), blank


def _columns(by_camera: Mapping[str, Sequence[ProgressResult]], episode: DatasetEpisode, recipe: Recipe) -> Columns:
    columns: Columns = {}
    joined = [FrameScores.joined(results) for results in by_camera.values()]
    cameras = [each.arrays for each in joined]
    for name, about in SCORES.items():
        scores = [np.asarray(of_camera.get(name, ()), np.float32) for of_camera in cameras]
        is_unknown = about.may_be_unknown and all(np.isnan(score).all() for score in scores)
        if is_unknown or not any(name in of_camera for of_camera in cameras):
            continue
        _check_numbers(name, scores, [each.is_answered for each in joined], episode)
        fuse: Any = np.max if about.mark else getattr(np, recipe.fuse)  # mean, min or max
        sign = np.float32(1 if about.higher_is_better else -1)  # so that min selects the worst camera
        columns[name] = sign * np.asarray(fuse(sign * np.stack(scores), axis=0), np.float32)
        if len(by_camera) > 1:
            columns |= {f"{name}.{camera}": score for camera, score in zip(by_camera, scores, strict=True)}
    return columns


def _scores(trajectory: Trajectory, scorer: Scorer, recipe: Recipe, go_on: Callable[[], None]) -> ProgressResult:
    if recipe.in_one_pass(trajectory.num_frames):
        (result,) = scorer.evaluate([ProgressSample(trajectory)])
    elif isinstance(scorer, CurveScorer):
        result = scorer.curve(trajectory, recipe.sampling, go_on)
    else:
        results: list[ProgressResult] = []
        for together in recipe.sampling.parts(trajectory):
            go_on()
            results += scorer.evaluate(together)
        result = recipe.sampling.joined(results)
    if recipe.progress_rule is None:
        return result
    try:
        return replace(result, progress=result.progress_by(recipe.progress_rule))
    except InvalidValueError as error:
        raise InvalidSampleError(error.problem, error.where) from error


def _resized(frames: Iterator[UInt8Array], recipe: Recipe, go_on: Callable[[], None]) -> Iterator[UInt8Array]:
    """Yield the frames, uint8 [H, W, 3], resized if the recipe says so."""
    for frame in frames:
        go_on()
        yield recipe.resized(frame[np.newaxis])[0]


def _encoded(frames: Iterator[UInt8Array], task: str, scorer: Scorer) -> Trajectory:
    """Return the frames' embeddings, from requests with at most FRAMES_AT_A_TIME frames."""
    parts: list[Trajectory] = []
    while chunk := list(itertools.islice(frames, FRAMES_AT_A_TIME)):
        parts.append(scorer.encode(np.stack(chunk), task))
    embeddings = np.concatenate([part.positions for part in parts])
    return Trajectory(video_embeddings=embeddings, text_embedding=parts[0].text_embedding)


def _held(
    firsts: Sequence[UInt8Array], others: Sequence[Iterator[UInt8Array]], task: str, count: int, recipe: Recipe
) -> Trajectory:
    """Return a trajectory for camera and views, given each one's first frame and an iterator over the rest."""
    frames, *views = (_filled(first, rest, count) for first, rest in zip(firsts, others, strict=True))
    goal = None if recipe.goal is None else recipe.resized(recipe.goal.picture(frames)[np.newaxis])[0]
    return Trajectory(frames=frames, task=task, views=tuple(views), goal=goal)


def _filled(first: UInt8Array, others: Iterator[UInt8Array], count: int) -> UInt8Array:
    frames = np.empty((count, *first.shape), np.uint8)
    for index, frame in enumerate(itertools.chain([first], others)):
        frames[index] = frame
    return frames


def _noted(frames: Iterator[UInt8Array], shown: BlankFrames) -> Iterator[UInt8Array]:
    """Yield the frames, and record them in ``shown``."""
    for frame in frames:
        shown.add(frame)
        yield frame


def _check_numbers(
    name: str, scores: Sequence[Float32Array], answered: Sequence[npt.NDArray[np.bool_]], episode: DatasetEpisode
) -> None:
    """Raise InferenceFailedError unless every camera has finite scores wherever the model answered."""
    for score, there in zip(scores, answered, strict=True):
        if score.shape != (episode.num_frames,) or not np.isfinite(score[there]).all():
            got = "NaN: this checkpoint does not predict it" if np.isnan(score).any() else str(list(score.shape))
            raise InferenceFailedError(f"{name}: expected a score of each of {episode.num_frames} frames, got {got}")
