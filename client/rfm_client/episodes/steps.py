# SPDX-License-Identifier: MIT
"""One episode's steps: frames, scored windows, and scores. H x W pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast, get_args

import numpy as np

from rfm_client.contract import wire
from rfm_client.contract.checks import require
from rfm_client.contract.description import FrameSize, ModelInfo
from rfm_client.contract.errors import InferenceFailedError, InvalidSampleError, RewardError
from rfm_client.contract.results import FRAME_SCORES, FrameScores, ProgressResult, Result
from rfm_client.contract.samples import ProgressSample, Trajectory, UInt8Array, as_array, check_task
from rfm_client.episodes.options import EpisodeOptions, StepScore, StepValue
from rfm_client.frames.fit_to_checkpoint import resize_frames
from rfm_client.frames.orientation import FUSES, Fuse
from rfm_client.frames.sampling import Prefix


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame, uint8 [H, W, 3], and the digest. The frame must not change."""

    pixels: UInt8Array

    @cached_property
    def digest(self) -> bytes:
        """Digest by which a server knows the frame. The first call takes about 2 ms per megabyte."""
        return wire.frame_digest(self.pixels)


@dataclass(frozen=True, eq=False)
class Window:
    """Frames of one size and a task, to be scored for progress. Raises InvalidSampleError for an invalid task.

    episode: identifies the episode; all windows in an episode go to one server
    """

    frames: tuple[Frame, ...]
    task: str
    episode: object

    def __post_init__(self) -> None:
        check_task(self.task)
        if not self.task.strip():
            raise InvalidSampleError.at("task", "a task sentence with frames", repr(self.task))

    @property
    def num_bytes(self) -> int:
        """Total bytes in all frames."""
        return sum(frame.pixels.nbytes for frame in self.frames)

    @property
    def sample(self) -> ProgressSample:
        """The window as a sample, with all pixels. Raises InvalidSampleError."""
        frames = np.stack([frame.pixels for frame in self.frames])
        return ProgressSample(Trajectory(frames=frames, task=self.task))


