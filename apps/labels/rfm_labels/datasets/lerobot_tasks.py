# SPDX-License-Identifier: MIT
"""Read the LeRobot column that names the task of each frame, and the sentences behind its numbers.

A column has sentences, numbers of sentences in a table of ``meta``, or LeRobot's ``language_persistent``, in which each
entry with the style ``subtask`` holds from its time on. T rows of an episode.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_labels.datasets.protocol import require

TASK_COLUMN = "task_index"

_NUMBERS = re.compile(r"u?int\d+")
_WHOLE_OR_NOT = re.compile(r"halffloat|float|double")  # numbers beside missing values
_SENTENCES = re.compile(r"(dictionary<values=)?(large_)?string\b.*")
_IDENTITY = ("index", "episode_index", "frame_index")
_STYLE = "subtask"


@dataclass(frozen=True)
class Sentences:
    """What the values of a column mean.

    table: name of the sentence table, for messages
    by_number: sentences by number
    """

    column: str = TASK_COLUMN
    table: str = "meta/tasks"
    by_number: Mapping[int, str | None] = field(default_factory=dict)

    def find(self, value: Any) -> tuple[str, Any]:
        """Return where the sentence of a value is, for messages, and the sentence."""
        if value is None or isinstance(value, str):
            return self.column, value
        sentence = self.by_number.get(int(value)) if float(value).is_integer() else value
        return f"{self.column.removesuffix('_index')} {value} in {self.table}", sentence


def table_of(root: Path, tasks_file: Path, column: str) -> tuple[Path, str]:
    """Return the sentence table of a column, and the name of the sentences in it.

    ``subtask_index`` has numbers of ``meta/subtasks`` if that exists; other columns have numbers of ``meta/tasks``.
    """
    name = column.removesuffix("_index")
    own = tasks_file.with_name(f"{name}s{tasks_file.suffix}")
    return (own, name) if name != column and (root / own).is_file() else (tasks_file, "task")


def by_number(file: Path, sentences: Iterable[tuple[int, str | None]]) -> dict[int, str | None]:
    """Return each sentence by its number. Raises DatasetError for a number with two sentences."""
    found: dict[int, str | None] = {}
    for number, sentence in sentences:
        known = found.setdefault(number, sentence)
        require(file, known == sentence, f"one sentence for the number {number}", f"{known!r} and {sentence!r}")
    return found


def has_numbers(file: Path, types: Mapping[str, str], column: str) -> bool:
    """True if a column has numbers, False if it has sentences or subtasks. Raises DatasetError for another column.

    file: table of rows, for messages
    types: column types, as pyarrow names them
    """
    usable = {name: kind for name, kind in types.items() if _is_usable(kind) and name not in _IDENTITY}
    candidates = [name for name, kind in usable.items() if not _WHOLE_OR_NOT.fullmatch(kind)]
    require(f"{file}: task_column", column in usable, f"one of {', '.join(candidates)}", repr(column))
    return bool(_NUMBERS.fullmatch(usable[column]) or _WHOLE_OR_NOT.fullmatch(usable[column]))


def values_of(column: Any) -> Any:
    """Return the values of a pyarrow column: whole numbers, or objects. A column of subtasks stays as it is."""
    kind = str(column.type)
    if _is_language(kind):
        return column
    if kind.startswith("dictionary"):
        column = column.cast(column.type.value_type)
    values = column.to_numpy()
    if values.dtype.kind != "f":
        return values
    return np.array([None if np.isnan(value) else value for value in values], dtype=object)


def values_in(where: str, column: Any, own: npt.NDArray[np.int64], times_s: npt.NDArray[np.float64]) -> Any:
    """Return the values of an episode's rows, an array [T]. Raises DatasetError for two subtasks at one time.

    column: as ``values_of`` returns it
    own: int64 [T], positions of the episode's rows
    times_s: float64 [T], times of the rows
    """
    if isinstance(column, np.ndarray):
        return column[own]
    stored: Sequence[Mapping[str, Any]] = column[int(own[0])].as_py() or []  # the same in all rows of an episode
    told = {row["timestamp"]: row["content"] for row in stored if row["style"] == _STYLE}
    is_one = all(told[row["timestamp"]] == row["content"] for row in stored if row["style"] == _STYLE)
    require(where, is_one, f"one {_STYLE} at a time", "several")
    starts_s = sorted(told)
    contents = [None, *(told[start_s] for start_s in starts_s)]
    return np.array([contents[k] for k in np.searchsorted(starts_s, times_s, side="right")], dtype=object)


def _is_usable(kind: str) -> bool:
    return any(each.fullmatch(kind) for each in (_NUMBERS, _WHOLE_OR_NOT, _SENTENCES)) or _is_language(kind)


def _is_language(kind: str) -> bool:
    fields = set(re.findall(r"(\w+): ", kind))
    return "list<" in kind and {"content", "style", "timestamp"} <= fields
