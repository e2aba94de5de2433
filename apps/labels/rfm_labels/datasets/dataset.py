# SPDX-License-Identifier: MIT
"""Dataset interface: episodes with their tasks, camera frames on demand, and frame corrections.

T frames per episode, H x W pixels.
"""

from __future__ import annotations

import logging
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from rfm_client import RewardError, Trajectory, UInt8Array
from rfm_client.frames import ChannelOrder, Correction, Orientation
from rfm_client.options import ConfigError, is_blank
from rfm_labels.datasets.faults import DatasetError, FaultsError, MissingTaskError, UnusedTaskError, require
from rfm_labels.datasets.hub import DownloadSize
from rfm_labels.datasets.stored_files import Span, Times

LEAST_SIZE_PX = 8  # per side; a smaller numeric array is no picture
_WORDS = frozenset(
    {"depth", "depths", "disparity", "flow", "instance", "instances", "mask", "masks", "normal", "normals"}
    | {"panoptic", "seg", "segm", "segmentation", "segmentations", "segs", "semantic", "semantics"}
)
_BOUNDS = re.compile(r"[\W\d_]+|(?<=[a-z])(?=[A-Z])")  # separates the words in a name
_CAMERA_PREFIX = "observation.images."
SIGNALS_FOLDER = "reward_signals"  # label folder inside a dataset's folder
SeveralTasks: TypeAlias = Literal["each", "first"]
_CLOCKS_NS = 2 * 10**9  # what a file system's times may lag behind the clock

logger = logging.getLogger("rfm_client")


def word_of_no_colours(camera: str) -> str | None:
    """Return the first word in a camera name that indicates a picture without colours, or None.

    ``depth`` in ``agentview_depth``, ``seg`` in ``seg_instance_id``. Only whole words count: ``segway`` is a camera.
    """
    return next((word for word in map(str.lower, _BOUNDS.split(camera)) if word in _WORDS), None)


def camera_named(name: str, cameras: Sequence[str]) -> str | None:
    """Return the camera with this name, which may omit LeRobot's ``observation.images.``; None: there is none."""
    return next((known for known in cameras if known in (name, _CAMERA_PREFIX + name)), None)


def parsed_by_camera(option: str, texts: Iterable[str]) -> dict[str, Any]:
    """Parse correction values, such as ``rotate180``, or ``agentview_rgb=rotate180`` for one camera.

    The key "" holds the value for all other cameras. Raises ConfigError.
    """
    found: dict[str, Any] = {}
    for text in texts:
        camera, _, value = text.rpartition("=")
        if camera in found:
            raise ConfigError.at(option, "each camera once", f"{text!r} again")
        found[camera] = value
    for value in found.values():
        Correction(**{option: value})  # raises ConfigError
    return found


@dataclass(frozen=True)
class AskedCorrections:
    """Corrections that the caller asks for, by camera. The key "" holds the value for all other cameras."""

    orient: Mapping[str, Orientation] = field(default_factory=dict)
    channels: Mapping[str, ChannelOrder] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        orient: Orientation | Mapping[str, Orientation] | None,
        channels: ChannelOrder | Mapping[str, ChannelOrder] | None,
    ) -> AskedCorrections:
        """Accept a value for all cameras or by camera; None: not given. Raises DatasetError for an unknown value."""
        asked: dict[str, Any] = {}
        for option, given in (("orient", orient), ("channels", channels)):
            asked[option] = {"": given} if isinstance(given, str) else given or {}
            try:
                for value in asked[option].values():
                    Correction(**{option: value})
            except ConfigError as error:
                raise DatasetError.like(error) from None
        return cls(**asked)

    def of_cameras(
        self, cameras: Sequence[str], turns: Mapping[str, Orientation] | None = None
    ) -> Mapping[str, Correction]:
        """Return corrections by camera, for cameras whose frames change. Raises DatasetError for an unknown camera.

        turns: default orientations, unless the caller gives one
        """
        orient = {**(turns or {}), **_known("orient", self.orient, cameras)}
        channels = _known("channels", self.channels, cameras)
        found = {camera: Correction.of(camera, orient, channels) for camera in cameras}
        return {camera: correction for camera, correction in found.items() if correction != Correction()}


def _known(option: str, asked: Mapping[str, Any], cameras: Sequence[str]) -> dict[str, Any]:
    """Return the requested values by camera. Raises DatasetError for an unknown camera."""
    found = dict.fromkeys(cameras, asked[""]) if "" in asked else {}
    for name, value in asked.items():
        camera = camera_named(name, cameras)
        if camera is not None:
            found[camera] = value
        elif name:
            raise DatasetError.at(option, f"one of the cameras {', '.join(cameras)}", repr(name))
    return found