class Steps:
    """One episode's frames so far.

    where: name in errors, such as ``episodes[3]``; empty: no name
    """

    def __init__(self, task: str, options: EpisodeOptions, where: str = "") -> None:
        self.task, self.options = task, options
        self._where = where
        self._corrections = options.corrections
        self.frames: list[tuple[Frame, ...]] = []  # by step and camera
        self._num_changes: int | None = None  # changes of the checkpoint before the first score

    @property
    def newest(self) -> int:
        """The newest step's index, from 0; -1: none yet."""
        return len(self.frames) - 1

    def anew(self, task: str | None) -> Steps:
        """Return the next episode, without frames. task: None: as before."""
        return Steps(self.task if task is None else task, self.options, self._where)

    def checked(self, frame: Any, size: FrameSize | None = None) -> tuple[Frame, ...]:
        """Copy the next frame from each camera, upright. Raises InvalidSampleError.

        frame: uint8 [H, W, 3]; with cameras, a dict
        size: target size; None: no change
        """
        cameras = self.options.cameras
        kept = []
        try:
            check_cameras("frame", frame, cameras)
            given = {f"frame[{camera!r}]": frame[camera] for camera in cameras} or {"frame": frame}
            firsts = self.frames[0] if self.frames else (None,) * len(given)
            for (where, each), correction, first in zip(given.items(), self._corrections, firsts, strict=True):
                pixels = correction.applied(checked_frame(each, where))
                if size is not None:
                    pixels = resize_frames(pixels[np.newaxis], size)[0]
                if first is not None and first.pixels.shape != pixels.shape:
                    expected = f"uint8 {list(first.pixels.shape)}, as the episode's first"
                    expected += "" if size is None else ", or a reset"  # the checkpoint's size may have changed
                    raise InvalidSampleError.at(where, expected, f"uint8 {list(pixels.shape)}")
                kept.append(Frame(pixels))
        except InvalidSampleError as error:
            raise self._located(error) from None
        return tuple(kept)

    def windows(self, step: int, info: ModelInfo) -> tuple[Prefix, list[Window]]:
        """Return how a step is sampled, and each camera's window: its sampled frames, and the task.

        Raises InvalidSampleError without a frame or for a wrong task; ValueError as in ``EpisodeOptions.sampling_for``.
        """
        prefix = self.options.sampling_for(info).prefix(max(step, 0))
        try:
            require("frame", step >= 0, "one to score", "none yet", InvalidSampleError)
            shown = [self.frames[index] for index in prefix.indices]
            return prefix, [Window(frames, self.task, self) for frames in zip(*shown, strict=True)]
        except InvalidSampleError as error:
            raise self._located(error) from None

    def score(self, step: int, prefix: Prefix, outcomes: Sequence[Result | RewardError], ms: float) -> StepScore:
        """Return a step's score from the outcomes for its ``windows``.

        Raises a failed window's RewardError; ValueError if the checkpoint does not predict the score in
        ``options.score``.
        """
        for outcome in outcomes:
            if isinstance(outcome, RewardError):
                raise self._located(outcome)
        shown = [result.at(prefix.frame_slots) for result in cast("Sequence[ProgressResult]", outcomes)]
        fused, rule = _fused(shown, self.options.fuse), self.options.success
        self._check_predicted(fused)
        is_predicted = not np.isnan(fused.success).any()
        succeeded = is_predicted and fused.succeeded(last=rule.last, threshold=rule.threshold)
        more = {
            name: array[-1].item() for name, array in fused.arrays.items() if not FRAME_SCORES[name].is_always_asked
        }
        return StepScore(float(fused.progress[-1]), float(fused.success[-1]), succeeded, step, ms, more)

    def check_checkpoint(self, answered_by: Sequence[ModelInfo | None], changes: Sequence[str]) -> None:
        """Raise InferenceFailedError if a checkpoint is not the one in the options, or changed after the first score.

        answered_by: what the servers that answered say about their checkpoints; None: nothing
        changes: a line for each change that the client has seen
        """
        where, pinned = self._where or "episode", self.options.weights_digest
        for info in answered_by if pinned is not None else ():
            if info is None or info.weights_digest != pinned:
                got = f"{info.source or info.name} (weights {info.weights_digest})" if info else "an unknown one"
                raise InferenceFailedError(f"{where}: expected a checkpoint with weights {pinned}, got {got}")
        if self._num_changes is None:
            self._num_changes = len(changes)
        if self._num_changes != len(changes):
            expected = "the checkpoint that scored its first steps"
            raise InferenceFailedError(f"{where}: expected {expected}, got {changes[-1]}: reset the episode")

    def _check_predicted(self, scores: FrameScores) -> None:
        """Raise ValueError if the checkpoint does not predict the score that the options name."""
        name, arrays = self.options.score, scores.arrays
        predicted = [each for each in get_args(StepValue) if each in arrays and not np.isnan(arrays[each]).any()]
        remedy = f"; score={predicted[0]!r} takes what it predicts" if predicted else ""
        got = f"NaN: this checkpoint does not predict it{remedy}"
        require(name, name in predicted, "a score of each frame", got)

    def _located(self, error: RewardError) -> RewardError:
        """Return the error, with the episode's name if a sample is at fault."""
        return error.inside(self._where) if self._where and isinstance(error, InvalidSampleError) else error


def _fused(of_cameras: Sequence[FrameScores], fuse: Fuse) -> FrameScores:
    """Fuse all cameras' scores into one trajectory's. A mark is True where any camera has it.

    Where lower is better, ``min`` keeps the largest value and ``max`` the smallest.
    """
    fused: dict[str, Any] = {}
    for name, score in FRAME_SCORES.items():
        arrays = [each.arrays[name] for each in of_cameras if name in each.arrays]
        if arrays:
            sign = 1 if score.higher_is_better else -1
            fused[name] = np.any(arrays, axis=0) if score.mark else sign * FUSES[fuse](sign * np.array(arrays), axis=0)
    return FrameScores(**fused)


def check_cameras(where: str, frames: Any, cameras: Sequence[str]) -> None:
    """Raise InvalidSampleError unless ``frames`` is a dict by these cameras; without cameras, if it is a dict."""
    names = sorted(frames) if isinstance(frames, Mapping) else []
    expected = f"the cameras {list(cameras)}" if cameras else "one camera (cameras=... names several)"
    got = f"frames of {names}" if names else type(frames).__name__
    require(where, names == sorted(cameras), f"frames of {expected}", got, InvalidSampleError)


def checked_frame(frame: Any, where: str) -> UInt8Array:
    """Copy a frame, uint8 [H, W, 3], so that the caller may reuse the array. Raises InvalidSampleError."""
    kept = np.array(as_array(frame))
    is_frame = kept.dtype == np.uint8 and kept.ndim == 3 and kept.shape[2] == 3 and 0 not in kept.shape
    require(where, is_frame, "uint8 [H, W, 3]", f"{kept.dtype} {list(kept.shape)}", InvalidSampleError)
    return cast(UInt8Array, kept)
