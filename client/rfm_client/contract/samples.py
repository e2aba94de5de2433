# SPDX-License-Identifier: MIT
"""Samples: questions to a reward model; blank and random trajectories, for probes and examples.

Letters: T frames, H x W pixels, D frame embedding width, Dt text embedding width.
Samples check their arrays once, here; all other code relies on it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from rfm_client.contract.checks import require
from rfm_client.contract.errors import InvalidSampleError, InvalidValueError, LocatedError

Float32Array: TypeAlias = npt.NDArray[np.float32]
UInt8Array: TypeAlias = npt.NDArray[np.uint8]
NamedFrame: TypeAlias = tuple[bytes, npt.NDArray[Any]]  # a frame's digest, and what a server keeps of the frame

MIN_FRAME_STEPS = 2  # a prefix sampled to a single frame is no trajectory
MOST_VIEWS = 2  # besides the frames
MAX_FRAME_STEPS = 4096  # more frames than any checkpoint takes
_PLAIN_NUMBERS = ("I", "F")  # Pillow's modes for depth pictures, which cannot be converted to colour pictures


@dataclass(frozen=True, eq=False, kw_only=True)
class Trajectory:
    """One episode's frames, or their embeddings, and its task.

    frames: uint8 [T, H, W, 3], RGB
    video_embeddings: float32 [T, D], instead of ``frames``
    text_embedding: float32 [Dt], task embedding for ``video_embeddings``
    task: a sentence, for ``frames``
    views: with ``frames``: further cameras' frames at the same times, uint8 [T, H, W, 3] each; Robo-Dopamine reads the
        left and the right wrist camera, in this order
    goal: with ``frames``: a picture that shows the finished task, uint8 [H, W, 3], RGB; Robo-Dopamine reads it
    named: instead of ``frames``, on a server: each frame's digest with its pixels, uint8 [H, W, 3], or with its
        embedding, float32 [D], which the encoders kept

    Raises InvalidSampleError.
    """

    frames: UInt8Array | None = None
    video_embeddings: Float32Array | None = None
    text_embedding: Float32Array | None = None
    task: str = ""
    views: tuple[UInt8Array, ...] = ()
    goal: UInt8Array | None = None
    named: tuple[NamedFrame, ...] | None = None

    def __post_init__(self) -> None:
        given = [each for each in (self.frames, self.video_embeddings, self.named) if each is not None]
        if len(given) != 1:
            got = "both" if given else "neither"
            raise InvalidSampleError.at("trajectory", "either frames or video_embeddings", got)
        check_task(self.task)
        if self.frames is not None and self.text_embedding is not None:
            raise InvalidSampleError.at("text_embedding", "None with frames, which go with task", "an embedding")
        if self.frames is not None:
            object.__setattr__(self, "frames", _checked_frames(self.frames))
        if self.has_views:
            self._check_views()
        if self.video_embeddings is not None:
            embeddings = _checked_floats("video_embeddings", self.video_embeddings, ("T", "D"))
            object.__setattr__(self, "video_embeddings", embeddings)
        if self.text_embedding is not None:
            text = _checked_floats("text_embedding", self.text_embedding, ("Dt",))
            object.__setattr__(self, "text_embedding", text)

    def __repr__(self) -> str:
        """Describe the trajectory with shapes instead of values."""
        arrays = {"frames": self.frames, "video_embeddings": self.video_embeddings, "text": self.text_embedding}
        shapes = [f"{name}={array.dtype} {list(array.shape)}" for name, array in arrays.items() if array is not None]
        shapes += [f"view={array.dtype} {list(array.shape)}" for array in self.views]
        shapes += [] if self.goal is None else [f"goal={self.goal.dtype} {list(self.goal.shape)}"]
        shapes += [] if self.named is None else [f"named={self.num_frames} frames"]
        return f"Trajectory({', '.join([*shapes, f'task={self.task!r}'])})"

    @property
    def has_views(self) -> bool:
        """True if there are views or a goal, which only some models read."""
        return bool(self.views) or self.goal is not None

    @property
    def positions(self) -> npt.NDArray[Any]:
        """``frames``, uint8 [T, H, W, 3], or ``video_embeddings``, float32 [T, D]: time is the first axis."""
        array = self.video_embeddings if self.frames is None else self.frames
        assert array is not None  # named frames are not one array
        return array

    @property
    def num_frames(self) -> int:
        """T, the frame count."""
        return len(self.positions if self.named is None else self.named)

    def _check_views(self) -> None:
        """Check views and goal. Raises InvalidSampleError."""
        if self.frames is None and self.named is None:
            raise InvalidSampleError.at("views", "none without frames", "views or a goal of embeddings")
        require("views", len(self.views) <= MOST_VIEWS, f"at most {MOST_VIEWS}", len(self.views), InvalidSampleError)
        views = []
        for index, view in enumerate(self.views):
            try:
                views.append(_checked_frames(view))
            except InvalidSampleError as error:
                raise error.inside(f"views[{index}]") from None
            expected, got = f"{self.num_frames} frames, as frames", len(views[-1])
            require(f"views[{index}]", got == self.num_frames, expected, got, InvalidSampleError)
        object.__setattr__(self, "views", tuple(views))
        if self.goal is not None:
            object.__setattr__(self, "goal", _checked_goal(self.goal))


class _Pair:
    def __post_init__(self) -> None:
        (where, first), (other_where, other) = vars(self).items()
        _check_text(first, where)
        _check_pair(first, other, other_where)

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """Both trajectories, in their order on the time axis."""
        return tuple(vars(self).values())


@dataclass(frozen=True, eq=False)
class ProgressSample:
    """Question: how far is ``trajectory`` at each frame, and has it succeeded?

    frame_steps: 0 scores the trajectory as a whole. N >= 2 is dense mode: frame t is scored from its prefix 0..t alone,
        sampled to N frames, as an RL loop sees it at that step
    """

    trajectory: Trajectory
    frame_steps: int = 0

    def __post_init__(self) -> None:
        _check_text(self.trajectory, "trajectory")
        steps: Any = self.frame_steps
        is_whole = isinstance(steps, (int, np.integer)) and not isinstance(steps, bool)
        is_valid = is_whole and (steps == 0 or MIN_FRAME_STEPS <= steps <= MAX_FRAME_STEPS)
        expected = f"0 or a whole number from {MIN_FRAME_STEPS} to {MAX_FRAME_STEPS}"
        require("frame_steps", is_valid, expected, repr(steps), InvalidSampleError)

    @property
    def trajectories(self) -> tuple[Trajectory, ...]:
        """The trajectory alone, as a pair has two."""
        return (self.trajectory,)


@dataclass(frozen=True, eq=False)
class PreferenceSample(_Pair):
    """Question: which trajectory does ``first``'s task better?"""

    first: Trajectory
    second: Trajectory

    @property
    def swapped(self) -> PreferenceSample:
        """The question with ``second`` in first place, still about ``first``'s task."""
        asked = self.first
        return PreferenceSample(replace(self.second, task=asked.task, text_embedding=asked.text_embedding), asked)