@dataclass(frozen=True)
class DatasetEpisode:
    """One episode in a dataset.

    index: number in the dataset
    name: name in the dataset
    task: for all frames, or for the first frame
    first_index: dataset-wide number of the first frame; the others follow
    tasks: (first frame, task) for each stretch of frames with one task; empty: one task for all frames
    """

    index: int
    name: str
    task: str
    num_frames: int
    first_index: int
    tasks: tuple[tuple[int, str], ...] = ()

    @property
    def own_name(self) -> str | None:
        """The name; None: it only repeats the number, as in LeRobot."""
        return None if self.name == f"episode {self.index}" else self.name

    @property
    def stretches(self) -> list[tuple[str, int]]:
        """Task and frame count for each stretch with one task, in order."""
        tasks = self.tasks or ((0, self.task),)
        ends = [*(first for first, _ in tasks[1:]), self.num_frames]
        return [(task, end - first) for (first, task), end in zip(tasks, ends, strict=True)]


@dataclass(frozen=True, eq=False)
class Motion:
    """What a robot did or was told to do.

    names: of the D dimensions
    values: float64 [T, D]
    """

    names: Sequence[str]
    values: npt.NDArray[np.float64]


@dataclass(frozen=True)
class TaskOverride:
    """The caller's task for episodes. Raises DatasetError for a blank text, or an override without a text.

    text: task for episodes without their own; None: not given
    overrides: True: use ``text`` for all episodes
    several: if an episode has several tasks: ``each``: frames keep their own; ``first``: all get the first frame's
    column: the column in a LeRobot dataset, or feature in an RLDS dataset, that names the tasks; None: the usual one
    is_needed: False: a missing task is empty, not an error
    """

    text: str | None = None
    overrides: bool = False
    several: SeveralTasks = "each"
    column: str | None = None
    is_needed: bool = True

    def __post_init__(self) -> None:
        has_text = not is_blank(self.text)
        got = "none" if self.text is None else repr(self.text)
        kinds = get_args(SeveralTasks)
        require("several_tasks", self.several in kinds, f"one of {', '.join(kinds)}", repr(self.several))
        require("task", has_text or (self.text is None and not self.overrides), "a sentence", got)
        is_read = self.column is None or not self.overrides
        require("task_column", is_read, "none with --override-task, which reads no tasks", self.column)

    def of(self, where: object, own: object) -> str:
        """Choose between the episode's task, ``own``, and the caller's. Raises DatasetError without a task."""
        if self.text is not None and (self.overrides or is_blank(own)):
            return self.text
        if isinstance(own, str) and not (self.is_needed and is_blank(own)):
            return own
        if not is_blank(own):
            got = f'{own!r}: correct it, or add --task "SENTENCE" --override-task'
            raise DatasetError.at(where, "a task as a sentence", got)
        if not self.is_needed:
            return ""
        got = "none" if not own else repr(own)
        raise MissingTaskError.at(where, "a task as a sentence", f'{got}: add --task "SENTENCE"')

    def check_used(self, episodes: Sequence[DatasetEpisode]) -> None:
        """Raise UnusedTaskError if a text is given but no episode uses it."""
        is_used = self.text is None or any(task == self.text for episode in episodes for task, _ in episode.stretches)
        if not is_used:
            got = f"{self.text!r}: leave it out, or put it in the place of theirs with --override-task"
            raise UnusedTaskError.at("task", "none for episodes that all have tasks of their own", got)


