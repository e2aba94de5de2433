# SPDX-License-Identifier: MIT
"""Steps of an episode: options, frames so far, requests about them, and scores.

Nothing here sends requests to the server: ``episodes.py`` and the Gymnasium wrappers do. N episodes, H x W pixels.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Protocol, TypedDict, cast

import numpy as np
import numpy.typing as npt

from rfm_client.contract.checks import require
from rfm_client.contract.errors import InvalidSampleError, RewardError
from rfm_client.contract.frame_size import FrameSize
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.numbers import checked_count, checked_share
from rfm_client.contract.results import SUCCESS_THRESHOLD, FrameScores, ProgressResult, Result
from rfm_client.contract.samples import Float32Array, UInt8Array, as_array
from rfm_client.episodes.windows import EpisodeFrame, Window
from rfm_client.frames.blank_frames import FRAMES_IN_A_ROW, BlankFrames, is_black, is_blank
from rfm_client.frames.camera_fusion import FUSES, Fuse
from rfm_client.frames.orientation import ChannelOrder, Channels, Correction, Corrections, Orient, Orientation
from rfm_client.frames.resize import resize_frames
from rfm_client.frames.sampling import Prefix, Rule, Sampling

_BLACK = (
    "black ones in a row: simulators in one process can blacken each other's pictures; give each a process of its own"
)
_STILL = "equal ones in a row: look at a frame, since the camera may be stuck, or render() may not draw anew"

logger = logging.getLogger("rfm_client")


@dataclass(frozen=True)
class SuccessRule:
    """A step succeeds if most of the last distinct frames of its own sample reach ``threshold``.

    threshold: least success of such a frame, 0..1
    last: number of frames that vote; each distinct frame votes once, however often it is repeated or padded

    Raises ValueError.
    """

    threshold: float = SUCCESS_THRESHOLD
    last: int = 1

    def __post_init__(self) -> None:
        checked_share("threshold", self.threshold)
        checked_count("last", self.last)


class EpisodeReport(Protocol):
    """One episode in a view."""

    def add(self, frame: UInt8Array, score: StepScore) -> None:
        """Take a step. Return at once, and raise nothing. frame: uint8 [H, W, 3], which will not change any more."""

    def end(self) -> None:
        """Take the end of the episode. Return at once, and raise nothing."""


class EpisodeView(Protocol):
    """A view to which episodes report each step, such as ``rfm_rl.LiveView``."""

    def episode(self, task: str, env: int = 0, threshold: float = 0.5) -> EpisodeReport:
        """Return a new episode. env: its number among those that grow together, from 0; threshold: of success"""


class EpisodeSettings(TypedDict, total=False):
    """Fields of EpisodeOptions, as keyword arguments."""

    sampling: Rule | None
    frames: int | None
    cameras: Sequence[str]
    fuse: Fuse
    orient: Orientation | Mapping[str, Orientation]
    channels: ChannelOrder | Mapping[str, ChannelOrder]
    resize: bool
    success: SuccessRule
    live: EpisodeView | None


@dataclass(frozen=True, kw_only=True)
class EpisodeOptions:
    """How each step of an episode is scored. Raises ValueError for contradictory options.

    sampling: a rule of ``rfm_client.frames.sampling``; None: the rule of the checkpoint's training
    frames: the rule's number of frames; None: the rule's own if fixed, else ``ModelInfo.max_frames``. If the rule needs
        a number and the checkpoint has none, the first step raises ValueError
    cameras: names of the cameras with a frame in each step; empty: a single camera without a name
    fuse: how to combine the scores of several cameras
    orient: rotation or flip that makes frames upright, applied first: an Orientation, or a dict by camera; cameras that
        it omits are not turned
    channels: order of the colours in the given frames, ``rgb`` or ``bgr``: one for all cameras, or a dict by camera
    resize: True: shrink frames to the checkpoint's size before they are kept and sent (needs Pillow); ReWiND's scores
        then differ slightly
    success: rule of a step's success
    live: view to which each step is reported, with the first camera's frame; it delays no step
    """

    sampling: Rule | None = None
    frames: int | None = None
    cameras: Sequence[str] = ()
    fuse: Fuse = "mean"
    orient: Orientation | Mapping[str, Orientation] = "none"
    channels: ChannelOrder | Mapping[str, ChannelOrder] = "rgb"
    resize: bool = False
    success: SuccessRule = SuccessRule()
    live: EpisodeView | None = None

    def __post_init__(self) -> None:
        require("cameras", not isinstance(self.cameras, str), "a sequence of names", repr(self.cameras))
        object.__setattr__(self, "cameras", tuple(self.cameras))
        is_each_once = len(set(self.cameras)) == len(self.cameras)
        require("cameras", is_each_once, "names that differ", list(self.cameras))
        require("fuse", self.fuse in FUSES, f"one of {', '.join(FUSES)}", repr(self.fuse))
        Sampling.of(self.sampling, self.frames, trained_frames=1)  # raises ValueError; 1 stands in for the checkpoint's
        cameras = list(self.cameras)
        expected = f"some of the cameras {cameras}" if cameras else "one for all frames, as cameras names none"
        for given in (self._given.orient, self._given.channels):
            unknown = [repr(camera) for camera in given.cameras if camera not in self.cameras]
            require(given.NAME, not unknown, expected, ", ".join(unknown))

    @property
    def corrections(self) -> list[Correction]:
        """Correction of each camera's frames, in the order of the cameras."""
        return [self._given.of(camera) for camera in self.cameras or ("",)]

    def sampling_for(self, info: ModelInfo) -> Sampling:
        """Return the rule with its number of frames for a checkpoint.

        Raises ValueError without a needed number, InvalidSampleError if the checkpoint needs the whole episode.
        """
        info.check_scores_prefixes()
        return Sampling.of(self.sampling, self.frames, info.max_frames, trained_padding=info.trained_padding)

    @property
    def _given(self) -> Corrections:
        return Corrections(Orient.of(self.orient), Channels.of(self.channels))


