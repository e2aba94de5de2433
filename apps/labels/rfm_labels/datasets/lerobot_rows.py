# SPDX-License-Identifier: MIT
"""Rows in a LeRobot dataset: the time and task for each frame in an episode. Needs pyarrow.

The task column holds sentences, sentence numbers from a table in ``meta``, or LeRobot's ``language_persistent``, where
an entry with the style ``subtask`` holds from its time on. T rows per episode.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_labels.datasets.dataset import TaskOverride
from rfm_labels.datasets.faults import DatasetError, require
from rfm_labels.datasets.hub import HubFiles
from rfm_labels.datasets.lerobot_meta import Entry, Info, json_lines, number_in, read_table
from rfm_labels.datasets.stored_files import digest_of

TASK_COLUMN = "task_index"

_ROW_COLUMNS = ("index", "episode_index", "frame_index", "timestamp")
_TASKS = "tasks"  # key for the column that names the tasks
_REGULAR_S, _FLOAT32 = 1e-4, 1e-7  # time stamp error: absolute, and relative for float32
_FILES_AT_A_TIME = 4  # how many files' rows stay in memory
_FOLLOW_THE_ROWS = "correct it, or follow the rows, as LeRobot's reader does: --task-column task_index"
_NUMBERS = re.compile(r"u?int\d+")
_WHOLE_OR_NOT = re.compile(r"halffloat|float|double")  # whole numbers become floats beside missing values
_SENTENCES = re.compile(r"(dictionary<values=)?(large_)?string\b.*")
_IDENTITY = ("index", "episode_index", "frame_index")
_STYLE = "subtask"
_PANDAS_INDEX = "__index_level_0__"  # pandas' column name for an unnamed index


@dataclass(frozen=True, eq=False)
class EpisodeRows:
    """The rows in one episode.

    times_s: float64 [T], rising, from the episode's start
    tasks: (first row, task) for each stretch of rows with the same task
    """

    first_index: int
    times_s: npt.NDArray[np.float64]
    tasks: Sequence[tuple[int, str]]

    def clock(self, fps: float) -> str:
        """Return a text that identifies the times, because they decide the frames; empty for multiples of 1 / fps."""
        is_regular = np.allclose(self.times_s, np.arange(len(self.times_s)) / fps, rtol=_FLOAT32, atol=_REGULAR_S)
        return "" if is_regular else f" {digest_of([self.times_s.tobytes()])}"


class RowReader:
    """Reads and checks rows. Caches the columns from the latest files.

    data: folder with all rows
    tasks: sentences by number
    given: the caller's task
    hub: downloads missing files; None for a local dataset
    """

    def __init__(self, data: Path, tasks: Sentences, given: TaskOverride, hub: HubFiles | None = None) -> None:
        self._data = data
        self._hub = hub
        self._tasks = tasks
        self._given = given
        self._columns = lru_cache(_FILES_AT_A_TIME)(_read_columns)

    def read(self, entry: Entry) -> EpisodeRows:
        """Read the episode's rows. Raises DatasetError if they contradict its metadata."""
        file = self.file_of(entry)
        columns = self._columns(file, self._tasks.column)
        own = np.flatnonzero(columns["episode_index"] == entry.index)
        rows = {name: columns[name][own] for name in _ROW_COLUMNS}
        where, num_rows = f"{entry.where}: {file}", len(own)
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

    def file_of(self, entry: Entry) -> Path:
        """Return the file with the episode's rows. Raises DatasetError if the file in the metadata is unreadable.

        LeRobot 0.4.0's converter could name the previous file. LeRobot does not notice, since it reads all files and
        selects by ``episode_index``.
        """
        if self._hub is not None:
            self._hub.download([entry.data_file])
        stored = self._columns(entry.data_file, self._tasks.column)["episode_index"]
        return entry.data_file if (stored == entry.index).any() else self._files.get(entry.index, entry.data_file)

    @cached_property
    def _files(self) -> Mapping[int, Path]:
        """File by episode number; broken files are skipped."""
        found: dict[int, Path] = {}
        if self._hub is not None:
            self._hub.download_folder(self._data)
        for file in sorted(self._data.rglob("*.parquet")):
            with suppress(DatasetError):
                numbers = read_table(file, ["episode_index"])["episode_index"]
                found |= dict.fromkeys(numbers.unique().to_pylist(), file)
        return found

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


def _read_columns(file: Path, task_column: str) -> Mapping[str, Any]:
    """Read a file's columns; integers become int64, and missing ones -1."""
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


@dataclass(frozen=True)
class Sentences:
    """How to interpret a column's values.

    table: the sentence table's name, for messages
    by_number: sentences by number
    """

    column: str = TASK_COLUMN
    table: str = "meta/tasks"
    by_number: Mapping[int, str | None] = field(default_factory=dict)

    def find(self, value: Any) -> tuple[str, Any]:
        """Return the sentence for a value, after its place for messages."""
        if value is None or isinstance(value, str):
            return self.column, value
        sentence = self.by_number.get(int(value)) if float(value).is_integer() else value
        return f"{self.column.removesuffix('_index')} {value} in {self.table}", sentence


