# SPDX-License-Identifier: MIT
"""Metadata in a LeRobot dataset: ``meta/info.json``, and an entry per episode. Needs pyarrow.

In v2.0 and v2.1 each episode has its own table, and a video per camera. In v3.0 many episodes share a table and a
video, located by file numbers and time stamps.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfm_client.options import checked_count
from rfm_labels.datasets.faults import DatasetError, json_object, require, unreadable

INFO_FILE = Path("meta", "info.json")
VERSIONS = ("v2.0", "v2.1", "v3.0")
EPISODES_FILE = Path("meta", "episodes.jsonl")
EPISODES_FOLDER = Path("meta", "episodes")

_CAMERA_INFO_KEYS = ("info", "video_info")  # keys in a camera feature, by writer version
_DEPTH_MARKS = ("video.is_depth_map", "is_depth_map")
_CAMERA_KINDS = ("video", "image")
_EPISODE_COLUMNS = (
    *("episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index"),
    *("data/chunk_index", "data/file_index"),
)
_VIDEO_COLUMNS = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")


@dataclass(frozen=True)
class Info:
    """Contents of ``meta/info.json``.

    videos, images: cameras with frames in video files, and in tables
    depth: depth cameras among both
    left_out: other cameras, with the reason
    total_frames: over all episodes
    data_path, video_path: file path templates
    names: of the dimensions, by feature; empty if unknown
    notes: lines for the caller
    """

    root: Path
    version: str
    fps: float
    videos: tuple[str, ...]
    images: tuple[str, ...]
    depth: tuple[str, ...]
    left_out: Mapping[str, str]
    total_episodes: int
    total_frames: int
    chunks_size: int
    data_path: str
    video_path: str | None
    names: Mapping[str, Sequence[str]]
    notes: Sequence[str]

    @classmethod
    def read(cls, root: Path) -> Info:
        """Read the information in ``root``. Raises DatasetError."""
        file = root / INFO_FILE
        document = json_object(file)
        notes: list[str] = []
        if "codebase_version" not in document:
            document["codebase_version"] = version = "v3.0" if (root / EPISODES_FOLDER).is_dir() else "v2.1"
            notes = [f"version: {version}, by the files of meta, since info.json has no codebase_version"]

        def field(name: str, *kinds: type) -> Any:
            value = document.get(name)
            is_of_kind = isinstance(value, kinds) and not isinstance(value, bool)
            expected = " or ".join(kind.__name__ for kind in kinds)
            require(f"{file}: {name}", is_of_kind, expected, "none" if value is None else repr(value))
            return value

        features = {key: feature for key, feature in field("features", dict).items() if isinstance(feature, dict)}
        left_out = {key: reason for key, feature in features.items() if (reason := _no_colours(feature))}
        videos, images = (
            tuple(key for key, feature in features.items() if feature.get("dtype") == kind and key not in left_out)
            for kind in _CAMERA_KINDS
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
            left_out=left_out,
            total_episodes=field("total_episodes", int),
            total_frames=field("total_frames", int),
            chunks_size=field("chunks_size", int),
            data_path=field("data_path", str),
            video_path=field("video_path", str) if videos else None,
            names={key: _names(feature.get("names")) for key, feature in features.items()},
            notes=notes,
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


def _names(stored: Any) -> list[str]:
    """The names of a feature's dimensions, which LeRobot's versions store as a list, in groups, or with positions."""
    if isinstance(stored, dict):
        groups = [group for group in stored.values() if isinstance(group, list)]
        stored = [name for group in groups for name in group] if groups else list(stored)
    return list(map(str, stored)) if isinstance(stored, list) else []


def _is_depth(feature: Mapping[str, Any]) -> bool:
    infos = [feature[name] for name in _CAMERA_INFO_KEYS if isinstance(feature.get(name), dict)]
    return any(each.get(mark) is True for each in infos for mark in _DEPTH_MARKS)


def _no_colours(feature: Mapping[str, Any]) -> str:
    """Why a camera cannot be shown: it stores distances in a single channel; empty if it has colours."""
    shape = feature.get("shape")
    is_flat = isinstance(shape, list) and shape[-1:] == [1]
    is_map = feature.get("dtype") in _CAMERA_KINDS and is_flat and _is_depth(feature)
    return f"a depth map, {shape}: expected 3 channels of colours" if is_map else ""


@dataclass(frozen=True)
class Entry:
    """One episode's metadata, in the same form for all versions.

    tasks: sentences in the metadata
    first_index: dataset-wide number of the first frame; None: only the rows have it
    data_file: Parquet file with the rows, as the metadata say
    videos: by camera, the video file and the episode's start there, in seconds, or an error in the metadata
    """

    index: int
    tasks: Sequence[str]
    length: int
    first_index: int | None
    data_file: Path
    videos: Mapping[str, tuple[Path, float] | DatasetError]

    @property
    def where(self) -> str:
        """The episode's name in messages."""
        return f"episode {self.index}"

    def video(self, camera: str) -> tuple[Path, float]:
        """Return the camera's video, and the episode's start in it. Raises DatasetError for faulty metadata."""
        found = self.videos[camera]
        if isinstance(found, DatasetError):
            raise found
        return found


