# SPDX-License-Identifier: MIT
"""A folder with one video, array file, picture folder (2.png before 10.png) or recording per episode.

A table of tasks (see ``opening``) orders the episodes. Without a table, the caller names the task, and episodes sort by
name, with 2 before 10. Videos need PyAV, pictures Pillow.

The numbers in file names order an episode's pictures: counts or times (``-1``, ``0.25``, ``2e-05``). In a file name
pattern, ``*`` stands for a number: ``*_color_0.jpg``.
"""

from __future__ import annotations

import itertools
import json
import re
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from rfm_client import InvalidSampleError, Trajectory, UInt8Array, load_trajectory
from rfm_client.frames import Picture, Video
from rfm_labels.datasets.dataset import AskedCorrections, CountedDataset, DatasetEpisode, TaskOverride
from rfm_labels.datasets.faults import DatasetError, require
from rfm_labels.datasets.stored_files import (
    Span,
    check_pictures,
    digest_of,
    faults_at,
    file_identity,
    picture_frames,
    turn_mark,
)

_NOT_IN_A_WORD = r"(?<![^\W_])"  # after a letter or digit, - and . are separators: frame-1.png, frame.1.png, 2026-11-26
_NUMBER = re.compile(
    rf"((?:{_NOT_IN_A_WORD}-)?"
    rf"(?:(?<!\d\.)\d+\.\d+(?!\.?\d)|{_NOT_IN_A_WORD}\.\d+|\d+)"  # 1.2.10 has no decimals
    r"(?:[eE][+-]\d+(?![^\W_]))?)"
)
_LETTERS = 2  # minimum word length before a camera number; a time may contain one letter, as in 20261126T123000
_EXAMPLES = 3  # kinds of names in a message
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
_FILES_AT_A_TIME = 4
_LEAVE_OUT = "leave it out (--episodes)"
_UNITREE_FILE, _UNITREE_FOLDER = "data.json", "colors"


def is_pattern(path: Path) -> bool:
    """True if the last path component is a file name pattern, and no name of a file or folder that is there."""
    return "*" in path.name and not path.exists()


def matching(pattern: str, files: Sequence[str]) -> list[str]:
    """Return the file names that match a pattern."""
    name = re.compile(_NUMBER.pattern.join(map(re.escape, pattern.split("*"))))
    return list(filter(name.fullmatch, files))


@dataclass(frozen=True)
class _Name:
    """A file name split into text and numbers. words: the texts around the numbers, then the format."""

    file: str
    words: tuple[str, ...]
    digits: tuple[str, ...]
    numbers: tuple[Decimal, ...]

    @classmethod
    def of(cls, file: str) -> _Name:
        parts = _NUMBER.split(Path(file).stem)
        digits = tuple(parts[1::2])
        form = Path(file).suffix.lower().replace("jpeg", "jpg")
        return cls(file, (*parts[::2], form), digits, tuple(map(Decimal, digits)))

    def kind(self, place: int | None) -> str:
        """The name with ``*`` for all numbers but the one at ``place``."""
        shown = ["*" if number != place else digits for number, digits in enumerate(self.digits)]
        parts = [self.words[0], *(part for pair in zip(shown, self.words[1:-1], strict=True) for part in pair)]
        return "".join(parts) + Path(self.file).suffix


def in_order_of_numbers(folder: Path, files: Sequence[str]) -> list[str]:
    """Sort an episode's file names by their numbers.

    Raises DatasetError for a repeated number, or different kinds of names, such as from several cameras.
    """
    names = sorted(map(_Name.of, files), key=lambda name: (name.numbers, name.file))
    if len({name.words for name in names}) > 1:
        raise _several_kinds(folder, names, None)
    for before, name in itertools.pairwise(names):
        got = f"{before.file} and {name.file}: leave the episode out (--episodes)"
        require(folder, before.numbers != name.numbers, "each number once", got)
    places = range(len(names[0].numbers)) if names else ()
    num_cameras = {place: _num_cameras(names, place) for place in places}
    of_cameras = [place for place in places if num_cameras[place]]
    if of_cameras:
        raise _several_kinds(folder, names, min(of_cameras, key=lambda place: num_cameras[place]))
    return [name.file for name in names]


def _num_cameras(names: Sequence[_Name], place: int) -> int:
    """How many cameras the numbers at a place count; 0 if they count frames.

    All cameras have the same frames, so names repeat once the camera number is removed. Times such as ``12_500`` (s,
    ms) may repeat by chance, so either all names must repeat, or the number must belong to a word, as in ``cam1_0001``.
    """
    others = Counter(name.numbers[:place] + name.numbers[place + 1 :] for name in names)
    values = {name.numbers[place] for name in names}
    word = names[0].words[place][-_LETTERS:]
    is_in_word = len(word) == _LETTERS and word.isalpha()
    repeats = 1 < len(others) < len(names)
    return len(values) if repeats and (is_in_word or len(others) * len(values) == len(names)) else 0


