# SPDX-License-Identifier: MIT
"""HDF5 files from robomimic and LIBERO (``data/demo_<i>/obs/<camera>``), IsaacLab-Arena, ALOHA, RoboTwin and others.

Needs ``rfm-labels[hdf5]``. Episodes are named ``demo_<i>`` in all layouts.

In robomimic and LIBERO files the task is the demonstration's own (``ep_meta``), else LIBERO's sentence
(``problem_info`` of ``data``), robomimic's (``env_args``), or the caller's. LIBERO stores pictures upside down: they
are turned, unless the caller says otherwise. robomimic's filter keys (``mask/train``) name some demonstrations.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from rfm_client import RewardError, UInt8Array
from rfm_client.frames import Orientation, Picture
from rfm_client.options import first_names
from rfm_labels.datasets.dataset import AskedCorrections, Dataset, DatasetEpisode, TaskOverride
from rfm_labels.datasets.faults import DatasetError, FaultsError, require
from rfm_labels.datasets.hdf5_layouts import (
    DOCUMENTS,
    ROBOMIMIC,
    ROBOTWIN,
    attribute,
    filter_keys,
    fps_of,
    instructions_of,
    is_of_libero,
    layout_of,
    opened_hdf5,
    own_task_of,
    task_in,
    task_of,
    task_places,
    unread,
    unread_documents,
)
from rfm_labels.datasets.hdf5_pictures import (
    EncodedFrames,
    fault_of,
    first_files,
    form_of,
    forms_in,
    has_rgb_mark,
    is_encoded,
    pictures_in,
)
from rfm_labels.datasets.stored_files import digest_of

SUFFIXES = (".hdf5", ".h5")

_FRAMES_AT_A_TIME = 64
_LIBERO: Orientation = "flip-vertical"  # as in upstream's training data and evaluation
_LIBERO_CAMERAS = ("agentview_rgb", "eye_in_hand_rgb")
_ACTIONS = "actions"


def is_hdf5(path: Path) -> bool:
    """True for an existing file with an HDF5 suffix."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def label_prefix(path: Path) -> str:
    """Return the prefix for a dataset's label file names: ``demos.`` for ``demos.hdf5``, else nothing."""
    return f"{path.stem}." if path.suffix.lower() in SUFFIXES else ""


