# SPDX-License-Identifier: MIT
"""Episodes as a reader yields them, and the dataset that they make up. T frames, H x W pixels.

A reader is a function that is called with the recordings' folder and yields an ``Episode`` for each recording.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from rfm_client import InvalidSampleError, RewardError, Trajectory, UInt8Array, load_trajectory
from rfm_client.frames import ARRAY_SUFFIXES, Picture, Video
from rfm_client.options import first_names
from rfm_labels.datasets.dataset import AskedCorrections, CountedDataset, DatasetEpisode, TaskOverride
from rfm_labels.datasets.faults import DatasetError, faults_of_reader, listed, require
from rfm_labels.datasets.pictures_in_order import pictures_in
from rfm_labels.datasets.stored_files import (
    Span,
    check_pictures,
    colours_fault,
    digest_of,
    faults_at,
    file_identity,
    picture_frames,
    turn_mark,
)

Frames: TypeAlias = UInt8Array | str | Path | Sequence[str | Path] | Callable[[], Iterable[UInt8Array]]

MAX_ARRAY_BYTES = 4 * 2**30  # for the arrays that a reader gives, which stay in memory
_FILES_AT_A_TIME = 8
_FORMS = "uint8 [T, H, W, 3], a path, paths of pictures, or a function that returns frames"


@dataclass(frozen=True, eq=False)
class Episode:
    """One recorded episode, for a reader to yield.

    name: another one for each episode
    frames: each camera's T frames, RGB. One of:
        an array, uint8 [T, H, W, 3];
        the path of a video, of an ``.npy`` or ``.npz`` file, or of a folder with a picture for each frame;
        the paths of T pictures, in order;
        a function that reads the frames when they are needed, and each time returns the array or yields T arrays,
        uint8 [H, W, 3]. It is called more than once, by several threads
    task: sentence; None: unknown (``--task``)
    fps: frames per second, at which the page plays the episode; None: unknown
    success: outcome; None: unknown

    Raises DatasetError.
    """

    name: str
    frames: Mapping[str, Frames]
    task: str | None = None
    fps: float | None = None
    success: bool | None = None

    def __post_init__(self) -> None:
        is_text = isinstance(self.name, str) and bool(self.name.strip())
        require("Episode: name", is_text, "a text", repr(self.name))
        where = f"Episode {self.name!r}"
        has_frames = isinstance(self.frames, Mapping) and bool(self.frames)
        got = "none" if isinstance(self.frames, Mapping) else type(self.frames).__name__
        require(f"{where}: frames", has_frames, 'a dict by camera, such as {"front": "front.mp4"}', got)
        for camera, frames in self.frames.items():
            require(f"{where}: frames", isinstance(camera, str) and bool(camera), "names of cameras", repr(camera))
            _check_form(f"{where}: frames[{camera!r}]", frames)
        require(f"{where}: task", self.task is None or isinstance(self.task, str), "a sentence", repr(self.task))
        is_rate = self.fps is None or (isinstance(self.fps, int | float) and 0 < self.fps < np.inf)
        require(f"{where}: fps", is_rate, "frames per second, above 0", repr(self.fps))
        is_outcome = self.success is None or isinstance(self.success, bool | np.bool_)
        require(f"{where}: success", is_outcome, "True, False or None", repr(self.success))


def _check_form(where: str, frames: Any) -> None:
    """Raise DatasetError unless the value is one of the forms that ``Episode`` lists."""
    if isinstance(frames, np.ndarray):
        fault = colours_fault(frames) or ("no frames" if not len(frames) else "")
        require(where, not fault, "uint8 [T, H, W, 3]", fault)
        return
    is_list = isinstance(frames, Sequence) and not isinstance(frames, str | bytes)
    are_paths = is_list and bool(frames) and all(isinstance(each, str | Path) for each in frames)
    got = type(frames).__name__
    if is_list:
        got += f" of {type(frames[0]).__name__}: np.stack them" if frames else ": no frames"
    elif isinstance(frames, Iterator):
        got += ": give the function itself, as functools.partial(read, file)"
    require(where, isinstance(frames, str | Path) or are_paths or callable(frames), _FORMS, got)


class _Stored(ABC):
    """One camera's frames in one episode. task: in the file"""

    task: str | None = None

    @property
    @abstractmethod
    def count(self) -> int:
        """The number of frames, above 0. Raises DatasetError, also for what else is wrong without decoding."""

    @abstractmethod
    def identity(self) -> str:
        """Return a text that identifies the frames, as in ``Dataset.identity``."""

    @abstractmethod
    def frames(self) -> Iterator[UInt8Array]:
        """Yield the frames, as ``Dataset.stored_frames``."""

    @staticmethod
    def decoder() -> str | None:
        """Return the decoding library; None: pixels, or the reader decodes."""
        return None

    def check(self) -> None:  # noqa: B027 - ``count`` checks most kinds
        """Check what ``count`` has not. Raises DatasetError."""


