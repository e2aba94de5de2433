# SPDX-License-Identifier: MIT
"""HDF5 files from robomimic and LIBERO (``data/demo_<i>/obs/<camera>``), IsaacLab-Arena, ALOHA, RoboTwin and others.

Needs ``rfm-labels[hdf5]``. Episodes are named ``demo_<i>`` in all layouts.

In robomimic and LIBERO files the task is the demonstration's own (``ep_meta``), else LIBERO's sentence
(``problem_info`` of ``data``), robomimic's (``env_args``), or the caller's. LIBERO stores pictures upside down: they
are turned, unless the caller says otherwise. robomimic's filter keys (``mask/train``) name some demonstrations.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from rfm_client import RewardError, UInt8Array
from rfm_client.frames import Orientation, Picture
from rfm_labels.datasets.dataset import AskedCorrections, CountedDataset, DatasetEpisode, TaskOverride
from rfm_labels.datasets.faults import DatasetError, FaultsError, require
from rfm_labels.datasets.hdf5_layouts import (
    ROBOMIMIC,
    ROBOTWIN,
    Layout,
    attribute,
    filter_keys,
    fps_of,
    instructions_of,
    is_of_libero,
    layout_of,
    opened_hdf5,
    task_of,
    task_places,
    unread_documents,
)
from rfm_labels.datasets.hdf5_pictures import (
    EncodedFrames,
    fault_of,
    first_file,
    form_of,
    has_rgb_mark,
    is_encoded,
    may_be_picture,
)
from rfm_labels.datasets.stored_files import digest_of

SUFFIXES = (".hdf5", ".h5")

_FRAMES_AT_A_TIME = 64
_LIBERO: Orientation = "flip-vertical"  # as in upstream's training data and evaluation
_LIBERO_CAMERAS = ("agentview_rgb", "eye_in_hand_rgb")


@dataclass(frozen=True)
class _Demo:
    """What a file holds of one episode.

    missing: why it lacks other observations
    forms: type and shape by observation
    faults: by observation, why it is no camera's frames; empty: it is
    pictures: observations that may be pictures
    lengths: frame count by camera
    marks: by camera whose frames are files, whether the first has RoboTwin's mark of RGB
    num_actions: None: not in the file
    """

    name: str
    task: Any
    missing: str
    forms: Mapping[str, str]
    faults: Mapping[str, str]
    pictures: Sequence[str]
    lengths: Mapping[str, int]
    marks: Mapping[str, bool]
    num_actions: int | None

    @classmethod
    def read(cls, name: str, group: Any, task: Any, layout: Layout) -> _Demo:
        observations = layout.observations(group)
        are_pictures, skipped = layout.are_pictures, layout.skipped
        faults = {
            each: f"{name} has a broken link or no array" if value is None else fault_of(value, are_pictures)
            for each, value in observations.items()
        }
        cameras = {each: observations[each] for each, fault in faults.items() if not fault}
        actions = getattr(group.get(layout.actions) if cameras and layout.actions else None, "shape", None)
        return cls(
            name,
            task,
            f"{name} is a broken link" if group is None else f"missing in {name}",
            {each: form_of(value) for each, value in observations.items()},
            faults,
            [each for each, value in observations.items() if may_be_picture(value, are_pictures)],
            {each: len(value) - skipped for each, value in cameras.items()},
            {
                each: has_rgb_mark(first_file(value))
                for each, value in cameras.items()
                if is_encoded(value, are_pictures)
            },
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
            self._layout = layout = layout_of(opened)
            groups = layout.episodes(file, opened)
            attributes = (opened["data"] if layout.is_in_data else opened).attrs
            self._demos = {
                number: _Demo.read(name, group, task_of(file, opened, group, layout), layout)
                for number, (name, group) in groups.items()
            }
            self.filter_keys = filter_keys(opened)
            self._broken = unread_documents(attributes)
            is_libero = layout is ROBOMIMIC and is_of_libero(attributes)
            self.fps = layout.fps or fps_of(attributes)
            is_upright = "opencv" in str(attribute(attributes, "macros_image_convention"))  # robosuite turned frames
        self.kind = "HDF5" if layout is ROBOMIMIC else f"HDF5 ({layout.name})"
        self.numbers = list(self._demos)
        self._pictures = list(dict.fromkeys(each for demo in self._demos.values() for each in demo.pictures))
        self.cameras, self.left_out = self._shared(self.numbers)
        known = [each for each in self._pictures if any(each in demo.lengths for demo in self._demos.values())]
        if not known:
            self.cameras_in(self.numbers)  # raises the reason
        self._marks = {camera: mark for demo in self._demos.values() for camera, mark in demo.marks.items()}
        unmarked = [camera for camera, mark in self._marks.items() if layout is ROBOTWIN and not mark]
        defaults: dict[str, Orientation] = dict.fromkeys(known, _LIBERO) if is_libero and not is_upright else {}
        self.corrections = corrections.of_cameras(known, defaults, dict.fromkeys(unmarked, "bgr"))
        uncorrected = [camera for camera in known if {"", camera}.isdisjoint(corrections.orient)]
        why = "is not a JSON object, so it states neither a task nor LIBERO"
        self.notes = [f"data: {name} {why}" for name in self._broken]
        self.notes += [] if is_upright else _notes(uncorrected, is_libero)
        self.notes += self._notes_on_colours(corrections, unmarked) + self._notes_on_layout()

    def _notes_on_layout(self) -> list[str]:
        if self._layout is ROBOMIMIC:
            return []
        forms = [f"{camera}{' (JPEG or PNG)' * (camera in self._marks)}" for camera in self.cameras]
        notes = [f"layout: {self._layout.name}, cameras {', '.join(forms)}"]
        if self._layout.skipped:
            notes.append(
                "left out: each first picture, which shows the end of the episode before; frame 0 is the second"
            )
        instructions = instructions_of(self.file) if self._layout is ROBOTWIN else []
        if instructions and self._demos[0].task == instructions[0] and self.given_task.text is None:
            notes.append(f"task: the first of {len(instructions)} sentences in instructions/{self.file.stem}.json")
        return notes

    def _notes_on_colours(self, asked: AskedCorrections, unmarked: Sequence[str]) -> list[str]:
        """A note on red and blue, for cameras without a channel order from the caller."""
        uncorrected = [camera for camera in self._marks if {"", camera}.isdisjoint(asked.channels)]
        swapped = [camera for camera in uncorrected if camera in unmarked]
        if swapped:
            why = "RoboTwin's JPEG files without its mark of RGB, from before September 2026, store red as blue"
            return [f"channels: {', '.join(swapped)} bgr ({why}; --channels rgb leaves them)"]
        colours = self._layout.colours
        return [f"channels: {', '.join(uncorrected)} {colours}"] if uncorrected and colours else []

    def length(self, number: int) -> int:
        return self._demos[number].num_frames(self.cameras)

    def read_episode(self, number: int) -> DatasetEpisode:
        demo = self._demos[number]
        where = f"{self.file}: {self._layout.group_of(demo.name)}".removesuffix(": ")
        task = self.given_task.of(f"{where}: {task_places(self.file, self._layout, self._broken)}", demo.task)
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
            got = got or f"{_described(demo.forms)}: {self._layout.without_pictures}"
            expected = "a camera as uint8 [T, H, W, 3]" + " in every demonstration" * whole
            faults[number] = DatasetError.at(f"{self.file}: {self._layout.cameras_at(demo.name)}", expected, got)
        raise faults[numbers[0]] if whole else FaultsError.of(faults, numbers)

    def _shared(self, numbers: Sequence[int]) -> tuple[Sequence[str], Mapping[str, str]]:
        """The cameras that all these demonstrations share, and what is wrong with other pictures."""
        demos = [self._demos[number] for number in numbers]
        faults = {name: next(filter(None, (demo.fault(name) for demo in demos)), "") for name in self._pictures}
        cameras = tuple(name for name, fault in faults.items() if not fault)
        return cameras, {name: fault for name, fault in faults.items() if fault}

    def decoder(self, camera: str) -> str | None:
        return Picture.decoder() if camera in self._marks else None

    def identity(self, episode: DatasetEpisode, camera: str) -> str:
        with opened_hdf5(self.file) as opened:
            if encoded := self._encoded(self._video(opened, episode, camera), episode, camera):
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
                    raise DatasetError.at(self.place(episode, camera), "readable frames", error) from error

    def _encoded(self, video: Any, episode: DatasetEpisode, camera: str) -> EncodedFrames | None:
        """The frames as files; None: they are pixels."""
        if not is_encoded(video, self._layout.are_pictures):
            return None
        stored = video[self._layout.skipped :] if self._layout.skipped else video
        return EncodedFrames(stored, self.place(episode, camera))

    def _video(self, opened: Any, episode: DatasetEpisode, camera: str) -> Any:
        video = opened.get(self._layout.path_of(episode.name, camera))
        is_whole = video is not None and not fault_of(video, self._layout.are_pictures)
        num_pictures = episode.num_frames + self._layout.skipped
        is_video = is_whole and len(video) == num_pictures
        got = "none" if video is None else form_of(video)
        require(self.place(episode, camera), is_video, f"uint8 [{num_pictures}, H, W, 3]", got)
        return video

    def place(self, episode: DatasetEpisode, camera: str) -> str:
        return f"{self.file}: {self._layout.path_of(episode.name, camera)}"


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
