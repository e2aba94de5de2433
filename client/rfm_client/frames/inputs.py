# SPDX-License-Identifier: MIT
"""Load trajectories from files and robot dataset steps.

T steps, H x W pixels, D embedding width. Any array may be a torch tensor, also on a GPU or with a gradient; torch
is not imported.
"""

from __future__ import annotations

import tokenize
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from rfm_client.contract.checks import git_lfs_pointer, require
from rfm_client.contract.errors import InvalidSampleError
from rfm_client.contract.samples import Trajectory, UInt8Array, as_array, checked_mask, with_pictures
from rfm_client.frames.orientation import ChannelOrder, Correction, Orientation
from rfm_client.frames.pictures import FrameFileError, Picture, upright_picture
from rfm_client.frames.video import is_url, read_video

_BROKEN_NPY = (  # numpy's errors for a broken .npy header
    *(ValueError, TypeError, LookupError, SyntaxError),
    *(tokenize.TokenError, MemoryError, RecursionError),
)
ARRAY_SUFFIXES = (".npy", ".npz")
_ARRAYS = (b"\x93NUMPY", b"PK")  # how .npy and .npz files begin

_CAMERA_PREFIX = "observation.images."  # precedes the camera's name in LeRobot's keys
_ONLY_CAMERA = "observation.image"  # LeRobot's key for a single camera without a name
_IS_PAD = "_is_pad"  # suffix for bool [T]: True for steps before the episode's start or after its end
_FRAMES = "uint8 or float in 0..1 [T, H, W, 3] or [T, 3, H, W]"


def load_trajectory(
    source: str | Path,
    *,
    task: str = "",
    fps: float | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    orient: Orientation = "none",
    channels: ChannelOrder = "rgb",
    views: Sequence[str | Path] = (),
    goal: str | Path | None = None,
) -> Trajectory:
    """Return the trajectory in a file.

    ``.npy``: frames, or embeddings [T, D]. ``.npz``: ``frames``, or ``video_embeddings`` and ``text_embedding``; and
    ``task``, as in ``as_trajectory``. All other files are videos, as in ``read_video``.

    task: replaces the file's task
    fps: frames per second to sample from a video; None: all frames
    start_s, end_s: part of a video, in seconds since its first frame; None: from the start, to the end
    orient: turn that makes frames and views upright
    channels: colour order in stored frames and views
    views: files with further cameras' frames, cut to the same part
    goal: picture file, used as stored, upright by its EXIF data. Needs Pillow

    Raises InvalidSampleError, also for arrays of Python objects, because reading them runs code, and for a video with
    several LeRobot v3.0 episodes, unless ``start_s`` and ``end_s`` select a part.
    """
    part: dict[str, Any] = {"fps": fps, "start_s": start_s, "end_s": end_s}
    load = partial(_loaded, correction=Correction(orient, channels), part=part)
    trajectory, others = load(source, task=task), []
    for view in views:
        frames = load(view, task="").frames
        if frames is None or len(frames) != trajectory.num_frames:
            got = "embeddings" if frames is None else len(frames)
            raise InvalidSampleError.at(view, f"{trajectory.num_frames} frames, as {source}", got)
        others.append(frames)
    return replace(trajectory, views=tuple(others), goal=None if goal is None else _picture(goal))


def as_trajectory(
    episode: Mapping[str, Any] | Iterable[Mapping[str, Any]], *, task: str = "", camera: str | None = None
) -> Trajectory:
    """Return the trajectory for an episode in a Hugging Face or LeRobot dataset.

    episode: a dict over all steps, or a dict for each step, with the keys

    ``observation.images.<camera>`` or ``frames``: [T, H, W, 3] or [T, 3, H, W], or a sequence of T images (arrays,
        tensors, PIL, turned according to EXIF data); uint8, or float in 0..1, which is multiplied by 255 and rounded
    ``video_embeddings``, ``text_embedding``: as in Trajectory
    ``task``: text, the same at all steps
    ``<key>_is_pad``: bool [T], True for a step that LeRobot marks as padding, which is dropped; the key is that of the
        frames or ``video_embeddings``

    Other keys are ignored, but ``episode_index``, if present, must be the same at all steps.

    task: replaces the episode's task
    camera: which camera to use, if there are several; ``image`` for the nameless ``observation.image``

    Raises InvalidSampleError.
    """
    columns = episode if isinstance(episode, Mapping) else _columns(episode)
    _only(columns, "episode_index", None)
    task = task or _only(columns, "task", "")
    if camera is None and not {"frames", "video_embeddings"}.isdisjoint(columns):
        return Trajectory(
            frames=_unpadded(columns, "frames", _frames("frames", columns["frames"])) if "frames" in columns else None,
            video_embeddings=_unpadded(columns, "video_embeddings", columns.get("video_embeddings")),
            text_embedding=columns.get("text_embedding"),
            task=task,
        )
    key = _camera_key(columns, camera)
    return Trajectory(frames=_unpadded(columns, key, _frames(key, columns[key])), task=task)


def _loaded(source: str | Path, *, task: str, correction: Correction, part: Mapping[str, Any]) -> Trajectory:
    """Return the trajectory in one file. Raises InvalidSampleError. part: video part, as in ``read_video``."""
    if is_url(source) or Path(source).suffix.lower() not in ARRAY_SUFFIXES:
        return Trajectory(frames=correction.applied(read_video(source, **part)), task=task)
    for name, value in part.items():
        if value is not None:
            raise InvalidSampleError.at(name, "None with arrays, which do not tell their own", repr(value))
    arrays = _arrays(Path(source))
    try:
        return _corrected(as_trajectory(arrays, task=task), correction)
    except InvalidSampleError as error:
        raise InvalidSampleError(f"{error} ({source})") from error