class Dataset(ABC):
    """Episodes on disk. Opening a dataset reads its tables, but no frames. ``open_dataset`` gives the caller's wishes.

    kind: layout, for example ``LeRobot v3.0``
    root: default folder for labels
    label_prefix: starts the label file names if the folder may hold other datasets
    source: Hub id, or folder or file name
    revision: commit on the Hub; None: local
    cameras: names, in the dataset's order
    depth_cameras: cameras that the dataset marks as depth, used only if named
    left_out: pictures that cannot be scored, with the reason; not in ``cameras``
    numbers: all episode numbers, in order
    filter_keys: episode numbers by filter key or split, such as ``train``
    fps: frames per second, for the page; None: unknown
    given_task: the caller's task
    corrections: how ``frames`` makes stored frames upright RGB, by camera; other cameras stay as stored
    notes: lines for the caller to read before scoring
    """

    kind: str
    root: Path
    label_prefix: str = ""
    source: str
    revision: str | None = None
    cameras: Sequence[str] = ()
    depth_cameras: Sequence[str] = ()
    left_out: Mapping[str, str] = {}
    numbers: Sequence[int] = ()
    filter_keys: Mapping[str, Sequence[int]] = {}
    fps: float | None = None
    given_task: TaskOverride = TaskOverride()
    corrections: Mapping[str, Correction] = {}
    notes: Sequence[str] = ()

    @cached_property
    def episodes(self) -> Sequence[DatasetEpisode]:
        """All episodes, by index. Raises DatasetError with every episode's faults."""
        episodes, faults = [], {}
        for number in self.numbers:
            try:
                episodes.append(self.episode(number))
            except RewardError as fault:
                faults[number] = fault
        if faults:
            raise FaultsError.of(faults, self.numbers)
        self.given_task.check_used(episodes)
        return episodes

    def episode(self, number: int) -> DatasetEpisode:
        """Return the episode with this number, from ``numbers``; cached after the first call. Raises DatasetError."""
        if number not in self._read:
            self._read[number] = self.read_episode(number)
        return self._read[number]

    @cached_property
    def _read(self) -> dict[int, DatasetEpisode]:
        return {}

    @abstractmethod
    def read_episode(self, number: int) -> DatasetEpisode:
        """Read and check an episode's tables. Faults in other episodes do not matter. Raises DatasetError."""

    def cameras_in(self, numbers: Sequence[int]) -> tuple[Sequence[str], Mapping[str, str]]:
        """Return ``cameras`` and ``left_out`` for these episodes only. Raises DatasetError if they share no camera."""
        return self.cameras, self.left_out

    def chosen_cameras(self, names: Iterable[str] = (), numbers: Sequence[int] | None = None) -> tuple[str, ...]:
        """Return the named cameras; without names, all but those in ``unused_cameras``.

        numbers: episodes that need the cameras; None: all

        A name may omit LeRobot's ``observation.images.``. Raises DatasetError for an unknown camera, or if no camera is
        named and all are in ``unused_cameras``.
        """
        cameras, left_out = self.cameras_in(self.numbers if numbers is None else numbers)
        some = f"some of {', '.join(cameras)}"
        chosen = []
        for name in names:
            camera = camera_named(name, cameras)
            if camera is None:
                reason = f", which is left out: {left_out[name]}" if name in left_out else ""
                raise DatasetError.at("cameras", some, f"{name!r}{reason}")
            chosen.append(camera)
        unused = self.unused_cameras(cameras)
        chosen = chosen or [camera for camera in cameras if camera not in unused]
        kinds = " and ".join(dict.fromkeys(unused.values()))
        require("cameras", bool(chosen or not cameras), f"{some} named: all are {kinds} cameras", "none")
        return tuple(chosen)

    def unused_cameras(self, cameras: Sequence[str]) -> Mapping[str, str]:
        """Return which cameras are used only if named, and what they show instead of colours, such as ``depth``.

        Either the dataset marks a depth camera, or a word in the camera's name says so.
        """
        named = {camera: word for camera in cameras if (word := word_of_no_colours(camera))}
        return named | {camera: "depth" for camera in cameras if camera in self.depth_cameras}

    def download(  # noqa: B027  a local dataset has all
        self, numbers: Sequence[int], cameras: Sequence[str], accept: Callable[[int, int], None] | None = None
    ) -> None:
        """Download what these episodes and cameras need and is not here yet. Raises DatasetError.

        accept: called before a download with its files and bytes; may raise an error
        """

    def missing(self, numbers: Sequence[int], cameras: Sequence[str]) -> DownloadSize | None:
        """Return what these episodes and cameras need from the Hub; None: all is here. Raises DatasetError."""
        return None

    def is_here(self, number: int) -> bool:
        """True if nothing of an episode must be downloaded first."""
        return True

    @property
    def listing(self) -> Sequence[DatasetEpisode]:
        """Like ``episodes``, but one that cannot be read has no frames, and a Hub dataset downloads no row table."""
        return [self.listed(number) for number in self.numbers]

    def listed(self, number: int) -> DatasetEpisode:
        """Return the episode as in ``listing``."""
        try:
            return self.episode(number)
        except RewardError:  # raised again if that episode is read
            return DatasetEpisode(number, self.name_of(number), "", 0, 0)

    def name_of(self, number: int) -> str:
        """Return an episode's name, also of one that cannot be read."""
        return f"episode {number}"

    def follow(self, reopen: Callable[[], Dataset], since_ns: int) -> Dataset:
        """Let ``as_now`` open the dataset again. Returns it.

        since_ns: when opening began; changes since then may have been missed
        """
        self._latest, self._reopen, self._fault = self, reopen, ""
        self._marks = [mark for mark in self._marks_now() if mark[1] < since_ns - _CLOCKS_NS]
        return self

    def as_now(self) -> Dataset:
        """Return the dataset that ``follow`` prepared, opened again if ``listed_in`` changed.

        If it cannot be opened, perhaps because a recorder writes to it, it stays as it was until it can.
        """
        marks = self._marks_now()
        if marks != self._marks:
            try:
                self._latest, self._marks = self._reopen(), marks
            except DatasetError as error:
                if str(error) != self._fault:
                    logger.warning("showing the dataset as it was: %s", error)
                self._fault = str(error)
        return self._latest

    def _marks_now(self) -> list[tuple[str, int, int]]:
        marks = []
        for file in self.listed_in():
            with suppress(FileNotFoundError):  # also of a file that was deleted since
                status = file.stat()
                marks.append((str(file), status.st_ctime_ns, status.st_size))
        return marks

    def listed_in(self) -> Iterable[Path]:
        """Yield the files and folders that change when the dataset gets other episodes or tasks."""
        for folder, folders, _ in os.walk(self.root):
            folders[:] = [name for name in folders if not name.startswith(".") and name != SIGNALS_FOLDER]
            yield Path(folder)

    def times_s(self, episode: DatasetEpisode) -> Times | None:
        """Return frame times from the episode's start, float64 [T]; None: unknown. Raises DatasetError."""
        return None

    def span(self, episode: DatasetEpisode, camera: str) -> Span | None:
        """Return the episode's frames in the camera's video; None: they are in no video. Raises DatasetError."""
        return None

    def motion(self, episode: DatasetEpisode) -> Mapping[str, Motion]:
        """Return the recorded ``action`` and ``state``, as far as the dataset has them. Raises DatasetError."""
        return {}

    def unused_files(self) -> Sequence[Path]:
        """Return files with rows or frames that no episode uses, relative to ``root``; empty for most layouts."""
        return []

    def doubt(self, episode: DatasetEpisode, camera: str) -> str:
        """Return what the episode's files say of frames that may be missing, without decoding; empty for nothing."""
        return ""

    @abstractmethod
    def decoder(self, camera: str) -> str | None:
        """Return the library that decodes the camera's frames, with its version; None: they are stored as pixels."""

    @abstractmethod
    def identity(self, episode: DatasetEpisode, camera: str) -> str:
        """Return a text that identifies the episode's stored frames. Raises DatasetError.

        For a video: size and modification time. For pictures in a table: their digest, because other programs also
        write tables.
        """

    @abstractmethod
    def check(self, episode: DatasetEpisode, camera: str) -> None:
        """Find every frame in the episode without decoding. Raises DatasetError for missing or contradictory data."""

    @abstractmethod
    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        """Yield the T frames in order, uint8 [H, W, 3], as stored, each decoded once. Raises DatasetError."""

    def place(self, episode: DatasetEpisode, camera: str) -> str:
        """Return where the episode's frames lie, for messages."""
        return f"{episode.name}: {camera}"

    def frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        """Yield the T ``whole_frames``, corrected to upright RGB."""
        correction = self.corrections.get(camera, Correction())
        return map(correction.applied, self.whole_frames(episode, camera))

    def whole_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        """Yield the T ``stored_frames``.

        Raises DatasetError, also for frames of different sizes, and in the end for a wrong count.
        """
        where, count, size = self.place(episode, camera), 0, ""
        for frame in self.stored_frames(episode, camera):
            own = f"{frame.shape[0]} x {frame.shape[1]} pixels"
            size = size or own
            require(f"{where}: frame {count}", own == size, f"a frame of {size}, as the first", own)
            count += 1
            if count <= episode.num_frames:
                yield frame
        require(where, count == episode.num_frames, f"{episode.num_frames} frames", count)


