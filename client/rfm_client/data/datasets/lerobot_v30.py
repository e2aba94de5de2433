# SPDX-License-Identifier: MIT
"""Episodes of LeRobot v3.0: many in one table and one film, which are found by numbers of files and by time stamps."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rfm_client.data.datasets.lerobot_info import Info
from rfm_client.data.datasets.lerobot_rows import Entry, read_table
from rfm_client.data.datasets.protocol import DatasetError

EPISODES_FOLDER = Path("meta", "episodes")
TASKS_FILE = Path("meta", "tasks.parquet")

_OF_AN_EPISODE = (
    *("episode_index", "tasks", "length", "dataset_from_index", "dataset_to_index"),
    *("data/chunk_index", "data/file_index"),
)
_OF_A_FILM = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")


def read_entries(root: Path, info: Info) -> Iterator[Entry]:
    """The episodes that the metadata list. Raises DatasetError."""
    files = sorted((root / EPISODES_FOLDER).rglob("*.parquet"))
    if not files:
        raise DatasetError.at(root / EPISODES_FOLDER, "Parquet files", "none")
    of_films = [f"videos/{key}/{name}" for key in info.films for name in _OF_A_FILM]
    for file in files:
        for row in read_table(file, [*_OF_AN_EPISODE, *of_films]).to_pylist():
            yield _entry(root, info, file, row)


def read_tasks(root: Path) -> dict[int, str | None]:
    """Each task's sentence by its number. Raises DatasetError.

    The sentences are the index of a pandas table, whose column has another name in each version of its writer.
    """
    file = root / TASKS_FILE
    columns: dict[str, list[Any]] = read_table(file).to_pydict()
    numbers = columns.pop("task_index", None)
    texts = [values for values in columns.values() if all(value is None or isinstance(value, str) for value in values)]
    if numbers is None or len(texts) != 1:
        raise DatasetError.at(file, "task_index and one column of sentences", ", ".join(["task_index"] * bool(numbers)))
    return dict(zip(numbers, texts[0], strict=True))


def _entry(root: Path, info: Info, file: Path, row: dict[str, Any]) -> Entry:
    index, length = row["episode_index"], row["length"]
    where = f"episode {index}: {file}"
    missing = [name for name, value in row.items() if value is None]
    if missing:
        raise DatasetError.at(f"{where}: {missing[0]}", "a value", "none")
    first, end = row["dataset_from_index"], row["dataset_to_index"]
    if end - first != length:
        raise DatasetError.at(f"{where}: length", f"{end - first}, from {first} to {end}", str(length))
    data = {"chunk_index": row["data/chunk_index"], "file_index": row["data/file_index"]}
    return Entry(
        index=index,
        tasks=row["tasks"],
        length=length,
        first_index=first,
        data_file=info.path(root, info.data_path, **data),
        films={key: _film(root, info, where, row, key) for key in info.films},
    )


def _film(root: Path, info: Info, where: str, row: dict[str, Any], key: str) -> tuple[Path, float]:
    chunk, number, from_s, to_s = (row[f"videos/{key}/{name}"] for name in _OF_A_FILM)
    expected_s = row["length"] / info.fps
    if abs((to_s - from_s) - expected_s) > 0.5 / info.fps:
        expected, got = f"{expected_s:.4f} s for {row['length']} frames", f"{to_s - from_s:.4f} s"
        raise DatasetError.at(f"{where}: videos/{key}: from_timestamp to to_timestamp", expected, got)
    return info.path(root, info.video_path, video_key=key, chunk_index=chunk, file_index=number), float(from_s)