class Hdf5Dataset(Dataset):
    """The demonstrations in one file.

    task: task from the caller
    corrections: corrections from the caller; without an orientation, LIBERO cameras are turned
    """

    kind = "HDF5"

    def __init__(
        self, file: Path, *, task: TaskOverride = TaskOverride(), corrections: AskedCorrections = AskedCorrections()
    ) -> None:
        self.file = file
        self.root = file.parent
        self.label_prefix = label_prefix(file)
        self.source = file.name
        self.given_task = task
        with opened_hdf5(file) as opened:
            self._layout = layout_of(opened)
            demos = self._layout.episodes(file, opened)
            self._demos = {index: name for index, (name, _) in demos.items()}
            self._pictures = pictures_in(demos, self._layout.are_pictures)
            self._forms = forms_in(demos)
            attributes = (opened["data"] if self._layout.is_in_data else opened).attrs
            self._tasks = {index: self._task_in(opened, demo, attributes) for index, (_, demo) in demos.items()}
            self.filter_keys, notes = filter_keys(opened, self._demos)
            self.cameras, self.left_out = self._shared(list(demos))
            self._lengths = {
                index: self._lengths_of(demo, self.cameras or self._cameras_of(index))
                for index, (_, demo) in demos.items()
            }
            self._broken = unread_documents(attributes)
            others = unread(opened, self._demos.values()) if self._layout.is_in_data else []
            notes = [*others, *notes, *_notes_on_samples(demos, self._lengths, self._layout.skipped)]
            notes += [
                f"data: {name} is not a JSON object, so it states neither a task nor LIBERO" for name in self._broken
            ]
            is_libero = self._layout is ROBOMIMIC and is_of_libero(attributes)
            self.fps = self._layout.fps or fps_of(attributes)
            self._firsts = first_files(demos, self._pictures, self._layout.are_pictures)
            is_upright = "opencv" in str(attribute(attributes, "macros_image_convention"))  # robosuite turned frames
        self.kind = "HDF5" if self._layout is ROBOMIMIC else f"HDF5 ({self._layout.name})"
        self.numbers = list(demos)
        known = [camera for camera in self._pictures if any(camera in self._cameras_of(each) for each in self.numbers)]
        if not known:
            self.cameras_in(self.numbers)  # raises the reason
        defaults: dict[str, Orientation] = dict.fromkeys(known, _LIBERO) if is_libero and not is_upright else {}
        is_robotwin = self._layout is ROBOTWIN
        unmarked = [camera for camera, file in self._firsts.items() if is_robotwin and not has_rgb_mark(file)]
        self.corrections = corrections.of_cameras(known, defaults, dict.fromkeys(unmarked, "bgr"))
        uncorrected = [camera for camera in known if {"", camera}.isdisjoint(corrections.orient)]
        self.notes = [*notes, *([] if is_upright else _notes(uncorrected, is_libero))]
        self.notes += self._notes_on_colours(corrections, unmarked) + self._notes_on_layout()

    def _task_in(self, opened: Any, demo: Any, attributes: Mapping[str, Any]) -> Any:
        return own_task_of(demo) or task_of(attributes) if self._layout.is_in_data else task_in(self.file, opened, demo)

    def _lengths_of(self, demo: Any, cameras: Sequence[str]) -> Mapping[str, int]:
        """Frame count per camera, and action count if present."""
        skipped = self._layout.skipped
        lengths = {f"obs/{camera}": len(demo["obs"][camera]) - skipped for camera in cameras}
        shape = getattr(demo.get(_ACTIONS), "shape", None) if lengths else None
        return lengths | ({_ACTIONS: shape[0] - skipped} if shape else {})

    def _notes_on_layout(self) -> list[str]:
        if self._layout is ROBOMIMIC:
            return []
        forms = [f"{camera}{' (JPEG or PNG)' * (camera in self._firsts)}" for camera in self.cameras]
        notes = [f"layout: {self._layout.name}, cameras {', '.join(forms)}"]
        if self._layout.skipped:
            notes.append(
                "left out: each first picture, which shows the end of the episode before; frame 0 is the second"
            )
        instructions = instructions_of(self.file) if self._layout is ROBOTWIN else []
        if instructions and self._tasks[0] == instructions[0] and self.given_task.text is None:
            notes.append(f"task: the first of {len(instructions)} sentences in instructions/{self.file.stem}.json")
        return notes

    def _notes_on_colours(self, asked: AskedCorrections, unmarked: Sequence[str]) -> list[str]:
        """A note on red and blue, for cameras without a channel order from the caller."""
        uncorrected = [camera for camera in self._firsts if {"", camera}.isdisjoint(asked.channels)]
        swapped = [camera for camera in uncorrected if camera in unmarked]
        if swapped:
            why = "RoboTwin's JPEG files without its mark of RGB, from before September 2026, store red as blue"
            return [f"channels: {', '.join(swapped)} bgr ({why}; --channels rgb leaves them)"]
        colours = self._layout.colours
        return [f"channels: {', '.join(uncorrected)} {colours}"] if uncorrected and colours else []

    def read_episode(self, number: int) -> DatasetEpisode:
        where = f"{self.file}: {self._layout.group_of(self._demos[number])}".removesuffix(": ")
        documents = " or ".join(name + " (no JSON object)" * (name in self._broken) for name in DOCUMENTS)
        places = f"ep_meta, or data: {documents}" if self._layout.is_in_data else task_places(self.file)
        task = self.given_task.of(f"{where}: {places}", self._tasks[number])
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
            got = got or f"{self._forms[number]}: {self._layout.without_pictures}"
            expected = "a camera as uint8 [T, H, W, 3]" + " in every demonstration" * whole
            where = f"{self.file}: {self._layout.cameras_at(self._demos[number])}"
            faults[number] = DatasetError.at(where, expected, got)
        raise faults[numbers[0]] if whole else FaultsError.of(faults, numbers)

    def _shared(self, numbers: Sequence[int]) -> tuple[Sequence[str], Mapping[str, str]]:
        """The cameras that all these demonstrations share, and what is wrong with other pictures."""
        chosen = {name: [faults[number] for number in numbers] for name, faults in self._pictures.items()}
        faults = {name: next(filter(None, of_demos), "") for name, of_demos in chosen.items()}
        cameras = tuple(name for name, fault in faults.items() if not fault)
        return cameras, {name: fault for name, fault in faults.items() if fault}

    def _cameras_of(self, number: int) -> list[str]:
        return [name for name, faults in self._pictures.items() if not faults[number]]

    def decoder(self, camera: str) -> str | None:
        return Picture.decoder() if camera in self._firsts else None

    def identity(self, episode: DatasetEpisode, camera: str) -> str:
        with opened_hdf5(self.file) as opened:
            encoded = self._encoded(self._video(opened, episode, camera), episode, camera)
            if encoded is not None:
                return digest_of(encoded.files())
        return digest_of(frame.tobytes() for frame in self.stored_frames(episode, camera))

    def check(self, episode: DatasetEpisode, camera: str) -> None:
        with opened_hdf5(self.file) as opened:
            if encoded := self._encoded(self._video(opened, episode, camera), episode, camera):
                encoded.check()

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        with opened_hdf5(self.file) as opened:
            video = self._video(opened, episode, camera)
            if encoded := self._encoded(video, episode, camera):
                yield from encoded.pixels()
                return
            for start in range(self._layout.skipped, len(video), _FRAMES_AT_A_TIME):
                try:
                    yield from video[start : start + _FRAMES_AT_A_TIME]
                except OSError as error:
                    raise DatasetError.at(self._where(episode, camera), "readable frames", error) from error

    def _encoded(self, video: Any, episode: DatasetEpisode, camera: str) -> EncodedFrames | None:
        """The frames as files; None: they are pixels."""
        if not is_encoded(video, self._layout.are_pictures):
            return None
        stored = video[self._layout.skipped :] if self._layout.skipped else video
        return EncodedFrames(stored, self._where(episode, camera))

    def _video(self, opened: Any, episode: DatasetEpisode, camera: str) -> Any:
        video = opened.get(self._layout.path_of(episode.name, camera))
        is_whole = video is not None and not fault_of(video, self._layout.are_pictures)
        num_pictures = episode.num_frames + self._layout.skipped
        is_video = is_whole and len(video) == num_pictures
        got = "none" if video is None else form_of(video)
        require(self._where(episode, camera), is_video, f"uint8 [{num_pictures}, H, W, 3]", got)
        return video

    def _where(self, episode: DatasetEpisode, camera: str) -> str:
        return f"{self.file}: {self._layout.path_of(episode.name, camera)}"


