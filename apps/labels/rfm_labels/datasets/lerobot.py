# SPDX-License-Identifier: MIT
"""LeRobot datasets v2.0 to v3.0, read without LeRobot. Needs pyarrow and PyAV.

Frame t belongs to row t; in a video, it is the frame at the row's time.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client import UInt8Array
from rfm_client.frames import Picture, Video
from rfm_client.options import InvalidValueError, checked_finite
from rfm_labels.datasets.dataset import AskedCorrections, Dataset, DatasetEpisode, Motion, TaskOverride
from rfm_labels.datasets.faults import DatasetError, listed, require
from rfm_labels.datasets.hub import DownloadSize, HubFiles
from rfm_labels.datasets.lerobot_frames import TOLERANCE_S, Frames, Part, VideoRows
from rfm_labels.datasets.lerobot_meta import (
    EPISODES_FILE,
    EPISODES_FOLDER,
    Entry,
    Info,
    column_types,
    read_entries,
    read_table,
)
from rfm_labels.datasets.lerobot_rows import TASK_COLUMN, RowReader, Sentences, has_numbers, read_sentences, table_of
from rfm_labels.datasets.stored_files import (
    Span,
    Times,
    check_pictures,
    digest_of,
    faults_at,
    file_identity,
    picture_frames,
    turn_mark,
)

_VIDEOS_AT_A_TIME = 4  # packets of this many videos, or one per camera, stay in memory
_CONTAINER = {".mp4": "mov"}  # FFmpeg's names by suffix. Otherwise FFmpeg would open the files that a playlist names
_LISTED_IN = dict.fromkeys(("v2.0", "v2.1"), EPISODES_FILE) | {"v3.0": EPISODES_FOLDER}
_MOTION = {"action": "action", "state": "observation.state"}  # columns
_VECTORS = re.compile(r"(fixed_size_|large_)?list<\w+: (halffloat|float|double|u?int\d+)( not null)?>(\[\d+\])?")
_BY_PLACE = "LeRobot finds a sentence by position, so it may read a different one"


class LeRobotDataset(Dataset):
    """A LeRobot dataset in a local folder, which may be a commit's folder in the Hub's cache.

    hub: downloads missing files into the folder; None for a local dataset
    tolerance_s: largest gap between a row and its frame, as in LeRobot's ``tolerance_s``
    """

    def __init__(
        self,
        root: Path,
        *,
        hub: HubFiles | None = None,
        task: TaskOverride = TaskOverride(),
        corrections: AskedCorrections = AskedCorrections(),
        tolerance_s: float = TOLERANCE_S,
    ) -> None:
        try:
            self._tolerance_s = checked_finite("tolerance_s", tolerance_s, "a number above 0")
        except InvalidValueError as error:
            raise DatasetError.like(error) from None
        require("tolerance_s", tolerance_s > 0, "a number above 0", tolerance_s)
        self.root = root
        self._hub = hub
        self.source = root.resolve().name if hub is None else hub.name
        self.revision = None if hub is None else hub.commit
        self.info = info = Info.read(root)
        self.fps = info.fps
        self.kind = f"LeRobot {info.version}"
        self.cameras = (*info.videos, *info.images)
        self.depth_cameras, self.left_out, self.notes = info.depth, info.left_out, info.notes
        self.corrections = corrections.of_cameras(self.cameras)
        entries = list(read_entries(info))
        self._entries = dict(entries)
        self.numbers = sorted(self._entries)  # may have gaps where episodes were deleted
        self.given_task = task
        self._rows = RowReader(root / "data", self._sentences(), task, hub)
        self._rows_in = lru_cache(max(_VIDEOS_AT_A_TIME, len(info.videos)))(self._read_video)
        self._clocks: dict[int, str] = {}  # for the episodes read so far
        numbers = Counter(number for number, _ in entries)
        twice = [number for number in self.numbers if numbers[number] > 1]
        require(root / "meta", not twice, "each episode once", f"{listed(twice)} several times")
        lengths = [entry.length for entry in self._entries.values() if isinstance(entry, Entry)]
        counts = {"episodes": (len(self.numbers), info.total_episodes)}
        if len(lengths) == len(self._entries):
            counts["frames"] = (sum(lengths), info.total_frames)
        for name, (count, stated) in counts.items():
            if count != stated:
                note = f"{name}: {count}, as {_LISTED_IN[info.version]} lists them; info.json says {stated}"
                self.notes = [*self.notes, note]

    def _sentences(self) -> Sentences:
        """How to interpret the task column. Raises DatasetError for an unknown column or a broken task table."""
        if self.given_task.overrides:
            return Sentences()
        column = self.given_task.column or TASK_COLUMN
        file, types = self._types_of_rows() if column != TASK_COLUMN else (None, {})
        if file is not None and not has_numbers(file, types, column):
            return Sentences(column)
        table, name = table_of(self.info, column)
        sentences, shown = read_sentences(table, name), table.relative_to(self.root)
        if list(sentences) != list(range(len(sentences))) and table.suffix == ".parquet":
            self.notes = [*self.notes, f"tasks: {shown} is not in the order of {name}_index: {_BY_PLACE}"]
        return Sentences(column, str(shown.with_suffix("")), sentences)

    def _types_of_rows(self) -> tuple[Path | None, Mapping[str, str]]:
        """The first readable row table, and its column types."""
        for entry in self._entries.values():
            try:
                if isinstance(entry, Entry):
                    self._here(entry.data_file)
                    return entry.data_file, column_types(entry.data_file)
            except DatasetError:  # raised again when its episode is read
                continue
        return None, {}

    def download(
        self, numbers: Sequence[int], cameras: Sequence[str], accept: Callable[[int, int], None] | None = None
    ) -> None:
        sizes = self._sizes(numbers, cameras)
        if sizes and accept is not None:
            accept(len(sizes), sum(sizes.values()))
        if self._hub is not None:
            self._hub.download(self.root / name for name in sizes)

    def listed_in(self) -> Iterable[Path]:
        return sorted((self.root / "meta").rglob("*"))

    def missing(self, numbers: Sequence[int], cameras: Sequence[str]) -> DownloadSize | None:
        sizes = self._sizes(numbers, cameras)
        return DownloadSize(len(sizes), sum(sizes.values())) if sizes else None

    def _sizes(self, numbers: Sequence[int], cameras: Sequence[str]) -> Mapping[str, int]:
        """The sizes in bytes of the files that are only on the Hub, by name."""
        return {} if self._hub is None else self._hub.sizes(self._files_of(numbers, cameras))

    def is_here(self, number: int) -> bool:
        return self._hub is None or all(file.exists() for file in self._files_of([number], self.cameras))

    def listed(self, number: int) -> DatasetEpisode:
        if self._hub is None:
            return super().listed(number)
        entry = self._entry(number)
        return DatasetEpisode(number, entry.where, " ".join(entry.tasks[:1]), entry.length, 0)

    def _files_of(self, numbers: Sequence[int], cameras: Sequence[str]) -> list[Path]:
        """The files that these episodes and cameras need, by the metadata."""
        entries = [each for number in numbers if isinstance(each := self._entries[number], Entry)]
        places = [entry.videos.get(camera) for entry in entries for camera in cameras]
        videos = {place[0] for place in places if isinstance(place, tuple)}
        shared = [each for (_, video), sharing in self._in_video.items() if video in videos for each in sharing]
        return [*videos, *(entry.data_file for entry in (*entries, *shared))]

    def unused_files(self) -> Sequence[Path]:
        entries = [each for each in self._entries.values() if isinstance(each, Entry)]
        used = {entry.data_file for entry in entries}
        used |= {place[0] for entry in entries for place in entry.videos.values() if isinstance(place, tuple)}
        found = {file for pattern in ("data/**/*.parquet", "videos/**/*.mp4") for file in self.root.glob(pattern)}
        return sorted(file.relative_to(self.root) for file in found - used)

    def _here(self, file: Path) -> Path:
        """Return the file, after its download if it is missing and the dataset is the Hub's. Raises DatasetError."""
        if self._hub is not None:
            self._hub.download([file])
        return file

    def read_episode(self, number: int) -> DatasetEpisode:
        entry = self._entry(number)
        rows = self._rows.read(entry)
        self._clocks[number] = rows.clock(self.info.fps)
        tasks = tuple(rows.tasks) if len(rows.tasks) > 1 else ()
        return DatasetEpisode(number, entry.where, rows.tasks[0][1], len(rows.times_s), rows.first_index, tasks)

    def decoder(self, camera: str) -> str | None:
        return Video.decoder() if camera in self.info.videos else Picture.decoder()

    def identity(self, episode: DatasetEpisode, camera: str) -> str:
        if camera not in self.info.videos:
            return digest_of(image + turn_mark(image).encode() for image in self._images(episode, camera))
        video, from_s = self._entry(episode.index).video(camera)
        clock = self._clocks[episode.index]
        return f"{file_identity(self._here(video), self.revision)} {from_s}{clock}"

    def check(self, episode: DatasetEpisode, camera: str) -> None:
        if camera in self.info.videos:
            self._frames_of(episode, camera)
        else:
            check_pictures(self._images(episode, camera), self.place(episode, camera))

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        span = self.span(episode, camera)
        if span is not None:
            return span.frames()
        return picture_frames(self._images(episode, camera), self.place(episode, camera))

    def times_s(self, episode: DatasetEpisode) -> Times:
        return self._rows.read(self._entry(episode.index)).times_s

    def motion(self, episode: DatasetEpisode) -> Mapping[str, Motion]:
        file = self._rows.file_of(self._entry(episode.index))
        types = column_types(file)
        columns = {name: column for name, column in _MOTION.items() if _VECTORS.fullmatch(types.get(column, ""))}
        own = [("episode_index", "=", episode.index)]
        table = read_table(file, list(columns.values()), own) if columns else {}
        found = {}
        for name, column in columns.items():
            rows = table[column].to_numpy()
            shapes = {np.shape(row) for row in rows}
            if len(shapes) != 1 or () in shapes:  # ragged rows, or null ones
                continue
            values = np.stack(rows).astype(np.float64)
            names = self.info.names.get(column, [])
            usual = list(map(str, range(values.shape[1])))
            found[name] = Motion(names if len(names) == len(usual) else usual, values)
        return found

    def span(self, episode: DatasetEpisode, camera: str) -> Span | None:
        if camera not in self.info.videos:
            return None
        rows, frames = self._frames_of(episode, camera)
        tolerance_s = 0.5 * rows.apart_s(frames)
        return Span(rows.video, rows.video.packets.times_s[frames], tolerance_s, self.place(episode, camera))

    def _entry(self, number: int) -> Entry:
        entry = self._entries[number]
        if isinstance(entry, DatasetError):
            raise entry
        return entry

    def _frames_of(self, episode: DatasetEpisode, camera: str) -> tuple[VideoRows, Frames]:
        """An episode's video, and the numbers of its frames there."""
        rows = self._rows_in(camera, self._entry(episode.index).video(camera)[0])
        frames = rows.frames[episode.index]
        if isinstance(frames, DatasetError):
            raise frames
        return rows, frames

    @cached_property
    def _in_video(self) -> Mapping[tuple[str, Path], Sequence[Entry]]:
        found: dict[tuple[str, Path], list[Entry]] = {}
        for entry in [each for each in self._entries.values() if isinstance(each, Entry)]:
            for camera, place in entry.videos.items():
                if isinstance(place, tuple):
                    found.setdefault((camera, place[0]), []).append(entry)
        return found

    def _read_video(self, camera: str, file: Path) -> VideoRows:
        """A video with the rows from all readable episodes in it."""
        video = Video(self._here(file), _CONTAINER.get(file.suffix.lower()))
        with faults_at(file):
            require(file, len(video.packets.times_s) > 0, "frames with time stamps", "none")
        parts = []
        for entry in self._in_video[camera, file]:
            with suppress(DatasetError):  # raised again if that episode is read
                times_s = entry.video(camera)[1] + self._rows.read(entry).times_s
                parts.append(Part(entry.index, entry.where, times_s))
        return VideoRows(camera, video, parts, self.info.fps, self._tolerance_s)

    def _images(self, episode: DatasetEpisode, camera: str) -> list[bytes]:
        file = self._rows.file_of(self._entry(episode.index))
        stored = read_table(file, [camera], filters=[("episode_index", "=", episode.index)])[camera].to_pylist()
        require(f"{file}: {camera}", len(stored) == episode.num_frames, f"{episode.num_frames} images", len(stored))
        return [self._image_bytes(f"{self.place(episode, camera)}: frame {t}", image) for t, image in enumerate(stored)]

    def _image_bytes(self, where: str, image: Any) -> bytes:
        image = image if isinstance(image, dict) else {}
        if isinstance(image.get("bytes"), bytes):
            return bytes(image["bytes"])
        path = image.get("path")
        if not isinstance(path, str) or Path(path).is_absolute() or ".." in Path(path).parts:
            raise DatasetError.at(where, "an image, or its path inside the dataset", repr(path))
        try:
            return self._here(self.root / path).read_bytes()
        except OSError as error:
            raise DatasetError.at(where, "an image file", f"{error.strerror} ({path})") from error