def read_table(file: Path, columns: list[str] | None = None, filters: Any = None) -> Any:
    """Read a Parquet table. Raises DatasetError for a missing or broken file, or a missing column."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError(f"LeRobot datasets need pyarrow: {error}: pip install ./client ./apps/labels") from error
    try:
        table = parquet.read_table(file, columns=columns, filters=filters, partitioning=None)
    except FileNotFoundError as error:
        raise DatasetError.at(file, "a Parquet file", "none") from error
    except (OSError, pyarrow.ArrowException) as error:
        raise unreadable(file, "a readable Parquet file", error) from error
    for name in columns or []:
        require(file, name in table.column_names, f"the column {name}", ", ".join(table.column_names))
    return table


def column_types(file: Path) -> Mapping[str, str]:
    """Return a Parquet file's column types, as pyarrow names them. Raises DatasetError for a broken file."""
    from pyarrow import ArrowException, parquet

    try:
        return {field.name: str(field.type) for field in parquet.read_schema(file)}
    except (OSError, ArrowException) as error:
        raise unreadable(file, "a readable Parquet file", error) from error


def read_entries(info: Info) -> Iterator[tuple[int, Entry | DatasetError]]:
    """Yield each episode's number with its metadata or fault. Raises DatasetError."""
    is_v30 = info.version == "v3.0"
    for where, row in _rows_v30(info) if is_v30 else json_lines(info.root / EPISODES_FILE):
        index = number_in(where, row, "episode_index")
        try:
            yield index, (_entry_v30 if is_v30 else _entry_v21)(info, where, index, row)
        except DatasetError as error:
            yield index, error


def _entry_v21(info: Info, where: str, index: int, line: Mapping[str, Any]) -> Entry:
    values = {"episode_chunk": index // info.chunks_size, "episode_index": index}
    tasks = line.get("tasks")
    return Entry(
        index=index,
        tasks=[task for task in tasks if isinstance(task, str)] if isinstance(tasks, list) else [],
        length=number_in(where, line, "length"),
        first_index=None,
        data_file=info.path(info.data_path, **values),
        videos={key: (info.path(info.video_path, **values, video_key=key), 0.0) for key in info.videos},
    )


def _rows_v30(info: Info) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield each row after its file, for messages."""
    files = sorted((info.root / EPISODES_FOLDER).rglob("*.parquet"))
    require(info.root / EPISODES_FOLDER, bool(files), "Parquet files", "none")
    of_videos = [f"videos/{key}/{name}" for key in info.videos for name in _VIDEO_COLUMNS]
    for file in files:
        for row in read_table(file, [*_EPISODE_COLUMNS, *of_videos]).to_pylist():
            yield str(file), row


def _entry_v30(info: Info, where: str, index: int, row: Mapping[str, Any]) -> Entry:
    where, length = f"episode {index}: {where}", row["length"]
    for name in _EPISODE_COLUMNS:
        require(f"{where}: {name}", row[name] is not None, "a value", "none")
    first, end = row["dataset_from_index"], row["dataset_to_index"]
    require(f"{where}: length", end - first == length, f"{end - first}, from {first} to {end}", length)
    data = {"chunk_index": row["data/chunk_index"], "file_index": row["data/file_index"]}
    return Entry(
        index=index,
        tasks=row["tasks"],
        length=length,
        first_index=first,
        data_file=info.path(info.data_path, **data),
        videos={key: _video(info, where, row, key) for key in info.videos},
    )


def _video(info: Info, where: str, row: Mapping[str, Any], key: str) -> tuple[Path, float] | DatasetError:
    """A camera's video and the episode's start in it, or a fault, which counts only if the camera is used."""
    names = [f"videos/{key}/{name}" for name in _VIDEO_COLUMNS]
    try:
        for name in names:
            got = "none: leave this camera out (--cameras), or the episode (--episodes)"
            require(f"{where}: {name}", row[name] is not None, "a value", got)
        return _place(info, where, row, key)
    except DatasetError as error:
        return error


def _place(info: Info, where: str, row: Mapping[str, Any], key: str) -> tuple[Path, float]:
    chunk, number, from_s, to_s = (row[f"videos/{key}/{name}"] for name in _VIDEO_COLUMNS)
    lasts_s, expected_s = to_s - from_s, row["length"] / info.fps
    is_long_enough = lasts_s >= expected_s - 0.5 / info.fps  # longer: includes frames from a discarded take
    expected = f"{expected_s:.4f} s for {row['length']} frames"
    require(f"{where}: videos/{key}: from_timestamp to to_timestamp", is_long_enough, expected, f"{lasts_s:.4f} s")
    return info.path(info.video_path, video_key=key, chunk_index=chunk, file_index=number), float(from_s)


def json_lines(file: Path) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the objects in a JSON lines file, each after its place for messages. Raises DatasetError."""
    try:
        texts = file.read_text(encoding="utf-8-sig").split("\n")  # a sentence may contain other line separators
    except FileNotFoundError as error:
        raise DatasetError.at(file, "a file of JSON lines", "none") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError.at(file, "a readable file of JSON lines", str(error)) from error
    for number, text in enumerate(texts, 1):
        where = f"{file}: line {number}"
        if not text.strip():
            continue
        try:
            line = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise DatasetError.at(where, "a JSON object", str(error)) from error
        require(where, isinstance(line, dict), "a JSON object", type(line).__name__)
        yield where, line


def number_in(where: str, line: Mapping[str, Any], name: str) -> int:
    """Read a whole number, 0 or more, from a row. Raises DatasetError."""
    return checked_count(f"{where}: {name}", line.get(name), least=0, error=DatasetError)
