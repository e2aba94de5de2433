# SPDX-License-Identifier: MIT
"""Episodes of LeRobot v3.0: many share a table and a video, found by file numbers and time stamps."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rfm_labels.datasets.lerobot_rows import Entry, Info, read_table
from rfm_labels.datasets.lerobot_tasks import by_number
from rfm_labels.datasets.protocol import DatasetError, require

EPISODES_FOLDER = Path("meta", "episodes")
TASKS_FILE = Path("meta", "tasks.parquet")

_INDEX_OF_PANDAS = "__index_level_0__"  # column of an index without a name
_OF_AN_EPISODE = (
    *("episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index"),
    *("data/chunk_index", "data/file_index"),
)
_OF_A_VIDEO = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")


def read_entries(info: Info) -> Iterator[tuple[int, Entry | DatasetError]]:
    """Yield the number of each episode with its metadata, or with their fault. Raises DatasetError."""
    files = sorted((info.root / EPISODES_FOLDER).rglob("*.parquet"))
    require(info.root / EPISODES_FOLDER, bool(files), "Parquet files", "none")
    of_videos = [f"videos/{key}/{name}" for key in info.videos for name in _OF_A_VIDEO]
    for file in files:
        for row in read_table(file, [*_OF_AN_EPISODE, *of_videos]).to_pylist():
            index = row["episode_index"]
            require(f"{file}: episode_index", index is not None, "a value", "none")
            try:
                yield index, _entry(info, file, row)
            except DatasetError as error:
                yield index, error


def read_tasks(root: Path, file: Path = TASKS_FILE, name: str = "task") -> dict[int, str | None]:
    """Return each task's sentence by its number. Raises DatasetError.

    name: the column of the numbers is ``<name>_index``

    The sentences are the index of a pandas table. The column's name depends on the version of its writer.
    """
    path = root / file
    columns: dict[str, list[Any]] = read_table(path).to_pydict()
    numbers = columns.pop(f"{name}_index", None)
    texts = {
        column: values
        for column, values in columns.items()
        if all(value is None or isinstance(value, str) for value in values)
    }
    of_pandas = next((column for column in (_INDEX_OF_PANDAS, name) if column in texts), None)
    column = of_pandas or (next(iter(texts)) if len(texts) == 1 else None)
    got = f"{'no ' * (numbers is None)}{name}_index and {len(texts)} of them"
    require(path, numbers is not None and column is not None, f"{name}_index and one column of sentences", got)
    return by_number(path, list(zip(numbers or (), texts[column or ""], strict=True)))


def _entry(info: Info, file: Path, row: dict[str, Any]) -> Entry:
    index, length = row["episode_index"], row["length"]
    where = f"episode {index}: {file}"
    for name, value in row.items():
        require(f"{where}: {name}", value is not None, "a value", "none")
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


def _video(info: Info, where: str, row: dict[str, Any], key: str) -> tuple[Path, float]:
    chunk, number, from_s, to_s = (row[f"videos/{key}/{name}"] for name in _OF_A_VIDEO)
    lasts_s, expected_s = to_s - from_s, row["length"] / info.fps
    is_long_enough = lasts_s >= expected_s - 0.5 / info.fps  # longer: with frames of a discarded take
    expected = f"{expected_s:.4f} s for {row['length']} frames"
    require(f"{where}: videos/{key}: from_timestamp to to_timestamp", is_long_enough, expected, f"{lasts_s:.4f} s")
    return info.path(info.video_path, video_key=key, chunk_index=chunk, file_index=number), float(from_s)
