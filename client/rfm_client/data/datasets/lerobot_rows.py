# SPDX-License-Identifier: MIT
"""The rows of a LeRobot dataset: which frames each episode has, when, and what its task is. Needs pyarrow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_client.data.datasets.protocol import DatasetError, GivenTask

ROW_COLUMNS = ("index", "episode_index", "frame_index", "timestamp", "task_index")
FILES_AT_A_TIME = 4  # whose rows are kept in memory


@dataclass(frozen=True)
class Entry:
    """What a dataset's metadata say of one episode, whatever its version.

    tasks: sentences that its metadata name
    first_index: number of its first frame in the dataset; None: only the rows say it
    data_file: Parquet file with its rows
    films: for each camera the video file, and when the episode begins in it, in seconds
    """

    index: int
    tasks: Sequence[str]
    length: int
    first_index: int | None
    data_file: Path
    films: Mapping[str, tuple[Path, float]]

    @property
    def where(self) -> str:
        """How messages name the episode."""
        return f"episode {self.index}"


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of one episode. times_s: float64 [T], from the start of the episode, rising"""

    first_index: int
    times_s: npt.NDArray[np.float64]
    task: str


class RowReader:
    """Reads and checks rows. The columns of the files that were read last are kept.

    tasks: sentences by number; given: what the caller says of them
    """

    def __init__(self, tasks: Mapping[int, str | None], given: GivenTask) -> None:
        self._tasks = tasks
        self._given = given
        self._columns = lru_cache(FILES_AT_A_TIME)(_read_columns)

    def read(self, entry: Entry) -> Rows:
        """The episode's rows. Raises DatasetError where they and its metadata contradict each other."""
        columns = self._columns(entry.data_file)
        own = np.flatnonzero(columns["episode_index"] == entry.index)
        where = f"{entry.where}: {entry.data_file}"
        if len(own) != entry.length or not len(own):
            raise DatasetError.at(where, f"{max(entry.length, 1)} rows, as its metadata say", f"{len(own)}")
        _check_counts(where, columns["index"][own], columns["frame_index"][own], entry.first_index)
        times_s = columns["timestamp"][own].astype(np.float64)
        if not (np.isfinite(times_s).all() and (np.diff(times_s) > 0).all()):
            raise DatasetError.at(f"{where}: timestamp", "rising numbers", "others")
        return Rows(int(columns["index"][own][0]), times_s, self._task(entry, where, columns["task_index"][own]))

    def _task(self, entry: Entry, where: str, task_indices: npt.NDArray[np.int64]) -> str:
        if self._given.overrides:
            return self._given.of(where, None)
        used = np.unique(task_indices).tolist()
        if len(used) != 1:
            raise DatasetError.at(f"{where}: task_index", "one task in an episode", f"{len(used)}: {used}")
        own = self._tasks.get(used[0])
        task = self._given.of(f"{entry.where}: task {used[0]} in meta/tasks", own)
        if entry.tasks and task == own and task not in entry.tasks:
            raise DatasetError.at(f"{entry.where}: meta/episodes: tasks", repr(task), repr(list(entry.tasks)))
        return task


def read_table(file: Path, columns: list[str] | None = None, filters: Any = None) -> Any:
    """A Parquet file's table. Raises DatasetError for a missing or broken file, or one without these columns."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError('LeRobot datasets need pyarrow: pip install "./client[label]"') from error
    try:
        table = parquet.read_table(file, columns=columns, filters=filters, partitioning=None)
    except FileNotFoundError as error:
        raise DatasetError.at(file, "a Parquet file", "none") from error
    except (OSError, pyarrow.ArrowException) as error:
        raise DatasetError.at(file, "a readable Parquet file", str(error)) from error
    missing = [name for name in columns or [] if name not in table.column_names]
    if missing:
        raise DatasetError.at(file, f"the column {missing[0]}", ", ".join(table.column_names))
    return table


def _read_columns(file: Path) -> Mapping[str, npt.NDArray[Any]]:
    table = read_table(file, list(ROW_COLUMNS))
    return {name: table[name].to_numpy() for name in ROW_COLUMNS}


def _check_counts(
    where: str, indices: npt.NDArray[np.int64], frames: npt.NDArray[np.int64], first_index: int | None
) -> None:
    expected = np.arange(len(indices))
    if not np.array_equal(frames, expected):
        t = int(np.flatnonzero(frames != expected)[0])
        raise DatasetError.at(f"{where}: frame_index", f"{t} in row {t}", str(frames[t]))
    first = int(indices[0]) if first_index is None else first_index
    if not np.array_equal(indices, first + expected):
        t = int(np.flatnonzero(indices != first + expected)[0])
        raise DatasetError.at(f"{where}: index", f"{first + t} in row {t}", str(indices[t]))