class _VideoFile(_Stored):
    decoder = staticmethod(Video.decoder)

    def __init__(self, file: Path, where: str, opened: Callable[[Path], Video]) -> None:
        self._file, self._where, self._opened = file, where, opened

    @cached_property
    def count(self) -> int:  # type: ignore[override]  # cached
        video = self._opened(self._file)
        video.check_is_one_episode()
        with faults_at(self._file):
            packets = video.packets
        expected = f"{packets.count} frames with time stamps"
        require(self._file, len(packets.times_s) == packets.count, expected, len(packets.times_s))
        require(self._file, packets.count > 0, "frames", "none")
        return packets.count

    def identity(self) -> str:
        return file_identity(self._file)

    def frames(self) -> Iterator[UInt8Array]:
        video = self._opened(self._file)
        with faults_at(self._file):
            times_s = video.packets.times_s
        gaps_s = times_s[1:] - times_s[:-1]
        tolerance_s = 0.5 * float(gaps_s.min()) if len(gaps_s) else 0.5
        return Span(video, times_s, tolerance_s, self._where).frames()


class _Pictures(_Stored):
    """A picture file for each frame. place: their folder, or their paths in order"""

    decoder = staticmethod(Picture.decoder)

    def __init__(self, place: Path | Sequence[Path]) -> None:
        self._place = place

    @cached_property
    def count(self) -> int:  # type: ignore[override]  # cached
        return len(self._files())

    def _files(self) -> Sequence[Path]:
        return pictures_in(self._place) if isinstance(self._place, Path) else self._place

    def identity(self) -> str:
        return digest_of(f"{file.name} {file_identity(file)}{turn_mark(file)}".encode() for file in self._files())

    def check(self) -> None:
        check_pictures(self._files())

    def frames(self) -> Iterator[UInt8Array]:
        return picture_frames(self._files())


class _ArrayFile(_Stored):
    """An ``.npy`` or ``.npz`` file, read whole to be checked: only all values show whether they are frames."""

    def __init__(self, file: Path) -> None:
        self._file = file

    @cached_property
    def count(self) -> int:  # type: ignore[override]  # cached
        trajectory = self._read()
        self.task = trajectory.task or None
        return trajectory.num_frames

    def identity(self) -> str:
        return file_identity(self._file)

    def frames(self) -> Iterator[UInt8Array]:
        return iter(self._read().positions)

    def _read(self) -> Trajectory:
        try:
            trajectory = load_trajectory(self._file)
        except InvalidSampleError as error:
            raise DatasetError(str(error), self._file) from error
        got = "embeddings: score them with rfm-client score"
        require(self._file, trajectory.frames is not None, "frames, uint8 [T, H, W, 3]", got)
        return trajectory


class _Pixels(_Stored):
    """An array, or a function that returns the frames, called once to count and identify them."""

    def __init__(self, given: UInt8Array | Callable[[], Iterable[UInt8Array]], where: str) -> None:
        self._given, self._where = given, where

    @cached_property
    def _facts(self) -> tuple[int, str]:
        counts = itertools.count()
        digest = digest_of(f"{next(counts)} {frame.shape} ".encode() + frame.tobytes() for frame in self.frames())
        count = next(counts)
        require(self._where, count > 0, "frames", "none")
        return count, digest

    @property
    def count(self) -> int:
        return self._facts[0]

    def identity(self) -> str:
        return self._facts[1]

    def frames(self) -> Iterator[UInt8Array]:
        with faults_of_reader(self._where):
            for t, frame in enumerate(self._given() if callable(self._given) else self._given):
                fault = colours_fault(frame[np.newaxis]) if isinstance(frame, np.ndarray) else type(frame).__name__
                require(f"{self._where}: frame {t}", not fault, "uint8 [H, W, 3]", fault)
                yield frame


def _stored(frames: Frames, where: str, opened: Callable[[Path], Video]) -> _Stored:
    """Return a reader of these frames. opened: opens a video, and keeps a few open"""
    if isinstance(frames, np.ndarray) or callable(frames):
        return _Pixels(frames, where)
    if not isinstance(frames, str | Path):
        return _Pictures([Path(each) for each in frames])
    file = Path(frames)
    if file.is_dir() or not (file.suffix or file.exists()):
        return _Pictures(file)
    return _ArrayFile(file) if file.suffix.lower() in ARRAY_SUFFIXES else _VideoFile(file, where, opened)


def _key(frames: Frames, place: str) -> object:
    """Return a key that two functions share if they read the same: a loop's variable has its last value in both."""
    if not hasattr(frames, "__code__"):
        return place
    bound = (*(frames.__defaults__ or ()), *(frames.__closure__ or ()))
    return frames.__code__, *map(id, bound)


