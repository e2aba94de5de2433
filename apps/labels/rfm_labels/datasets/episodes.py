# SPDX-License-Identifier: MIT
"""Episodes as a reader yields them, and the dataset that they make up. T frames, H x W pixels.

A reader is a function that is called with the recordings' folder and yields an ``Episode`` for each recording.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from types import CellType, FunctionType
from typing import Any, TypeAlias

import numpy as np

from rfm_client import UInt8Array
from rfm_client.frames import Picture, Video
from rfm_labels.datasets.dataset import AskedCorrections, DatasetEpisode, TaskOverride
from rfm_labels.datasets.faults import faults_of_reader, require
from rfm_labels.datasets.pictures_in_order import missing_numbers, pictures_in
from rfm_labels.datasets.recorded import Recorded, RecordedDataset, Stored
from rfm_labels.datasets.stored_files import (
    Span,
    Times,
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
_BY_FUNCTION = "give a function for each, with what differs in its arguments: functools.partial(read, file)"
_FORMS = "uint8 [T, H, W, 3], a path, paths of pictures, or a function that returns frames"


@dataclass(frozen=True, eq=False)
class Episode:
    """One recorded episode, for a reader to yield.

    name: another one for each episode
    frames: each camera's T frames, RGB. One of:
        an array, uint8 [T, H, W, 3];
        the path of a video, or of a folder with a picture for each frame;
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
        is_outcome = self.success is None or isinstance(self.success, bool)
        require(f"{where}: success", is_outcome, "True, False or None (bool(...) of NumPy's)", repr(self.success))


def _check_form(where: str, frames: Any) -> None:
    """Raise DatasetError unless the value is one of the forms that ``Episode`` lists."""
    if isinstance(frames, np.ndarray):
        fault = colours_fault(frames) or ("no frames" if not len(frames) else "")
        require(where, not fault, "uint8 [T, H, W, 3]", fault)
        return
    are_paths = isinstance(frames, Sequence) and bool(frames) and all(isinstance(each, str | Path) for each in frames)
    got = f"{type(frames).__name__}: np.stack a list of arrays, and give a function itself, not what it returns"
    require(where, are_paths or isinstance(frames, Path) or callable(frames), _FORMS, got)


class _VideoFile(Stored):
    decoder = staticmethod(Video.decoder)

    def __init__(self, file: Path, where: str, opened: Callable[[Path], Video]) -> None:
        self._file, self._where, self._opened = file, where, opened

    @cached_property
    def count(self) -> int:
        video = self._opened(self._file)
        video.check_is_one_episode()
        with faults_at(self._file):
            packets = video.packets
        num_timed, expected = len(packets.times_s), f"{packets.count or 'some'} frames with time stamps"
        require(self._file, num_timed == packets.count > 0, expected, num_timed)
        return packets.count

    @property
    def times_s(self) -> Times:
        with faults_at(self._file):
            times_s: Times = self._opened(self._file).packets.times_s
        return times_s - float(times_s[0])

    def identity(self) -> str:
        return file_identity(self._file)

    def span(self) -> Span:
        video = self._opened(self._file)
        with faults_at(self._file):
            times_s = video.packets.times_s
        gaps_s = times_s[1:] - times_s[:-1]
        return Span(video, times_s, 0.5 * float(gaps_s.min()) if len(gaps_s) else 0.5, self._where)

    def frames(self) -> Iterator[UInt8Array]:
        return self.span().frames()


class _Pictures(Stored):
    """A picture file for each frame. place: their folder, or their paths in order"""

    decoder = staticmethod(Picture.decoder)

    def __init__(self, place: Path | Sequence[Path]) -> None:
        self._place = place

    @cached_property
    def count(self) -> int:
        return len(self._files())

    def _files(self) -> Sequence[Path]:
        return pictures_in(self._place) if isinstance(self._place, Path) else self._place

    def identity(self) -> str:
        of_files = ((file.name, file_identity(file, what="picture") + turn_mark(file)) for file in self._files())
        return digest_of(" ".join(each).encode() for each in of_files)

    def doubt(self) -> str:
        return missing_numbers([file.name for file in self._files()])

    def check(self) -> None:
        check_pictures(self._files())

    def frames(self) -> Iterator[UInt8Array]:
        return picture_frames(self._files())


