# SPDX-License-Identifier: MIT
"""HDF5 files from robomimic, LIBERO (``data/demo_<i>/obs/<camera>``) and IsaacLab-Arena. Needs ``rfm-labels[hdf5]``.

The task is the demonstration's own (``ep_meta``), else LIBERO's sentence (``problem_info`` of ``data``), robomimic's
(``env_args``), or the caller's. LIBERO stores pictures upside down: they are turned, unless the caller says otherwise.
robomimic's filter keys (``mask/train``) name some demonstrations.

IsaacLab-Arena keeps pictures in ``camera_obs``. The first shows the end of the demonstration before, and is left out,
as by Arena's converter to LeRobot.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from rfm_client import RewardError, UInt8Array
from rfm_client.frames import Orientation
from rfm_labels.datasets.dataset import AskedCorrections, CountedDataset, DatasetEpisode, TaskOverride
from rfm_labels.datasets.faults import DatasetError, FaultsError, require
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
from rfm_labels.datasets.stored_files import digest_of

SUFFIXES = (".hdf5", ".h5")

_FRAMES_AT_A_TIME = 64
_LIBERO: Orientation = "flip-vertical"  # as in upstream's training data and evaluation
_LIBERO_CAMERAS = ("agentview_rgb", "eye_in_hand_rgb")
_ARENA, _ARENA_FPS = "camera_obs", 50.0
_RENDER = "robomimic's dataset_states_to_obs.py renders the pictures of a low-dimensional file"


@dataclass(frozen=True)
class _Demo:
    """What a file holds of one episode.

    missing: why it lacks other observations
    forms: type and shape by observation
    faults: by observation, why it is no camera's frames; empty: it is
    pictures: observations that may be pictures
    lengths: frame count by camera
    num_actions: None: not in the file
    """

    name: str
    task: Any
    missing: str
    forms: Mapping[str, str]
    faults: Mapping[str, str]
    pictures: Sequence[str]
    lengths: Mapping[str, int]
    num_actions: int | None

    @classmethod
    def read(cls, name: str, group: Any, task: Any, folder: str, skipped: int) -> _Demo:
        found = observations(group, folder)
        faults = {
            each: f"{name} has a broken link or no array" if value is None else fault_of(value)
            for each, value in found.items()
        }
        cameras = {each: found[each] for each, fault in faults.items() if not fault}
        actions = getattr(group.get("actions") if cameras else None, "shape", None)
        return cls(
            name,
            task,
            f"{name} is a broken link" if group is None else f"missing in {name}",
            {each: form_of(value) for each, value in found.items()},
            faults,
            [each for each, value in found.items() if may_be_picture(value)],
            {each: len(value) - skipped for each, value in cameras.items()},
            actions[0] - skipped if actions else None,
        )

    def fault(self, picture: str) -> str:
        """Return why the episode lacks a camera; empty if it has it."""
        return self.faults.get(picture, self.missing)

    def counts(self, cameras: Sequence[str]) -> dict[str, int]:
        """Return the frame count per camera, and the action count if present."""
        counts = {f"obs/{camera}": self.lengths[camera] for camera in cameras or self.lengths}
        return counts | ({} if self.num_actions is None or not counts else {"actions": self.num_actions})

    def num_frames(self, cameras: Sequence[str]) -> int:
        """Return the frame count, equal in all cameras; 0 if cameras differ or there are none.

        The action count must be the same, or one less if the last observation has no action; otherwise 0.
        """
        lengths = {self.lengths[camera] for camera in cameras or self.lengths}
        length = lengths.pop() if len(lengths) == 1 else 0
        return length if self.num_actions in (None, length, length - 1) else 0


def is_hdf5(path: Path) -> bool:
    """True for an existing file with an HDF5 suffix."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def label_prefix(path: Path) -> str:
    """Return the prefix for a dataset's label file names: ``demos.`` for ``demos.hdf5``, else nothing."""
    return f"{path.stem}." if path.suffix.lower() in SUFFIXES else ""