class CountedDataset(Dataset):
    """A dataset whose frames are numbered by the order of its episodes. Broken episodes count as empty."""

    @abstractmethod
    def length(self, number: int) -> int:
        """Return an episode's frame count. Raises DatasetError."""

    def frames_before(self, number: int) -> int:
        """Return how many frames the episodes before this one have."""
        place, counts = self.numbers.index(number), self._frames_before
        for before in self.numbers[len(counts) - 1 : place]:
            try:
                counts.append(counts[-1] + self.length(before))
            except RewardError:  # raised again if that episode is read
                counts.append(counts[-1])
        return counts[place]

    @cached_property
    def _frames_before(self) -> list[int]:
        return [0]


def iter_episodes(
    dataset: Dataset, cameras: Sequence[str] | None = None
) -> Iterator[tuple[DatasetEpisode, Mapping[str, Trajectory]]]:
    """Yield each episode with a trajectory per camera. Raises DatasetError.

    cameras: some of the dataset's; None: as ``Dataset.chosen_cameras`` without names

    Only one episode's frames are in memory at a time.
    """
    names = dataset.chosen_cameras(cameras or ())
    dataset.download(dataset.numbers, names)
    for episode in dataset.episodes:
        for camera in names:
            dataset.check(episode, camera)
        videos = {camera: np.stack(list(dataset.frames(episode, camera))) for camera in names}
        yield episode, {camera: Trajectory(frames=video, task=episode.task) for camera, video in videos.items()}
