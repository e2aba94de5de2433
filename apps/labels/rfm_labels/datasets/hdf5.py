# SPDX-License-Identifier: MIT
"""HDF5 files of robomimic and LIBERO: ``data/demo_<i>/obs/<camera>``. Needs ``rfm-labels[hdf5]``.

The task is the demonstration's own (``ep_meta``), else LIBERO's sentence (``problem_info`` of ``data``), robomimic's
(``env_args``), or the caller's. LIBERO stores its pictures upside down: they are turned, unless the caller says
otherwise. robomimic's filter keys (``mask/train``) name some of the demonstrations.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from rfm_client import RewardError, UInt8Array
from rfm_client.frames import Orientation
from rfm_client.options import first_names
from rfm_labels.datasets.cameras import AskedCorrections
from rfm_labels.datasets.dataset import Dataset, DatasetEpisode, TaskOverride
from rfm_labels.datasets.faults import DatasetError, FaultsError, require
from rfm_labels.datasets.hdf5_contents import (
    DOCUMENTS,
    attribute,
    demonstrations,
    filter_keys,
    fps_of,
    is_of_libero,
    lacking,
    members_of,
    opened_hdf5,
    own_task_of,
    task_of,
    unread,
    unread_documents,
)
from rfm_labels.datasets.stored_files import digest_of

SUFFIXES = (".hdf5", ".h5")

_FRAMES_AT_A_TIME = 64
_LIBERO: Orientation = "flip-vertical"  # as in upstream's training data and evaluation
_LIBERO_CAMERAS = ("agentview_rgb", "eye_in_hand_rgb")
_NO_PICTURES = "robomimic's dataset_states_to_obs.py renders the pictures of a low-dimensional file"
_LEAST_SIZE_PX = 8  # a smaller array of numbers is no picture
_ENCODED = (b"\xff\xd8\xff", b"\x89PNG")  # first bytes of JPEG and PNG
_ACTIONS = "actions"


def is_hdf5(path: Path) -> bool:
    """True for an existing file with the suffix of HDF5."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