class _Pixels(Stored):
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
                yield frame.copy() if callable(self._given) else frame  # a function may fill the same array again


def _stored(frames: Frames, where: str, opened: Callable[[Path], Video]) -> Stored:
    """Return a reader of these frames. opened: opens a video, and keeps a few open"""
    if isinstance(frames, np.ndarray) or callable(frames):
        return _Pixels(frames, where)
    if not isinstance(frames, str | Path):
        return _Pictures([Path(each) for each in frames])
    file = Path(frames)
    is_folder = file.is_dir() or not (file.suffix or file.exists())
    return _Pictures(file) if is_folder else _VideoFile(file, where, opened)


def _key(frames: Frames, place: str) -> object:
    """Return a key that two functions share if they read the same: a loop's variable has its last value in both."""
    if not isinstance(frames, FunctionType):
        return place
    bound = (*(frames.__defaults__ or ()), *(frames.__kwdefaults__ or {}).values(), *(frames.__closure__ or ()))
    return frames.__code__, *map(id, bound)


def _variables(frames: Frames) -> list[tuple[CellType, object]]:
    """Return the variables around a function, with their values now: a loop may change them."""
    function = frames.func if isinstance(frames, functools.partial) else frames
    cells = function.__closure__ if isinstance(function, FunctionType) else None
    return [(cell, cell.cell_contents) for cell in cells or ()]


class EpisodeDataset(RecordedDataset):
    """The episodes that a reader yields.

    root: folder with the recordings
    where: the table of tasks, the folder that may get one, or the reader's name, for messages

    Raises DatasetError for a name twice, functions that several episodes share, and too large arrays.
    """

    def __init__(
        self,
        episodes: Iterable[Episode],
        root: Path,
        kind: str,
        where: Path | str,
        task: TaskOverride,
        corrections: AskedCorrections,
        notes: Sequence[str] = (),
    ) -> None:
        self.root, self.source, self.kind, self.given_task, self.notes = root, root.resolve().name, kind, task, notes
        self._where = where
        opened, names, recorded = lru_cache(_FILES_AT_A_TIME)(Video), set[str](), dict[int, Recorded]()
        num_bytes, functions, rates = 0, dict[object, str](), list[float | None]()
        variables: list[tuple[str, CellType, object]] = []
        for number, episode in enumerate(episodes):
            place, cameras = f"{where}: {episode.name}", dict[str, Stored]()
            require(f"{where}: name", episode.name not in names, "each once", f"{episode.name!r} again")
            names.add(episode.name)
            rates.append(episode.fps)
            for camera, frames in episode.frames.items():
                num_bytes += 0 if isinstance(frames, np.memmap) else getattr(frames, "nbytes", 0)
                expected = f"arrays of at most {MAX_ARRAY_BYTES / 2**30:g} GiB in all episodes"
                require(f"{place}: {camera}", num_bytes <= MAX_ARRAY_BYTES, expected, f"more: {_BY_FUNCTION}")
                own = f"{episode.name}: {camera}"
                same = functions.setdefault(_key(frames, own), own)
                require(f"{place}: {camera}", same == own, "a function of its own", f"that of {same}: {_BY_FUNCTION}")
                cameras[camera] = _stored(frames, own, opened)
                variables += [(f"{place}: {camera}", *each) for each in _variables(frames)]
            missing = f"missing in {episode.name}"
            recorded[number] = Recorded(episode.name, place, episode.task, place, cameras, missing)
        for camera_place, cell, value in variables:
            expected = "a function whose variables keep their values"
            require(camera_place, cell.cell_contents is value, expected, f"one that changed later: {_BY_FUNCTION}")
        require(where, bool(recorded), "at least one episode", "none")
        self.corrections = corrections.of_cameras(self.set_recorded(recorded))
        self.numbers = range(len(recorded))  # finds a number at once
        self.fps = next(filter(None, rates), None)

    def read_episode(self, number: int) -> DatasetEpisode:
        episode = super().read_episode(number)
        return replace(episode, task=" ".join(episode.task.split()))

    def listed_in(self) -> Iterable[Path]:
        table = [self._where] if isinstance(self._where, Path) else []
        return [*super().listed_in(), *table]