@dataclass(frozen=True, eq=False)
class SimilaritySample(_Pair):
    """Question: how similar is ``other`` to ``reference`` in doing ``reference``'s task?"""

    reference: Trajectory
    other: Trajectory


Sample: TypeAlias = ProgressSample | PreferenceSample | SimilaritySample


@dataclass(frozen=True, eq=False)
class EncoderSample:
    """One sample's trajectories, for an encoder.

    The encoder reads frames and the first trajectory's task. It returns trajectories with embeddings of both.
    """

    trajectories: tuple[Trajectory, ...]


def check_task(task: Any) -> None:
    """Raise InvalidSampleError unless ``task`` is text that UTF-8 can encode."""
    if not isinstance(task, str):
        raise InvalidSampleError.at("task", "str", type(task).__name__)
    if any(0xD800 <= ord(character) <= 0xDFFF for character in task):
        raise InvalidSampleError.at("task", "text that UTF-8 can encode", "a lone surrogate")


def stackable(trajectories: Sequence[Trajectory]) -> list[list[Trajectory]]:
    """Return groups of neighbouring trajectories whose positions fit one array: equal shape behind the time axis."""
    if len(trajectories) == 1:
        return [list(trajectories)]
    return [list(group) for _, group in groupby(trajectories, lambda trajectory: trajectory.positions.shape[1:])]