class Hdf5Dataset(Dataset):
    """The demonstrations of one file.

    task: task from the caller
    corrections: corrections from the caller; without an orientation, cameras of LIBERO files are turned
    """

    kind = "HDF5"

    def __init__(
        self, file: Path, *, task: TaskOverride = TaskOverride(), corrections: AskedCorrections = AskedCorrections()
    ) -> None:
        self.file = file
        self.root = file.parent
        self.source = file.name
        self.given_task = task
        with opened_hdf5(file) as opened:
            demos = demonstrations(file, opened)
            self._demos = {index: name for index, (name, _) in demos.items()}
            self._pictures = _pictures_in(demos)
            self._forms = _forms_in(demos)
            of_all = task_of(opened["data"].attrs)
            self._tasks = {index: own_task_of(demo) or of_all for index, (_, demo) in demos.items()}
            self.filter_keys, notes = filter_keys(opened, self._demos)
            self.cameras, self.left_out = self._shared(list(demos))
            self._lengths = {
                index: _lengths_of(demo, self.cameras or self._cameras_of(index)) for index, (_, demo) in demos.items()
            }
            attributes = opened["data"].attrs
            self._broken = unread_documents(attributes)
            notes = [*unread(opened, self._demos.values()), *notes, *_notes_on_lengths(demos, self._lengths)]
            notes += [
                f"data: {name} is not a JSON object, so it states neither a task nor LIBERO" for name in self._broken
            ]
            is_libero = is_of_libero(attributes)
            self.fps = fps_of(attributes)
            is_upright = "opencv" in str(attribute(attributes, "macros_image_convention"))  # robosuite then does
        self.numbers = list(demos)
        known = [camera for camera in self._pictures if any(camera in self._cameras_of(each) for each in self.numbers)]
        if not known:
            self.cameras_in(self.numbers)  # raises the reason
        defaults: dict[str, Orientation] = dict.fromkeys(known, _LIBERO) if is_libero and not is_upright else {}
        self.corrections = corrections.of_cameras(known, defaults)
        untold = [camera for camera in known if {"", camera}.isdisjoint(corrections.orient)]
        self.notes = [*notes, *([] if is_upright else _notes(untold, is_libero))]

    def read_episode(self, number: int) -> DatasetEpisode:
        where = f"{self.file}: data/{self._demos[number]}"
        told = " or ".join(name + " (no JSON object)" * (name in self._broken) for name in DOCUMENTS)
        task = self.given_task.of(f"{where}: ep_meta, or data: {told}", self._tasks[number])
        lengths = self._lengths[number]
        got = ", ".join(f"{key} {length}" for key, length in lengths.items()) or self._forms[number]
        require(where, _one_length(lengths) > 0, "one length, above 0", got)
        first = sum(_one_length(self._lengths[before]) for before in self.numbers if before < number)
        return DatasetEpisode(number, self._demos[number], task, _one_length(lengths), first)

    def cameras_in(self, numbers: Sequence[int]) -> tuple[Sequence[str], Mapping[str, str]]:
        cameras, left_out = self._shared(numbers)
        if not cameras:
            self._refuse(numbers, left_out)
        return cameras, left_out

    def _refuse(self, numbers: Sequence[int], left_out: Mapping[str, str]) -> NoReturn:
        """Raise FaultsError with the demonstrations that lack the most common camera; DatasetError if all do."""
        lacking_it = [[number for number in numbers if self._pictures[name][number]] for name in left_out]
        faulty = min(lacking_it, key=len, default=numbers)
        whole = len(faulty) == len(numbers)
        faults: dict[int, RewardError] = {}
        for number in numbers[:1] if whole else faulty:
            own = {name: reasons[number] for name, reasons in self._pictures.items() if reasons[number]}
            got = "; ".join(f"{name}: {reason}" for name, reason in (left_out if whole else own).items())
            got = got or f"{self._forms[number]}: {_NO_PICTURES}"
            expected = "a camera as uint8 [T, H, W, 3]" + " in every demonstration" * whole
            faults[number] = DatasetError.at(f"{self.file}: data/{self._demos[number]}/obs", expected, got)
        raise faults[numbers[0]] if whole else FaultsError.of(faults, numbers)

    def _shared(self, numbers: Sequence[int]) -> tuple[Sequence[str], Mapping[str, str]]:
        """The cameras of these demonstrations, and the faults of other pictures."""
        told = {name: [faults[number] for number in numbers] for name, faults in self._pictures.items()}
        faults = {name: next(filter(None, of_demos), "") for name, of_demos in told.items()}
        cameras = tuple(name for name, fault in faults.items() if not fault)
        return cameras, {name: fault for name, fault in faults.items() if fault}

    def _cameras_of(self, number: int) -> list[str]:
        return [name for name, faults in self._pictures.items() if not faults[number]]

    def decoder(self, camera: str) -> str | None:
        return None

    def identity(self, episode: DatasetEpisode, camera: str, *, verify: bool) -> str:
        return digest_of(frame.tobytes() for frame in self.stored_frames(episode, camera))

    def check(self, episode: DatasetEpisode, camera: str) -> int:
        with opened_hdf5(self.file) as opened:
            return int(self._video(opened, episode, camera).nbytes)

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        with opened_hdf5(self.file) as opened:
            video = self._video(opened, episode, camera)
            for start in range(0, episode.num_frames, _FRAMES_AT_A_TIME):
                try:
                    yield from video[start : start + _FRAMES_AT_A_TIME]
                except OSError as error:
                    raise DatasetError.at(self._where(episode, camera), "readable frames", error) from error

    def _video(self, opened: Any, episode: DatasetEpisode, camera: str) -> Any:
        video = opened.get(f"data/{episode.name}/obs/{camera}")
        is_video = video is not None and not _fault(video) and len(video) == episode.num_frames
        got = "none" if video is None else _form(video)
        require(self._where(episode, camera), is_video, f"uint8 [{episode.num_frames}, H, W, 3]", got)
        lacks = lacking(video)
        require(self._where(episode, camera), not lacks, f"{lacks}, a source of this virtual dataset", "none")
        return video

    def _where(self, episode: DatasetEpisode, camera: str) -> str:
        return f"{self.file}: data/{episode.name}/obs/{camera}"


def _pictures_in(demos: Mapping[int, tuple[str, Any]]) -> Mapping[str, Mapping[int, str]]:
    """Faults by picture and demonstration; "" for no fault."""
    observations = {number: (name, _observations(demo)) for number, (name, demo) in demos.items()}
    found = {name: None for _, stored in observations.values() for name, value in stored.items() if _is_picture(value)}
    return {
        picture: {
            number: _fault(stored[picture]) if stored.get(picture) is not None else _missing(picture, demos[number])
            for number, (name, stored) in observations.items()
        }
        for picture in found
    }


def _forms_in(demos: Mapping[int, tuple[str, Any]]) -> Mapping[int, str]:
    """Descriptions of the observations by demonstration, for messages."""
    found = {number: _observations(demo) for number, (_, demo) in demos.items()}
    return {
        n: ", ".join(f"{name} {_form(value)}" for name, value in each.items()) or "none" for n, each in found.items()
    }


def _lengths_of(demo: Any, cameras: Sequence[str]) -> Mapping[str, int]:
    """Number of frames of each camera, and of actions, if present."""
    lengths = {f"obs/{camera}": len(demo["obs"][camera]) for camera in cameras}
    shape = getattr(demo.get(_ACTIONS), "shape", None) if lengths else None
    return lengths | ({_ACTIONS: shape[0]} if shape else {})