class Hdf5Dataset(CountedDataset):
    """The demonstrations in one file. LIBERO's cameras are turned, unless the caller says otherwise."""

    def __init__(
        self, file: Path, *, task: TaskOverride = TaskOverride(), corrections: AskedCorrections = AskedCorrections()
    ) -> None:
        self.file = file
        self.root = file.parent
        self.label_prefix = label_prefix(file)
        self.source = file.name
        self.given_task = task
        with opened_hdf5(file) as opened:
            groups, attributes = demonstrations(file, opened), opened["data"].attrs
            is_arena = any(_ARENA in members_of(group) for _, group in groups.values())
            self._folder, self._skipped = (_ARENA, 1) if is_arena else ("obs", 0)
            self._demos = {
                number: _Demo.read(name, group, task_of(opened, group), self._folder, self._skipped)
                for number, (name, group) in groups.items()
            }
            self.filter_keys = filter_keys(opened)
            self._broken = unread_documents(attributes)
            is_libero = not is_arena and is_of_libero(attributes)
            self.fps = _ARENA_FPS if is_arena else fps_of(attributes)
            is_upright = "opencv" in str(attribute(attributes, "macros_image_convention"))  # robosuite turned frames
        self.kind = "HDF5 (IsaacLab-Arena)" if is_arena else "HDF5"
        self.numbers = list(self._demos)
        self._pictures = list(dict.fromkeys(each for demo in self._demos.values() for each in demo.pictures))
        self.cameras, self.left_out = self._shared(self.numbers)
        known = [each for each in self._pictures if any(each in demo.lengths for demo in self._demos.values())]
        if not known:
            self.cameras_in(self.numbers)  # raises the reason
        defaults: dict[str, Orientation] = dict.fromkeys(known, _LIBERO) if is_libero and not is_upright else {}
        self.corrections = corrections.of_cameras(known, defaults)
        uncorrected = [camera for camera in known if {"", camera}.isdisjoint(corrections.orient)]
        why = "is not a JSON object, so it states neither a task nor LIBERO"
        self.notes = [f"data: {name} {why}" for name in self._broken]
        self.notes += [] if is_upright else _notes(uncorrected, is_libero)
        if is_arena:
            why = "which shows the end of the episode before; frame 0 is the second"
            self.notes += [f"layout: IsaacLab-Arena; left out: each first picture, {why}"]

    def length(self, number: int) -> int:
        return self._demos[number].num_frames(self.cameras)

    def read_episode(self, number: int) -> DatasetEpisode:
        demo = self._demos[number]
        where = f"{self.file}: data/{demo.name}"
        documents = " or ".join(name + " (no JSON object)" * (name in self._broken) for name in DOCUMENTS)
        task = self.given_task.of(f"{where}: ep_meta, or data: {documents}", demo.task)
        counts = ", ".join(f"{key} {count}" for key, count in demo.counts(self.cameras).items())
        require(where, self.length(number) > 0, "one length, above 0", counts or _described(demo.forms))
        return DatasetEpisode(number, demo.name, task, self.length(number), self.frames_before(number))

    def cameras_in(self, numbers: Sequence[int]) -> tuple[Sequence[str], Mapping[str, str]]:
        cameras, left_out = self._shared(numbers)
        if not cameras:
            self._refuse(numbers, left_out)
        return cameras, left_out

    def _refuse(self, numbers: Sequence[int], left_out: Mapping[str, str]) -> NoReturn:
        """Raise FaultsError with the demonstrations that lack the most common camera; DatasetError if all do."""
        lacking_it = [[number for number in numbers if self._demos[number].fault(name)] for name in left_out]
        faulty = min(lacking_it, key=len, default=numbers)
        whole = len(faulty) == len(numbers)
        faults: dict[int, RewardError] = {}
        for number in numbers[:1] if whole else faulty:
            demo = self._demos[number]
            own = {name: fault for name in self._pictures if (fault := demo.fault(name))}
            got = "; ".join(map(": ".join, (left_out if whole else own).items()))
            got = got or f"{_described(demo.forms)}: {_RENDER}"
            expected = "a camera as uint8 [T, H, W, 3]" + " in every demonstration" * whole
            faults[number] = DatasetError.at(f"{self.file}: data/{demo.name}/{self._folder}", expected, got)
        raise faults[numbers[0]] if whole else FaultsError.of(faults, numbers)

    def _shared(self, numbers: Sequence[int]) -> tuple[Sequence[str], Mapping[str, str]]:
        """The cameras that all these demonstrations share, and what is wrong with other pictures."""
        demos = [self._demos[number] for number in numbers]
        faults = {name: next(filter(None, (demo.fault(name) for demo in demos)), "") for name in self._pictures}
        cameras = tuple(name for name, fault in faults.items() if not fault)
        return cameras, {name: fault for name, fault in faults.items() if fault}

    def decoder(self, camera: str) -> None:
        """Frames are stored as pixels."""

    def identity(self, episode: DatasetEpisode, camera: str) -> str:
        return digest_of(frame.tobytes() for frame in self.stored_frames(episode, camera))

    def check(self, episode: DatasetEpisode, camera: str) -> None:
        with opened_hdf5(self.file) as opened:
            self._video(opened, episode, camera)

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        with opened_hdf5(self.file) as opened:
            video = self._video(opened, episode, camera)
            for start in range(self._skipped, len(video), _FRAMES_AT_A_TIME):
                try:
                    yield from video[start : start + _FRAMES_AT_A_TIME]
                except OSError as error:
                    raise DatasetError.at(self.place(episode, camera), "readable frames", error) from error

    def _video(self, opened: Any, episode: DatasetEpisode, camera: str) -> Any:
        video = opened.get(f"data/{episode.name}/{self._folder}/{camera}")
        num_pictures = episode.num_frames + self._skipped
        is_video = video is not None and not fault_of(video) and len(video) == num_pictures
        got = "none" if video is None else form_of(video)
        require(self.place(episode, camera), is_video, f"uint8 [{num_pictures}, H, W, 3]", got)
        return video

    def place(self, episode: DatasetEpisode, camera: str) -> str:
        return f"{self.file}: data/{episode.name}/{self._folder}/{camera}"


def _described(forms: Mapping[str, str]) -> str:
    return ", ".join(map(" ".join, forms.items())) or "none"


def _notes(uncorrected: Sequence[str], is_libero: bool) -> list[str]:
    if is_libero and uncorrected:
        why = "LIBERO stores its pictures upside down; --orient none leaves them"
        return [f"orient: {', '.join(uncorrected)} {_LIBERO} ({why})"]
    doubtful = [camera for camera in uncorrected if camera in _LIBERO_CAMERAS]
    if not doubtful:
        return []
    advice = f"look at a frame, and turn them with --orient {_LIBERO} if they are upside down"
    why = "as stored, but LIBERO, which names cameras so, stores them upside down"
    return [f"orient: {', '.join(doubtful)} {why}: {advice}"]