def _several_kinds(folder: Path, names: Sequence[_Name], place: int | None) -> DatasetError:
    """The error for several kinds of names."""
    kinds: Mapping[str, int] = Counter(name.kind(place) for name in names)
    shortest = sorted(kinds, key=lambda kind: (len(kind), kind))
    examples = " and ".join(f"{kind} ({kinds[kind]})" for kind in shortest[:_EXAMPLES])
    if max(kinds.values()) == 1:
        remedy = "copy them to a folder of their own, as 0.png and 1.png"
        return DatasetError.at(folder, "names that differ in a number", f"{examples}: {remedy}")
    got = f"{examples}: list those of one camera in tasks.csv, as {folder.name}/{shortest[0]}"
    return DatasetError.at(folder, "pictures of one camera, whose names differ in a number", got)


def in_natural_order(names: Iterable[str]) -> list[str]:
    """Sort episode names, comparing numbers as integers: ``2`` before ``10``, ``1.2`` before ``1.10``.

    ``in_order_of_numbers`` sorts frames, whose numbers may be times.
    """

    def key(name: str) -> tuple[list[tuple[int, str]], str]:
        parts = re.split(r"(\d+)", name)
        return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], name

    return sorted(names, key=key)


class EpisodeFiles(CountedDataset):
    """Episodes that are separate files or folders.

    root: folder to which the names are relative
    tasks: task by episode name; None: no task
    table: task table, or the folder, for messages
    """

    def __init__(
        self,
        root: Path,
        tasks: Mapping[str, str | None],
        table: Path,
        task: TaskOverride,
        corrections: AskedCorrections,
    ) -> None:
        self.root = root
        self.source = root.resolve().name
        self.numbers = range(len(tasks))
        self.given_task = task
        self._tasks, self._table, self._names = tasks, table, list(tasks)
        self._facts = lru_cache(None)(self.facts)
        self.corrections = corrections.of_cameras(self.cameras)

    @abstractmethod
    def facts(self, file: Path) -> tuple[int, str | None]:
        """Return an episode's frame count, and the task in its file or None. Raises DatasetError."""

    def length(self, number: int) -> int:
        file = self.root / self._names[number]
        num_frames, _ = self._facts(file)
        require(file, num_frames > 0, "frames", "none")
        return num_frames

    def read_episode(self, number: int) -> DatasetEpisode:
        name, length = self._names[number], self.length(number)
        own = self._tasks[name] or self._facts(self.root / name)[1]
        task = self.given_task.of(f"{self._table}: {name}", own)
        return DatasetEpisode(number, name, " ".join(task.split()), length, self.frames_before(number))

    def identity(self, episode: DatasetEpisode, camera: str) -> str:
        return file_identity(self.root / episode.name)

    def check(self, episode: DatasetEpisode, camera: str) -> None:
        """Check nothing more: ``facts`` has found all frames."""


class VideoFolder(EpisodeFiles):
    """Episodes stored as one video file each."""

    kind = "videos"
    cameras = ("video",)

    def facts(self, file: Path) -> tuple[int, str | None]:
        video = self._video(file)
        video.check_is_one_episode()
        with faults_at(file):
            packets = video.packets
        expected = f"{packets.count} frames with time stamps"
        require(file, len(packets.times_s) == packets.count, expected, len(packets.times_s))
        return packets.count, None

    @cached_property
    def _video(self) -> Callable[[Path], Video]:
        return lru_cache(_FILES_AT_A_TIME)(Video)

    def decoder(self, camera: str) -> str | None:
        return Video.decoder()

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        file = self.root / episode.name
        video = self._video(file)
        with faults_at(file):
            times_s = video.packets.times_s
        gaps_s = times_s[1:] - times_s[:-1]
        tolerance_s = 0.5 * float(gaps_s.min()) if len(gaps_s) else 0.5
        return Span(video, times_s, tolerance_s, episode.name).frames()


class ArrayFiles(EpisodeFiles):
    """Episodes stored as array files. A ``.npz`` file may hold the task."""

    kind = "arrays"
    cameras = ("frames",)

    def facts(self, file: Path) -> tuple[int, str | None]:
        """Read the whole file: only the complete values show whether they are frames."""
        trajectory = _read(file)
        return trajectory.num_frames, trajectory.task or None

    def decoder(self, camera: str) -> str | None:
        return None

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        return iter(_read(self.root / episode.name).positions)


