# SPDX-License-Identifier: MIT
"""Tables of a LeRobot dataset: ``meta/info.json``, the entries of episodes, and their rows. Needs pyarrow."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_labels.datasets.lerobot_tasks import Sentences, values_in, values_of
from rfm_labels.datasets.protocol import DatasetError, TaskOverride, digest_of, require

INFO_FILE = Path("meta", "info.json")
VERSIONS = ("v2.0", "v2.1", "v3.0")

_ROW_COLUMNS = ("index", "episode_index", "frame_index", "timestamp")
_TASKS = "tasks"  # key of the column that names the tasks
_REGULAR_S, _FLOAT32 = 1e-4, 1e-7  # absolute and relative errors of a time stamp, a float32
_FILES_AT_A_TIME = 4  # whose rows stay in memory
_FOLLOW_THE_ROWS = "correct it, or follow the rows, as LeRobot's reader does: --task-column task_index"
_OF_PICTURES = ("info", "video_info")  # keys in a feature of a camera, by version of the writer
_DEPTH_MARKS = ("video.is_depth_map", "is_depth_map")


@dataclass(frozen=True)
class Info:
    """Contents of ``meta/info.json``.

    videos, images: keys of cameras with frames in video files, and in tables
    depth: keys of the depth cameras in both
    total_frames: of all episodes
    data_path, video_path: templates of file paths
    """

    root: Path
    version: str
    fps: float
    videos: tuple[str, ...]
    images: tuple[str, ...]
    depth: tuple[str, ...]
    total_episodes: int
    total_frames: int
    chunks_size: int
    data_path: str
    video_path: str | None

    @classmethod
    def read(cls, root: Path) -> Info:
        """Return the information in ``root``. Raises DatasetError."""
        file = root / INFO_FILE
        try:
            document = json.loads(file.read_bytes())
        except (OSError, ValueError, RecursionError) as error:
            raise DatasetError.at(file, "a readable JSON file", error) from error
        require(file, isinstance(document, dict), "a JSON object", type(document).__name__)

        def field(name: str, *kinds: type) -> Any:
            value = document.get(name)
            is_of_kind = isinstance(value, kinds) and not isinstance(value, bool)
            expected = " or ".join(kind.__name__ for kind in kinds)
            require(f"{file}: {name}", is_of_kind, expected, "none" if value is None else repr(value))
            return value

        features = {key: feature for key, feature in field("features", dict).items() if isinstance(feature, dict)}
        videos, images = (
            tuple(key for key, feature in features.items() if feature.get("dtype") == kind)
            for kind in ("video", "image")
        )
        version, fps = field("codebase_version", str), float(field("fps", int, float))
        require(f"{file}: codebase_version", version in VERSIONS, f"one of {', '.join(VERSIONS)}", repr(version))
        require(f"{file}: fps", 0 < fps < math.inf, "a number above 0", repr(fps))
        return cls(
            root,
            version,
            fps,
            videos,
            images,
            depth=tuple(key for key in (*videos, *images) if _is_depth(features[key])),
            total_episodes=field("total_episodes", int),
            total_frames=field("total_frames", int),
            chunks_size=field("chunks_size", int),
            data_path=field("data_path", str),
            video_path=field("video_path", str) if videos else None,
        )

    def path(self, template: str | None, **values: Any) -> Path:
        """Return the file inside the dataset that a template names. Raises DatasetError."""
        try:
            path = (template or "").format(**values)
        except (LookupError, ValueError) as error:
            raise DatasetError.at(INFO_FILE, f"a path of {', '.join(values)}", repr(template)) from error
        is_inside = bool(path) and not Path(path).is_absolute() and ".." not in Path(path).parts
        require(INFO_FILE, is_inside, "a path inside the dataset", repr(path))
        return self.root / path


def _is_depth(feature: Mapping[str, Any]) -> bool:
    told = [feature[name] for name in _OF_PICTURES if isinstance(feature.get(name), dict)]
    return any(each.get(mark) is True for each in told for mark in _DEPTH_MARKS)


@dataclass(frozen=True)
class Entry:
    """Metadata of one episode, in the same form for all versions.

    tasks: sentences in the metadata
    first_index: the dataset's number of its first frame; None: only the rows have it
    data_file: Parquet file with its rows
    videos: by camera, the video file and the episode's start in it, in seconds
    """

    index: int
    tasks: Sequence[str]
    length: int
    first_index: int | None
    data_file: Path
    videos: Mapping[str, tuple[Path, float]]

    @property
    def where(self) -> str:
        """The episode's name in messages."""
        return f"episode {self.index}"


@dataclass(frozen=True, eq=False)
class EpisodeRows:
    """The rows of one episode.

    times_s: float64 [T], rising, from the start of the episode
    tasks: first row and task of each stretch of rows with the same task
    """

    first_index: int
    times_s: npt.NDArray[np.float64]
    tasks: Sequence[tuple[int, str]]

    def clock(self, fps: float) -> str:
        """Return a text that identifies the times, because they decide the frames; empty for multiples of 1 / fps."""
        is_regular = np.allclose(self.times_s, np.arange(len(self.times_s)) / fps, rtol=_FLOAT32, atol=_REGULAR_S)
        return "" if is_regular else f" {digest_of([self.times_s.tobytes()])}"


