# SPDX-License-Identifier: MIT
"""HDF5 files from robomimic, LIBERO (``data/demo_<i>/obs/<camera>``) and IsaacLab-Arena. Needs ``rfm-labels[hdf5]``.

The task is the demonstration's own (``ep_meta``), else LIBERO's sentence (``problem_info`` of ``data``), robomimic's
(``env_args``), or the caller's. LIBERO stores pictures upside down: they are turned, unless the caller says otherwise.
robomimic's filter keys (``mask/train``) name some demonstrations. IsaacLab-Arena keeps pictures in ``camera_obs``. The
first shows the end of the demonstration before, and is left out, as by Arena's converter to LeRobot.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rfm_client import UInt8Array
from rfm_client.frames import Orientation
from rfm_labels.datasets.dataset import AskedCorrections, DatasetEpisode, TaskOverride
from rfm_labels.datasets.faults import DatasetError, require
from rfm_labels.datasets.hdf5_contents import (
    DOCUMENTS,
    attribute,
    demonstrations,
    fault_of,
    filter_keys,
    form_of,
    fps_of,
    is_of_libero,
    may_be_picture,
    members_of,
    observations,
    opened_hdf5,
    task_of,
    unread_documents,
)
from rfm_labels.datasets.recorded import Recorded, RecordedDataset, Stored
from rfm_labels.datasets.stored_files import digest_of

SUFFIXES = (".hdf5", ".h5")

_FRAMES_AT_A_TIME = 64
_LIBERO: Orientation = "flip-vertical"  # as in upstream's training data and evaluation
_LIBERO_CAMERAS = ("agentview_rgb", "eye_in_hand_rgb")
_ARENA, _ARENA_FPS = "camera_obs", 50.0
_RENDER = "robomimic's dataset_states_to_obs.py renders the pictures of a low-dimensional file"


class _Pixels(Stored):
    """A camera's frames in a file, or why the numbers of frames and actions do not fit.

    path: to the camera
    counts: number of pictures, and of actions; None: no actions
    skipped: pictures before the first frame
    """

    def __init__(self, file: Path, path: str, counts: tuple[int, int | None], skipped: int) -> None:
        self._file, self._path, self._counts, self._skipped = file, path, counts, skipped

    @property
    def count(self) -> int:
        """The actions may be as many, or one less if the last observation has none."""
        length, actions = self._counts
        got = f"{self._path.split('/', 2)[2]} {length}" + ("" if actions is None else f", actions {actions}")
        is_one = length > self._skipped and actions in (None, length, length - 1)
        require(f"{self._file}: {'/'.join(self._path.split('/')[:2])}", is_one, "one length, above 0", got)
        return length - self._skipped

    def identity(self) -> str:
        return digest_of(frame.tobytes() for frame in self.frames())

    def frames(self) -> Iterator[UInt8Array]:
        with opened_hdf5(self._file) as opened:
            video, length = opened.get(self._path), self._counts[0]
            is_video = video is not None and not fault_of(video) and len(video) == length
            got = "none" if video is None else form_of(video)
            require(f"{self._file}: {self._path}", is_video, f"uint8 [{length}, H, W, 3]", got)
            for start in range(self._skipped, len(video), _FRAMES_AT_A_TIME):
                try:
                    yield from video[start : start + _FRAMES_AT_A_TIME]
                except OSError as error:
                    raise DatasetError.at(f"{self._file}: {self._path}", "readable frames", error) from error


def is_hdf5(path: Path) -> bool:
    """True for an existing file with an HDF5 suffix."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def label_prefix(path: Path) -> str:
    """Return the prefix for a dataset's label file names: ``demos.`` for ``demos.hdf5``, else nothing."""
    return f"{path.stem}." if path.suffix.lower() in SUFFIXES else ""