def table_of(info: Info, column: str) -> tuple[Path, str]:
    """Return a column's sentence table, and the key for its sentences.

    ``subtask_index`` refers to ``meta/subtasks`` if that exists; other columns refer to ``meta/tasks``.
    """
    tasks = info.root / "meta" / ("tasks.parquet" if info.version == "v3.0" else "tasks.jsonl")
    name = column.removesuffix("_index")
    own = tasks.with_name(f"{name}s{tasks.suffix}")
    return (own, name) if name != column and own.is_file() else (tasks, "task")


def _by_number(file: Path, sentences: Iterable[tuple[int, str | None]]) -> dict[int, str | None]:
    found: dict[int, str | None] = {}
    for number, sentence in sentences:
        known = found.setdefault(number, sentence)
        require(file, known == sentence, f"one sentence for the number {number}", f"{known!r} and {sentence!r}")
    return found


def has_numbers(file: Path, types: Mapping[str, str], column: str) -> bool:
    """True if a column has numbers, False if it has sentences or subtasks. Raises DatasetError for another column.

    file: row table, for messages
    types: column types, as pyarrow names them
    """
    usable = {name: kind for name, kind in types.items() if _is_usable(kind) and name not in _IDENTITY}
    candidates = [name for name, kind in usable.items() if not _WHOLE_OR_NOT.fullmatch(kind)]
    require("task_column", column in usable, f"one of {', '.join(candidates)}", f"{column!r} in {file}")
    return bool(_NUMBERS.fullmatch(usable[column]) or _WHOLE_OR_NOT.fullmatch(usable[column]))


def values_of(column: Any) -> Any:
    """Convert a pyarrow column to whole numbers or objects. A subtask column stays as it is."""
    kind = str(column.type)
    if _is_language(kind):
        return column
    if kind.startswith("dictionary"):
        column = column.cast(column.type.value_type)
    values = column.to_numpy()
    if values.dtype.kind != "f":
        return values
    return np.array([None if np.isnan(value) else value for value in values.tolist()], dtype=object)


def values_in(where: str, column: Any, own: npt.NDArray[np.int64], times_s: npt.NDArray[np.float64]) -> Any:
    """Return one value per row in the episode, [T]. Raises DatasetError for two subtasks at one time.

    column: as ``values_of`` returns it
    own: int64 [T], positions of the episode's rows
    times_s: float64 [T], row times
    """
    if isinstance(column, np.ndarray):
        return column[own]
    stored: Sequence[Mapping[str, Any]] = column[int(own[0])].as_py() or []  # the same in all rows of an episode
    content_at = {row["timestamp"]: row["content"] for row in stored if row["style"] == _STYLE}
    is_one = all(content_at[row["timestamp"]] == row["content"] for row in stored if row["style"] == _STYLE)
    require(where, is_one, f"one {_STYLE} at a time", "several")
    starts_s = sorted(content_at)
    contents = [None, *(content_at[start_s] for start_s in starts_s)]
    return np.array([contents[k] for k in np.searchsorted(starts_s, times_s, side="right")], dtype=object)


def _is_usable(kind: str) -> bool:
    return any(each.fullmatch(kind) for each in (_NUMBERS, _WHOLE_OR_NOT, _SENTENCES)) or _is_language(kind)


def _is_language(kind: str) -> bool:
    fields = set(re.findall(r"(\w+): ", kind))
    return "list<" in kind and {"content", "style", "timestamp"} <= fields


def read_sentences(file: Path, name: str = "task") -> dict[int, str | None]:
    """Read sentences by number from a table in ``meta``. Raises DatasetError.

    name: key for the sentences in JSON lines; the key for the numbers is ``<name>_index``

    In Parquet, the sentences are a pandas index, whose column name depends on the writer's version.
    """
    if file.suffix != ".parquet":
        lines = [(number_in(where, line, f"{name}_index"), line.get(name, "")) for where, line in json_lines(file)]
        return _by_number(file, lines)
    columns: dict[str, list[Any]] = read_table(file).to_pydict()
    numbers = columns.pop(f"{name}_index", None)
    texts = {
        column: values
        for column, values in columns.items()
        if all(value is None or isinstance(value, str) for value in values)
    }
    of_pandas = next((column for column in (_PANDAS_INDEX, name) if column in texts), None)
    column = of_pandas or (next(iter(texts)) if len(texts) == 1 else None)
    got = f"{'no ' * (numbers is None)}{name}_index and {len(texts)} of them"
    require(file, numbers is not None and column is not None, f"{name}_index and one column of sentences", got)
    return _by_number(file, list(zip(numbers or (), texts[column or ""], strict=True)))