def with_trajectories(sample: Sample, trajectories: Sequence[Trajectory]) -> Sample:
    """Return a sample that asks the same question about other trajectories."""
    if isinstance(sample, ProgressSample):
        return replace(sample, trajectory=trajectories[0])
    first, second = trajectories
    return type(sample)(first, second)


def with_pictures(trajectory: Trajectory, change: Callable[[UInt8Array], UInt8Array]) -> Trajectory:
    """Return the trajectory with changed frames, views and goal; embeddings stay unchanged.

    change: takes and returns uint8 [T, H, W, 3]; T = 1 for the goal
    """
    if trajectory.frames is None:
        return trajectory
    goal = None if trajectory.goal is None else change(trajectory.goal[np.newaxis])[0]
    return replace(trajectory, frames=change(trajectory.frames), views=tuple(map(change, trajectory.views)), goal=goal)


def float_frames_to_uint8(frames: npt.ArrayLike) -> UInt8Array:
    """Return uint8 frames from float frames in 0..255, same shape: clip and truncate, as upstream's server does.

    Raises InvalidSampleError for frames in 0..1, which truncation would turn black, and for NaN, Inf or no values.
    """
    array = as_array(frames)
    if array.size == 0 or not np.isfinite(array).all():
        raise InvalidSampleError.at("frames", "finite values in 0..255", "NaN, Inf or nothing")
    largest = float(array.max())
    if 0.0 < largest <= 1.0:
        raise InvalidSampleError.at("frames", "values in 0..255", f"values up to {largest:g}: multiply by 255 first")
    return np.clip(array, 0, 255).astype(np.uint8)


def as_array(values: Any) -> npt.NDArray[Any]:
    """Return the values as an array; torch tensors too, on a GPU or with a gradient, bfloat16 as float32.

    Raises ValueError for rows of unequal length, InvalidSampleError for a Pillow picture whose numbers are not RGB.
    """
    if isinstance(values, (list, tuple)) and values and (hasattr(values[0], "detach") or hasattr(values[0], "getexif")):
        values = [as_array(each) for each in values]
    if hasattr(values, "getexif") and values.mode != "RGB" and not values.mode.startswith(_PLAIN_NUMBERS):
        raise InvalidSampleError.at("picture", "mode RGB", f'mode {values.mode}: call picture.convert("RGB")')
    if hasattr(values, "detach"):  # a tensor; torch may not be installed
        tensor = values.detach().cpu()
        values = (tensor.float() if str(tensor.dtype) == "torch.bfloat16" else tensor).numpy()
    return np.asarray(values)


def checked_mask(
    where: str, mask: npt.ArrayLike, count: int, error: type[LocatedError] = InvalidValueError
) -> npt.NDArray[np.bool_]:
    """Return a mask, bool [count], given as an array, list or tensor. Raises ``error``."""
    array = as_array(mask)
    is_mask = array.dtype == np.bool_ and array.shape == (count,)
    require(where, is_mask, f"bool [{count}]", f"{array.dtype} {list(array.shape)}", error)
    return array


def _checked_frames(frames: Any) -> UInt8Array:
    try:
        array = as_array(frames)
    except InvalidSampleError as error:
        raise error.inside("frames") from None
    except ValueError:  # lists of unequal length
        raise InvalidSampleError.at("frames", "uint8 [T, H, W, 3]", "frames of unequal size") from None
    got = f"{array.dtype} {list(array.shape)}"
    if array.dtype != np.uint8:
        raise InvalidSampleError.at("frames", "uint8 [T, H, W, 3] (see float_frames_to_uint8)", got)
    if array.ndim != 4 or array.shape[3] != 3:
        raise InvalidSampleError.at("frames", "uint8 [T, H, W, 3]", got)
    if 0 in array.shape:
        raise InvalidSampleError.at("frames", "at least one frame of at least one pixel", got)
    return array


def _checked_goal(goal: Any) -> UInt8Array:
    try:
        frames: UInt8Array = _checked_frames(as_array(goal)[np.newaxis])
    except InvalidSampleError:
        array = as_array(goal)
        got = f"{array.dtype} {list(array.shape)}"
        raise InvalidSampleError.at("goal", "a picture, uint8 [H, W, 3]", got) from None
    return cast(UInt8Array, frames[0])