class Hdf5Dataset(RecordedDataset):
    """The demonstrations in one file. LIBERO's cameras are turned, unless the caller says otherwise."""

    def __init__(
        self, file: Path, *, task: TaskOverride = TaskOverride(), corrections: AskedCorrections = AskedCorrections()
    ) -> None:
        self.file, self.root, self.source, self.given_task = file, file.parent, file.name, task
        self.label_prefix = label_prefix(file)
        with opened_hdf5(file) as opened:
            groups, attributes = demonstrations(file, opened), opened["data"].attrs
            is_arena = any(_ARENA in members_of(group) for _, group in groups.values())
            self._folder, self._skipped = (_ARENA, 1) if is_arena else ("obs", 0)
            broken = unread_documents(attributes)
            documents = " or ".join(name + " (no JSON object)" * (name in broken) for name in DOCUMENTS)
            recorded = {
                number: self._recorded(name, group, task_of(opened, group), f"ep_meta, or data: {documents}")
                for number, (name, group) in groups.items()
            }
            self.filter_keys = filter_keys(opened)
            is_libero = not is_arena and is_of_libero(attributes)
            self.fps = _ARENA_FPS if is_arena else fps_of(attributes)
            is_upright = "opencv" in str(attribute(attributes, "macros_image_convention"))  # robosuite turned frames
        self.kind = "HDF5 (IsaacLab-Arena)" if is_arena else "HDF5"
        known = self.set_recorded(recorded)
        defaults: dict[str, Orientation] = dict.fromkeys(known, _LIBERO) if is_libero and not is_upright else {}
        self.corrections = corrections.of_cameras(known, defaults)
        uncorrected = [camera for camera in known if {"", camera}.isdisjoint(corrections.orient)]
        why = "is not a JSON object, so it states neither a task nor LIBERO"
        self.notes = [f"data: {name} {why}" for name in broken]
        self.notes += [] if is_upright else _notes(uncorrected, is_libero)
        why = "which shows the end of the episode before; frame 0 is the second"
        self.notes += [f"layout: IsaacLab-Arena; left out: each first picture, {why}"] * is_arena

    def _recorded(self, name: str, group: Any, task: Any, task_place: str) -> Recorded:
        found = observations(group, self._folder)
        faults = {
            each: f"{name} has a broken link or no array" if value is None else fault_of(value)
            for each, value in found.items()
        }
        shape = getattr(group.get("actions") if hasattr(group, "keys") else None, "shape", None)
        actions, place = shape[0] if shape else None, f"{self.file}: data/{name}"
        described = ", ".join(f"{each} {form_of(value)}" for each, value in found.items()) or "none"
        self.without_pictures = f"{described}: {_RENDER}"
        cameras = {
            each: _Pixels(self.file, f"data/{name}/{self._folder}/{each}", (len(found[each]), actions), self._skipped)
            for each, fault in faults.items()
            if not fault
        }
        missing = f"{name} is a broken link" if group is None else f"missing in {name}"
        faults = {each: fault for each, fault in faults.items() if fault and may_be_picture(found[each])}
        return Recorded(name, f"{place}/{self._folder}", task, f"{place}: {task_place}", cameras, missing, faults)

    def length(self, number: int) -> int:
        """Return the frame count of all shared cameras. Raises DatasetError if they differ."""
        one = self.recorded[number]
        shared = [each for each in self.cameras if each in one.cameras]
        counts = {f"{self._folder}/{each}": one.cameras[each].count for each in shared}
        got = ", ".join(f"{name} {count}" for name, count in counts.items())
        require(f"{self.file}: data/{one.name}", len(set(counts.values())) < 2, "one length, above 0", got)
        return next(iter(counts.values()), 0) or super().length(number)

    def listed_in(self) -> Iterable[Path]:
        return [self.file]

    def place(self, episode: DatasetEpisode, camera: str) -> str:
        return f"{self.file}: data/{episode.name}/{self._folder}/{camera}"


def _notes(uncorrected: Sequence[str], is_libero: bool) -> list[str]:
    if is_libero:
        why = "LIBERO stores its pictures upside down; --orient none leaves them"
        return [f"orient: {', '.join(uncorrected)} {_LIBERO} ({why})"] if uncorrected else []
    doubtful = ", ".join(camera for camera in uncorrected if camera in _LIBERO_CAMERAS)
    advice = f"look at a frame, and turn them with --orient {_LIBERO} if they are upside down"
    why = "as stored, but LIBERO, which names cameras so, stores them upside down"
    return [f"orient: {doubtful} {why}: {advice}"] if doubtful else []