@dataclass(frozen=True)
class StepScore:
    """The score of one episode at its newest frame.

    progress: how much of the task is done, 0..1
    success: probability that the task is done; NaN: the checkpoint does not predict it
    succeeded: True if the success rule holds; False where success is NaN
    step: index of the scored frame in the episode, from 0
    ms: milliseconds to the answer, without the wait for an open ``add_nowait`` request
    unclear: True if a camera's written answer states no single whole score (RoboReward only)
    """

    progress: float
    success: float
    succeeded: bool
    step: int
    ms: float
    unclear: bool = False


@dataclass(frozen=True, eq=False)
class StepScores:
    """The scores of N episodes, each at its newest frame.

    progress, success: float32 [N], as in StepScore; NaN where ``mask`` left an episode out
    succeeded: bool [N]; False where ``mask`` left an episode out, or success is NaN
    step: int64 [N], number of each newest frame, from 0; -1: none yet
    ms: time to the answer, milliseconds
    unclear: bool [N], as in StepScore
    """

    progress: Float32Array
    success: Float32Array
    succeeded: npt.NDArray[np.bool_]
    step: npt.NDArray[np.int64]
    ms: float
    unclear: npt.NDArray[np.bool_]

    def of(self, index: int) -> StepScore:
        """Return the score of one episode."""
        numbers = float(self.progress[index]), float(self.success[index])
        succeeded, unclear = bool(self.succeeded[index]), bool(self.unclear[index])
        return StepScore(*numbers, succeeded, int(self.step[index]), self.ms, unclear)