def _checked_floats(where: str, values: Any, axes: tuple[str, ...]) -> Float32Array:
    expected = f"float32 [{', '.join(axes)}]"
    try:
        array = as_array(values)
    except ValueError:  # lists of unequal length
        raise InvalidSampleError.at(where, expected, "rows of unequal length") from None
    if array.dtype.kind not in "fiu" or array.ndim != len(axes):
        raise InvalidSampleError.at(where, expected, f"{array.dtype} {list(array.shape)}")
    if 0 in array.shape:
        raise InvalidSampleError.at(where, f"{expected} without an empty axis", f"{array.dtype} {list(array.shape)}")
    if array.dtype != np.float32:
        with np.errstate(over="ignore"):  # a value too large for float32 becomes Inf, which is refused below
            array = array.astype(np.float32)
    finite = np.isfinite(array)
    if not finite.all():
        position = np.argwhere(~finite)[0].tolist()
        raise InvalidSampleError.at(where, "finite values", f"{array[tuple(position)]} at {position}")
    return array


def _check_text(trajectory: Trajectory, where: str) -> None:
    """Check the first trajectory's text, the only text that the model reads."""
    if not isinstance(trajectory, Trajectory):
        raise InvalidSampleError.at(where, "Trajectory", type(trajectory).__name__)
    if trajectory.video_embeddings is not None and trajectory.text_embedding is None:
        raise InvalidSampleError.at(f"{where}.text_embedding", "float32 [Dt] with video_embeddings", "None")
    if trajectory.video_embeddings is None and not trajectory.task.strip():
        raise InvalidSampleError.at(f"{where}.task", "a task sentence with frames", repr(trajectory.task))


def _check_pair(first: Trajectory, second: Trajectory, where: str) -> None:
    """Check that both are frames or both embeddings. Embeddings need one width; frames may differ in size."""
    if not isinstance(second, Trajectory):
        raise InvalidSampleError.at(where, "Trajectory", type(second).__name__)
    for each in (first, second):
        if each.has_views:
            expected = "trajectories without views and goal, which only progress has"
            raise InvalidSampleError.at(where, expected, "them")
    if (first.frames is None) != (second.frames is None):
        expected, got = ("video_embeddings", "frames") if first.frames is None else ("frames", "video_embeddings")
        raise InvalidSampleError.at(where, f"{expected}, as the first trajectory", got)
    if first.frames is None and first.positions.shape[1:] != second.positions.shape[1:]:
        expected, got = str(list(first.positions.shape[1:])), str(list(second.positions.shape[1:]))
        raise InvalidSampleError.at(
            f"{where}.video_embeddings", f"{expected} per frame, as the first trajectory (one array holds both)", got
        )


Widths: TypeAlias = tuple[int, int] | None  # D and Dt of the embeddings that a model reads; None: raw frames

BLANK_FRAMES = 2
SIDE_PX = 64
PROBE_TASK = "probe"  # task for a blank trajectory


def blank_trajectory(widths: Widths, task: str = PROBE_TASK) -> Trajectory:
    """Return BLANK_FRAMES all-zero embeddings or frames."""
    if widths is None:
        return Trajectory(frames=np.zeros((BLANK_FRAMES, SIDE_PX, SIDE_PX, 3), np.uint8), task=task)
    video_dim, text_dim = widths
    return Trajectory(
        video_embeddings=np.zeros((BLANK_FRAMES, video_dim), np.float32), text_embedding=np.zeros(text_dim, np.float32)
    )


def random_trajectory(
    random: np.random.Generator,
    num_frames: int,
    widths: Widths,
    *,
    task: str,
    size_px: tuple[int, int] = (SIDE_PX, SIDE_PX),
) -> Trajectory:
    """Return normally distributed embeddings, or noise frames with ``task`` and ``size_px`` = (height, width)."""
    if widths is None:
        return Trajectory(frames=random.integers(0, 256, (num_frames, *size_px, 3), np.uint8), task=task)
    video_dim, text_dim = widths
    return Trajectory(
        video_embeddings=random.standard_normal((num_frames, video_dim), np.float32),
        text_embedding=random.standard_normal(text_dim, np.float32),
    )