class RowReader:
    """Reads and checks rows. Keeps the columns of the latest files.

    tasks: sentences by number
    given: the caller's task
    """

    def __init__(self, tasks: Sentences, given: TaskOverride) -> None:
        self._tasks = tasks
        self._given = given
        self._columns = lru_cache(_FILES_AT_A_TIME)(_read_columns)

    def read(self, entry: Entry) -> EpisodeRows:
        """Return the episode's rows. Raises DatasetError if they contradict its metadata."""
        columns = self._columns(entry.data_file, self._tasks.column)
        own = np.flatnonzero(columns["episode_index"] == entry.index)
        rows = {name: columns[name][own] for name in _ROW_COLUMNS}
        where, num_rows = f"{entry.where}: {entry.data_file}", len(own)
        is_whole = num_rows == entry.length and num_rows > 0
        require(where, is_whole, f"{max(entry.length, 1)} rows, as its metadata say", num_rows)
        first = int(rows["index"][0]) if entry.first_index is None else entry.first_index
        require(f"{where}: index", first >= 0, "a number in row 0", "none")
        for name, expected in (("frame_index", np.arange(num_rows)), ("index", first + np.arange(num_rows))):
            t = int(np.argmax(rows[name] != expected))
            require(f"{where}: {name}", bool(rows[name][t] == expected[t]), f"{expected[t]} in row {t}", rows[name][t])
        times_s = rows["timestamp"].astype(np.float64)
        require(f"{where}: timestamp", bool(np.isfinite(times_s).all()), "numbers of seconds", "others")
        rises = np.diff(times_s) > 0
        t = int(np.argmin(rises)) + 1 if num_rows > 1 else 0
        got = f"{times_s[t]:.4f} s in row {t}: write the dataset again, or leave this episode out (--episodes)"
        require(f"{where}: timestamp", bool(rises.all()), f"times that rise, after {times_s[t - 1]:.4f} s", got)
        return EpisodeRows(
            first, times_s, self._tasks_of(entry, where, values_in(where, columns[_TASKS], own, times_s))
        )

    def _tasks_of(self, entry: Entry, where: str, values: Any) -> Sequence[tuple[int, str]]:
        if self._given.overrides:
            return [(0, self._given.of(where, None))]
        firsts = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist()]
        if self._given.several == "first":
            firsts = firsts[:1]
        return [(first, self._task(entry, values[first])) for first in firsts]

    def _task(self, entry: Entry, value: Any) -> str:
        place, own = self._tasks.find(value)
        task = self._given.of(f"{entry.where}: {place}", own)
        is_named = self._given.column is not None or not entry.tasks or task != own or task in entry.tasks
        got = f"{list(entry.tasks)}: {_FOLLOW_THE_ROWS}"
        require(f"{entry.where}: meta/episodes: tasks", is_named, repr(task), got)
        return task


def read_table(file: Path, columns: list[str] | None = None, filters: Any = None) -> Any:
    """Return a Parquet file's table. Raises DatasetError for a missing or broken file, or a missing column."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError("LeRobot datasets need pyarrow: pip install ./client ./apps/labels") from error
    try:
        table = parquet.read_table(file, columns=columns, filters=filters, partitioning=None)
    except FileNotFoundError as error:
        raise DatasetError.at(file, "a Parquet file", "none") from error
    except (OSError, pyarrow.ArrowException) as error:
        raise DatasetError.at(file, "a readable Parquet file", error) from error
    for name in columns or []:
        require(file, name in table.column_names, f"the column {name}", ", ".join(table.column_names))
    return table


def column_types(file: Path) -> Mapping[str, str]:
    """Return the column types of a Parquet file, as pyarrow names them. Raises DatasetError for a broken file."""
    from pyarrow import ArrowException, parquet

    try:
        return {field.name: str(field.type) for field in parquet.read_schema(file)}
    except (OSError, ArrowException) as error:
        raise DatasetError.at(file, "a readable Parquet file", error) from error


def _read_columns(file: Path, task_column: str) -> Mapping[str, Any]:
    """The columns of a file; integers are int64, and -1 where the table has none."""
    import pyarrow

    table = read_table(file, list(dict.fromkeys([*_ROW_COLUMNS, task_column])))
    columns: dict[str, Any] = {_TASKS: values_of(table[task_column])}
    for name in _ROW_COLUMNS:
        is_time = name == "timestamp"
        try:
            numbers = table[name].cast(pyarrow.float64() if is_time else pyarrow.int64())
        except pyarrow.ArrowException as error:
            raise DatasetError.at(f"{file}: {name}", "numbers", error) from error
        columns[name] = numbers.fill_null(np.nan if is_time else -1).to_numpy()
    return columns