def _picture(file: str | Path) -> UInt8Array:
    try:
        return Picture(Path(file)).pixels()
    except FrameFileError as error:
        raise InvalidSampleError.like(error, where=str(file)) from error


def _unpadded(columns: Mapping[str, Any], key: str, values: Any) -> Any:
    """Return the values [T, ...] at the steps that are not padding. Without marks, return them unchanged."""
    if key + _IS_PAD not in columns or values is None:
        return values
    steps = as_array(values)
    return steps[~checked_mask(key + _IS_PAD, columns[key + _IS_PAD], len(steps), InvalidSampleError)]


def _corrected(trajectory: Trajectory, correction: Correction) -> Trajectory:
    if trajectory.frames is not None:
        return with_pictures(trajectory, correction.applied)
    for name, default in asdict(Correction()).items():
        if getattr(correction, name) != default:
            expected = f"{default} for embeddings, which cannot be changed so"
            raise InvalidSampleError.at(name, expected, getattr(correction, name))
    return trajectory


def _arrays(file: Path) -> Mapping[str, npt.NDArray[Any]]:
    try:
        if pointer := git_lfs_pointer(file):
            raise ValueError(pointer)
        with file.open("rb") as stream:
            if not stream.read(max(map(len, _ARRAYS))).startswith(_ARRAYS):
                raise ValueError("a file of another kind")
            stream.seek(0)
            loaded = np.load(stream, allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                return {"video_embeddings" if loaded.ndim == 2 else "frames": loaded}
            return {key: loaded[key] for key in loaded.files}
    except FileNotFoundError as error:
        raise InvalidSampleError.at("file", "a file of arrays", f"no file of this name ({file})") from error
    except (OSError, EOFError, BadZipFile, zlib.error, *_BROKEN_NPY) as error:
        raise InvalidSampleError.at("file", "arrays of numbers and text, none pickled", f"{error} ({file})") from error


def _columns(steps: Iterable[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return each key's values at all steps; None where a step lacks the key."""
    items = list(steps) if isinstance(steps, Iterable) else [steps]
    strangers = [type(item).__name__ for item in items if not isinstance(item, Mapping)]
    got = [*strangers, "nothing"][0]
    require("episode", bool(items) and not strangers, "a dict, or one dict a step", got, InvalidSampleError)
    keys = dict.fromkeys(key for item in items for key in item)
    return {key: [item.get(key) for item in items] for key in keys}


def _only(columns: Mapping[str, Any], key: str, default: Any) -> Any:
    """Return the key's value, equal at all steps, given once or for each step, in any container."""
    given = columns.get(key, default)
    is_by_step = isinstance(given, Sequence) and not isinstance(given, (str, bytes))
    try:
        steps = [as_array(step).tolist() for step in (given if is_by_step else [given])]
    except ValueError as error:  # numpy's
        raise InvalidSampleError.at(key, "one value for each step", "rows of several lengths") from error
    for values in (steps, as_array(steps[:1]).reshape(-1).tolist()):
        for value in values:
            got = f"{values[0]!r} and {value!r}"
            require(key, value == values[0], "the same at all steps", got, InvalidSampleError)
    return values[0] if values else default


def _camera_key(columns: Mapping[str, Any], camera: str | None) -> str:
    keys = [key for key in columns if key.startswith(_CAMERA_PREFIX) and not key.endswith(_IS_PAD)]
    cameras = {key.removeprefix(_CAMERA_PREFIX): key for key in keys}
    if _ONLY_CAMERA in columns:
        cameras[_ONLY_CAMERA.rpartition(".")[2]] = _ONLY_CAMERA
    if not cameras:
        raise InvalidSampleError.at(
            "episode", f"{_CAMERA_PREFIX}<camera>, frames or video_embeddings", f"the keys {', '.join(columns)}"
        )
    if camera is None and len(cameras) == 1:
        (camera,) = cameras
    if camera not in cameras:
        raise InvalidSampleError.at("camera", f"one of {', '.join(cameras)}", repr(camera))
    return cameras[camera]


def _frames(where: str, values: Any) -> UInt8Array:
    is_sequence = isinstance(values, Sequence)
    try:
        images = [_image(each) for each in values] if is_sequence else np.atleast_1d(as_array(values))
    except InvalidSampleError as error:
        raise error.inside(where) from None
    kinds = {(image.dtype, image.shape) for image in images}
    got = " and ".join(sorted(f"{dtype} {list(shape)}" for dtype, shape in kinds)) or "none"
    require(where, len(kinds) == 1, "images of one type and size", got, InvalidSampleError)
    ((dtype, shape),) = kinds
    if (dtype != np.uint8 and dtype.kind != "f") or len(shape) != 3 or 3 not in (shape[0], shape[2]) or 0 in shape:
        raise InvalidSampleError.at(where, _FRAMES, f"{dtype} {[len(images), *shape]}")
    frames = np.asarray(images if dtype == np.uint8 else [_uint8(where, image) for image in images])
    return frames if frames.shape[3] == 3 else frames.transpose(0, 2, 3, 1)


def _image(image: Any) -> npt.NDArray[Any]:
    return as_array(upright_picture(image) if hasattr(image, "getexif") else image)  # a Pillow picture


def _uint8(where: str, image: npt.NDArray[Any]) -> UInt8Array:
    lowest, highest = float(image.min()), float(image.max())
    got = f"values from {lowest:g} to {highest:g} (of floats in 0..255: float_frames_to_uint8)"
    require(where, lowest >= 0 and highest <= 1, _FRAMES, got, InvalidSampleError)  # false for NaN, too
    return (image.astype(np.float32) * np.float32(255)).round().astype(np.uint8)