def _one_length(lengths: Mapping[str, int]) -> int:
    """Number of frames in all cameras; 0 if the cameras differ or have none.

    The number of actions is the same, or one less if the last observation has no action.
    """
    of_cameras = {length for key, length in lengths.items() if key != _ACTIONS}
    length = of_cameras.pop() if len(of_cameras) == 1 else 0
    return length if lengths.get(_ACTIONS, length) in (length, length - 1) else 0


def _notes_on_lengths(demos: Mapping[int, tuple[str, Any]], lengths: Mapping[int, Mapping[str, int]]) -> list[str]:
    """Notes on demonstrations with more frames than actions, or another length than ``num_samples``."""
    longer, others = [], []
    for number, (name, demo) in demos.items():
        length = _one_length(lengths[number])
        if length and lengths[number].get(_ACTIONS, length) < length:
            longer.append(name)
        told = attribute(demo.attrs, "num_samples") if length else None
        if told is not None and told not in lengths[number].values():
            others.append(f"{name} ({told}, has {length})")
    every = "each observation gets a label"
    notes = [f"lengths: {first_names(longer)}: one observation more than actions: {every}"] if longer else []
    return notes + ([f"lengths: num_samples differs: {first_names(others)}: {every}"] if others else [])


def _missing(picture: str, demo: tuple[str, Any]) -> str:
    """Why a demonstration lacks a picture."""
    name, stored = demo
    if stored is None:
        return f"{name} is a broken link"
    return f"{name} has a broken link or no array" if picture in _observations(stored) else f"missing in {name}"


def _observations(demo: Any) -> Mapping[str, Any]:
    observations: Any = demo.get("obs") if hasattr(demo, "keys") else None
    return {name: value if _is_known(value) else None for name, value in members_of(observations).items()}


def _is_known(value: Any) -> bool:
    """True for a group, and an array of numbers or texts that NumPy knows."""
    try:
        return hasattr(value, "keys") or (getattr(value, "shape", None) is not None and bool(value.dtype.kind))
    except (TypeError, OSError, RuntimeError):
        return False


def _fault(value: Any) -> str:
    """Why an observation is not a camera's frames; "": it is."""
    if not hasattr(value, "shape"):
        return "a group: expected its pictures one level up"
    shape = value.shape if len(value.shape) == 4 else (0, 0, 0, 0)
    if _is_encoded(value):
        what = "JPEG or PNG files: store decoded pictures as uint8 [T, H, W, 3]"
    elif shape[3] == 3:
        what = (
            "no pixels" if 0 in shape[1:] else "" if value.dtype == np.uint8 else "not uint8: store colours as 0..255"
        )
    elif shape[3] == 4:
        what = "RGBA: store its first three channels, if they are uint8 RGB"
    elif shape[1] in (3, 4):
        what = "channels first: store it as uint8 [T, H, W, 3]"
    else:
        what = "a depth map, a mask or another form: no colours as uint8 [T, H, W, 3]"
    return what and f"{_form(value)}, {what}"


def _form(value: Any) -> str:
    if value is None:
        return "(unreadable)"
    return f"{value.dtype} {list(value.shape)}" if hasattr(value, "shape") else "(a group)"


def _is_picture(value: Any) -> bool:
    if value is None:  # it may have been one
        return True
    if not hasattr(value, "shape"):
        return bool(value.visititems(lambda _, each: (hasattr(each, "shape") and _is_picture(each)) or None))
    if len(value.shape) == 3:
        return all(size >= _LEAST_SIZE_PX for size in value.shape[1:])
    return len(value.shape) > 3 or _is_encoded(value)


def _is_encoded(value: Any) -> bool:
    if len(value.shape) not in (1, 2) or not value.shape[0] or value.dtype.kind not in "OSVu":
        return False
    try:
        return bool(np.asarray(value[0]).tobytes().startswith(_ENCODED))
    except (OSError, RuntimeError):  # refused when read
        return False


def _notes(untold: Sequence[str], is_libero: bool) -> Sequence[str]:
    if is_libero and untold:
        why = "LIBERO stores its pictures upside down; --orient none leaves them"
        return [f"orient: {', '.join(untold)} {_LIBERO} ({why})"]
    doubtful = [camera for camera in untold if camera in _LIBERO_CAMERAS]
    if not doubtful:
        return []
    advice = f"look at a frame, and turn them with --orient {_LIBERO} if they are upside down"
    why = "as stored, but LIBERO, which names cameras so, stores them upside down"
    return [f"orient: {', '.join(doubtful)} {why}: {advice}"]