def _one_length(lengths: Mapping[str, int]) -> int:
    """The frame count, equal in all cameras; 0 if cameras differ or there are none.

    The action count must be the same, or one less if the last observation has no action; otherwise 0.
    """
    of_cameras = {length for key, length in lengths.items() if key != _ACTIONS}
    length = of_cameras.pop() if len(of_cameras) == 1 else 0
    return length if lengths.get(_ACTIONS, length) in (length, length - 1) else 0


def _notes_on_samples(
    demos: Mapping[int, tuple[str, Any]], lengths: Mapping[int, Mapping[str, int]], skipped: int
) -> list[str]:
    """Return a note on demonstrations whose ``num_samples`` contradicts their frames; empty if there are none."""
    differing = []
    for number, (name, demo) in demos.items():
        length = _one_length(lengths[number])
        count = attribute(demo.attrs, "num_samples") if length else None
        if count is not None and count - skipped not in lengths[number].values():
            differing.append(f"{name} ({count}, has {length})")
    every = "each observation gets a label"
    return [f"lengths: num_samples differs: {first_names(differing)}: {every}"] if differing else []


def _notes(uncorrected: Sequence[str], is_libero: bool) -> Sequence[str]:
    if is_libero and uncorrected:
        why = "LIBERO stores its pictures upside down; --orient none leaves them"
        return [f"orient: {', '.join(uncorrected)} {_LIBERO} ({why})"]
    doubtful = [camera for camera in uncorrected if camera in _LIBERO_CAMERAS]
    if not doubtful:
        return []
    advice = f"look at a frame, and turn them with --orient {_LIBERO} if they are upside down"
    why = "as stored, but LIBERO, which names cameras so, stores them upside down"
    return [f"orient: {', '.join(doubtful)} {why}: {advice}"]