def _read(file: Path) -> Trajectory:
    """Read the frames and the task from a file. Raises DatasetError, also for embeddings."""
    try:
        trajectory = load_trajectory(file)
    except InvalidSampleError as error:
        raise DatasetError(str(error), file) from error
    got = "embeddings: score them with rfm-client score"
    require(file, trajectory.frames is not None, "frames, uint8 [T, H, W, 3]", got)
    return trajectory


class FrameFolders(EpisodeFiles):
    """Episodes stored as picture folders, or as matching files in a folder (``is_pattern``)."""

    kind = "folders of frames"
    cameras: Sequence[str] = ("frames",)

    def facts(self, file: Path) -> tuple[int, str | None]:
        return len(_pictures_in(file)), None

    def files(self, place: Path, camera: str) -> Sequence[Path]:
        """Return an episode's frames, in order. Raises DatasetError."""
        return _pictures_in(place)

    def decoder(self, camera: str) -> str | None:
        return Picture.decoder()

    def identity(self, episode: DatasetEpisode, camera: str) -> str:
        files = self.files(self.root / episode.name, camera)
        return digest_of(f"{file.name} {file_identity(file)}{turn_mark(file)}".encode() for file in files)

    def check(self, episode: DatasetEpisode, camera: str) -> None:
        check_pictures(self.files(self.root / episode.name, camera))

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        return picture_frames(self.files(self.root / episode.name, camera))


def is_of_unitree(folder: Path) -> bool:
    """True for an episode from Unitree's xr_teleoperate."""
    return (folder / _UNITREE_FILE).is_file() and (folder / _UNITREE_FOLDER).is_dir()


class UnitreeFolders(FrameFolders):
    """Episodes from Unitree's xr_teleoperate: ``data.json`` has the task and, per frame, a picture per camera."""

    kind = "Unitree"

    def __init__(self, root: Path, tasks: Mapping[str, str | None], *more: Any) -> None:
        self._recording = lru_cache(None)(_recording)
        for name in tasks:
            with suppress(DatasetError):  # raised again if this episode is read
                self.cameras = list(self._recording(root / name)[1])
                break
        super().__init__(root, tasks, *more)

    def facts(self, file: Path) -> tuple[int, str | None]:
        return len(self.files(file, self.cameras[0])), self._recording(file)[0]

    def files(self, place: Path, camera: str) -> Sequence[Path]:
        cameras = self._recording(place)[1]
        got = ", ".join(cameras) or "none"
        require(place / _UNITREE_FILE, camera in cameras, f"pictures of {camera}", f"{got}: {_LEAVE_OUT}")
        return cameras[camera]


def _recording(folder: Path) -> tuple[str | None, Mapping[str, Sequence[Path]]]:
    """The task and each camera's pictures. Raises DatasetError, also if a frame lacks one of the cameras."""
    file = folder / _UNITREE_FILE
    try:
        content = json.loads(file.read_bytes())
        frames = [frame[_UNITREE_FOLDER] for frame in content["data"]]
        names = dict.fromkeys(name for frame in frames for name in frame)
        files = {name: [folder / _UNITREE_FOLDER / Path(frame[name]).name for frame in frames] for name in names}
        return content.get("text", {}).get("goal"), files
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        expected, got = "a picture of each camera in each frame", f"{type(error).__name__}: {error}; {_LEAVE_OUT}"
        raise DatasetError.at(file, expected, got) from error


def is_picture(file: Path) -> bool:
    """True for a PNG or JPEG file, by suffix; False for a hidden one."""
    return file.suffix.lower() in PICTURE_SUFFIXES and not file.name.startswith(".") and file.is_file()


def _pictures_in(place: Path) -> list[Path]:
    """List an episode's frames in order. Raises DatasetError if there are none, or several kinds.

    place: a folder, or a pattern for file names in it
    """
    folder = place.parent if is_pattern(place) else place
    try:
        found = [each for each in folder.iterdir() if not each.name.startswith(".")]
    except OSError as error:
        raise DatasetError.at(folder, "a folder of PNG or JPEG files", error.strerror) from error
    names = [each.name for each in found if is_picture(each)]
    names = matching(place.name, names) if is_pattern(place) else names
    folders = in_natural_order([each.name for each in found if each.is_dir()])
    got = f"an empty folder: {_LEAVE_OUT}" if not found else f"other files: {_LEAVE_OUT}"
    if folders:
        remedy = f"list the folders of one camera in tasks.csv ({folder.name}/{folders[0]})"
        got = f"the folders {', '.join(folders[:3])}: {remedy}, or {_LEAVE_OUT}"
    require(place, bool(names), "PNG or JPEG files", got)
    return [folder / name for name in in_order_of_numbers(folder, names)]