class EpisodeDataset(CountedDataset):
    """The episodes that a reader yields.

    root: folder with the recordings
    where: what the tasks come from, for messages

    Raises DatasetError for a name twice, functions that several episodes share, and too large arrays.
    """

    def __init__(
        self,
        episodes: Iterable[Episode],
        root: Path,
        kind: str,
        where: object,
        task: TaskOverride,
        corrections: AskedCorrections,
    ) -> None:
        self.root, self.source, self.kind = root, root.resolve().name, kind
        self.given_task, self._where = task, where
        opened = lru_cache(_FILES_AT_A_TIME)(Video)
        self.given, self.stored = dict[str, Episode](), list[dict[str, _Stored]]()
        num_bytes, functions = 0, dict[object, str]()
        for episode in episodes:
            require(f"{where}: name", episode.name not in self.given, "each once", f"{episode.name!r} again")
            self.given[episode.name] = episode
            self.stored.append({})
            for camera, frames in episode.frames.items():
                place = f"{episode.name}: {camera}"
                num_bytes += frames.nbytes if isinstance(frames, np.ndarray) else 0
                got = "more, which stay in memory: give functions that read them, as functools.partial(read, file)"
                expected = f"arrays of at most {MAX_ARRAY_BYTES / 2**30:g} GiB in all episodes"
                require(f"{where}: {place}", num_bytes <= MAX_ARRAY_BYTES, expected, got)
                same = functions.setdefault(_key(frames, place), place)
                got = f"that of {same}: bind what differs, as functools.partial(read, file)"
                require(f"{where}: {place}", same == place, "a function of its own", got)
                self.stored[-1][camera] = _stored(frames, place, opened)
        require(where, bool(self.given), "at least one episode", "none")
        self.numbers = range(len(self.given))
        self._names = list(self.given)
        known = list(dict.fromkeys(camera for each in self.stored for camera in each))
        self.cameras, self.left_out = self._shared(self.numbers)
        self.corrections = corrections.of_cameras(known)
        self.fps = next((each.fps for each in self.given.values() if each.fps), None)

    def _shared(self, numbers: Sequence[int]) -> tuple[list[str], dict[str, str]]:
        """The cameras of all these episodes, and which episode lacks each other camera."""
        cameras = dict.fromkeys(camera for number in numbers for camera in self.stored[number])
        lacking = {
            camera: [self._names[number] for number in numbers if camera not in self.stored[number]]
            for camera in cameras
        }
        left_out = {camera: f"missing in {first_names(names, 1)}" for camera, names in lacking.items() if names}
        return [camera for camera in cameras if camera not in left_out], left_out

    def cameras_in(self, numbers: Sequence[int]) -> tuple[Sequence[str], Mapping[str, str]]:
        cameras, left_out = self._shared(numbers)
        if not cameras:
            having = {camera: [n for n in numbers if camera in self.stored[n]] for camera in left_out}
            best = max(having, key=lambda camera: len(having[camera]))
            got = f"{', '.join(f'{camera} in {len(those)}' for camera, those in having.items())}"
            expected = f"a camera that all {len(numbers)} episodes have"
            remedy = f"to continue with {best} alone: --episodes {listed(having[best])}"
            raise DatasetError.at(self._where, expected, f"{got}; {remedy}")
        return cameras, left_out

    def length(self, number: int) -> int:
        """The frame count of the first camera that can be read. Raises DatasetError."""
        faults = []
        for stored in self.stored[number].values():
            try:
                return stored.count
            except RewardError as fault:
                faults.append(fault)
        raise faults[0]

    def read_episode(self, number: int) -> DatasetEpisode:
        name, length = self._names[number], self.length(number)
        own = self.given[name].task or next(filter(None, (each.task for each in self.stored[number].values())), None)
        task = self.given_task.of(f"{self._where}: {name}", own)
        return DatasetEpisode(number, name, " ".join(task.split()), length, self.frames_before(number))

    def decoder(self, camera: str) -> str | None:
        kinds = {type(each[camera]) for each in self.stored if camera in each}
        return ", ".join(sorted(filter(None, (kind.decoder() for kind in kinds)))) or None

    def identity(self, episode: DatasetEpisode, camera: str) -> str:
        return self.stored[episode.index][camera].identity()

    def check(self, episode: DatasetEpisode, camera: str) -> None:
        stored = self.stored[episode.index][camera]
        got = f"{stored.count}: cut them alike, or leave the episode out (--episodes)"
        expected = f"{episode.num_frames} frames, as the other cameras"
        require(self.place(episode, camera), stored.count == episode.num_frames, expected, got)
        stored.check()

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        return self.stored[episode.index][camera].frames()