class EpisodeFrames:
    """The frames of one episode so far, their requests, and the live view.

    index: number of this episode among those that grow together, from 0
    where: its name in errors, such as ``episodes[3]``; empty: no name
    """

    def __init__(self, task: str, options: EpisodeOptions, index: int = 0, where: str = "") -> None:
        self.task = task
        self._options, self._index, self._where = options, index, where
        self._corrections = options.corrections
        self._frames: list[tuple[EpisodeFrame, ...]] = []  # by step and camera
        self._live: EpisodeReport | None = None
        self._has_warned = False

    @property
    def step(self) -> int:
        """Number of the newest frame, from 0; -1: none yet."""
        return len(self._frames) - 1

    def checked(self, frame: Any, size: FrameSize | None = None) -> tuple[EpisodeFrame, ...]:
        """Return a copy of the next frame of each camera, upright. Raises InvalidSampleError.

        frame: uint8 [H, W, 3]; with cameras, a dict of these
        size: size to which frames shrink; None: no change
        """
        cameras = self._options.cameras
        given = {f"frame[{camera!r}]": frame[camera] for camera in cameras} if cameras else {"frame": frame}
        firsts = self._frames[0] if self._frames else (None,) * len(given)
        kept = []
        try:
            for (where, each), correction, first in zip(given.items(), self._corrections, firsts, strict=True):
                pixels = correction.applied(checked_frame(each, where))
                if size is not None:
                    pixels = resize_frames(pixels[np.newaxis], size)[0]
                if first is not None and first.pixels.shape != pixels.shape:
                    expected = f"uint8 {list(first.pixels.shape)}, as the episode's first"
                    expected += "" if size is None else ", or a reset"  # the checkpoint's size may have changed
                    raise InvalidSampleError.at(where, expected, f"uint8 {list(pixels.shape)}")
                kept.append(EpisodeFrame(pixels))
        except InvalidSampleError as error:
            raise self.located(error) from None
        return tuple(kept)

    def append(self, frame: tuple[EpisodeFrame, ...]) -> None:
        """Add the frames that ``checked`` returned.

        Warn, once an episode, if a camera shows the same picture, or nothing.
        """
        self._frames.append(frame)
        if len(self._frames) >= FRAMES_IN_A_ROW:
            self._warn_of(self._frames[-FRAMES_IN_A_ROW:])

    def _warn_of(self, last: Sequence[tuple[EpisodeFrame, ...]]) -> None:
        for number, camera in enumerate(self._options.cameras or ("",)):
            fault = "" if self._has_warned else _fault_of([each[number].pixels for each in last])
            if fault:
                self._has_warned = True
                where = ": ".join(filter(None, [self._where, f"frame[{camera!r}]" if camera else "frame"]))
                logger.warning("%s: expected %s", where, fault)

    def pop(self) -> None:
        """Remove the newest frame again."""
        self._frames.pop()

    def windows(self, prefix: Prefix) -> list[Window]:
        """Return each camera's window: its sampled frames, and the task. Raises InvalidSampleError for a wrong task."""
        shown = [self._frames[index] for index in prefix.indices]
        return [Window(of_camera, self.task, self) for of_camera in zip(*shown, strict=True)]

    def score(self, step: int, prefix: Prefix, outcomes: Sequence[Result | RewardError], ms: float) -> StepScore:
        """Return the score of a step from the outcomes of its ``windows``.

        Raises the RewardError of a failed window; ValueError if the checkpoint does not predict progress.
        """
        for outcome in outcomes:
            if isinstance(outcome, RewardError):
                raise self.located(outcome)
        shown = [result.at(prefix.frame_slots) for result in cast("Sequence[ProgressResult]", outcomes)]
        fuse, rule = FUSES[self._options.fuse], self._options.success
        fused = FrameScores(
            progress=fuse([each.progress for each in shown], axis=0),
            success=fuse([each.success for each in shown], axis=0),
        )
        is_predicted = not np.isnan(fused.success).any()
        succeeded = is_predicted and fused.succeeded(last=rule.last, threshold=rule.threshold)
        unclear = any(each.unclear is not None and bool(each.unclear[-1]) for each in shown)
        return StepScore(fused.last_progress, float(fused.success[-1]), succeeded, step, ms, unclear)

    def report(self, score: StepScore) -> None:
        """Report the score of a step to the live view."""
        view = self._options.live
        if view is not None:
            self._live = self._live or view.episode(self.task, self._index, self._options.success.threshold)
            self._live.add(self._frames[score.step][0].pixels, score)

    def end(self) -> None:
        """Tell the live view that no step will follow. Warn if no frame of a short episode shows anything."""
        if 0 < len(self._frames) < FRAMES_IN_A_ROW:
            self._warn_of(self._frames)
        if self._live is not None:
            self._live.end()
            self._live = None

    def located(self, error: RewardError) -> RewardError:
        """Return the error, with the episode's name if a sample is at fault."""
        return error.inside(self._where) if self._where and isinstance(error, InvalidSampleError) else error


class StepRequest:
    """The windows of some episodes, each at its episode's newest frame.

    asked_s: start of the caller's wait, by ``time.perf_counter``

    Raises InvalidSampleError for an invalid task.
    """

    def __init__(self, episodes: Sequence[EpisodeFrames], sampling: Sampling, asked_s: float) -> None:
        self._asked_s = asked_s
        prefixes = [sampling.prefix(episode.step) for episode in episodes]
        self._asked = [
            (each, each.step, prefix, each.windows(prefix)) for each, prefix in zip(episodes, prefixes, strict=True)
        ]
        self.windows = [window for *_, windows in self._asked for window in windows]

    def scores(self, outcomes: Sequence[Result | RewardError]) -> list[StepScore]:
        """Return the score of each episode from the outcomes of ``windows``. Raises RewardError."""
        left, ms = iter(outcomes), (time.perf_counter() - self._asked_s) * 1e3
        return [
            episode.score(step, prefix, list(islice(left, len(windows))), ms)
            for episode, step, prefix, windows in self._asked
        ]


def _fault_of(pixels: Sequence[UInt8Array]) -> str:
    """What was expected of a camera's last pictures, or of all in a short episode, and what came; empty: no fault."""
    *before, newest = pixels
    is_still = len(pixels) == FRAMES_IN_A_ROW and all(np.array_equal(newest, each) for each in reversed(before))
    if is_still and not (newest.any() and is_black(newest)):
        return f"pictures that change, got {len(pixels)} {_STILL if newest.any() else _BLACK}"
    told = BlankFrames(pixels).told if is_blank(newest) else ""
    return told and f"pictures that show something, got {told}, {len(pixels)} in a row"


def checked_frame(frame: Any, where: str) -> UInt8Array:
    """Return a copy of a frame, uint8 [H, W, 3]; the caller may reuse its array. Raises InvalidSampleError."""
    kept = copied(frame)
    is_frame = kept.dtype == np.uint8 and kept.ndim == 3 and kept.shape[2] == 3 and 0 not in kept.shape
    require(where, is_frame, "uint8 [H, W, 3]", f"{kept.dtype} {list(kept.shape)}", InvalidSampleError)
    return cast(UInt8Array, kept)


def copied(frame: Any) -> Any:
    """Return a copy of a frame, or of a dict of frames by camera."""
    if isinstance(frame, Mapping):
        return {camera: np.array(as_array(each)) for camera, each in frame.items()}
    return np.array(as_array(frame))
