# SPDX-License-Identifier: MIT
"""The tasks of a folder's episodes.

``tasks.csv`` lists a folder's episodes in order. The columns ``video`` (or ``episode``) and ``task`` are separated by
commas, semicolons or tabs. Quote a task that contains the separator. Paths are relative to the table.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping
from pathlib import Path, PurePath

from rfm_labels.datasets.faults import DatasetError, FaultsError, require, shortened

TABLE = "tasks.csv"

_NAMES = ("video", "episode")  # column names for the path
_DELIMITERS = ",;\t"


def read_table_of_tasks(table: Path, *, has_tasks: bool) -> Mapping[str, str | None]:
    """Read tasks by episode path; None: no task. Raises DatasetError, which lists all faulty lines.

    has_tasks: True: the file needs the column ``task``
    """
    faults, tasks = list[str](), dict[str, str | None]()
    columns, rows = read_csv(table)
    name = next((column for column in _NAMES if column in columns), _NAMES[0])
    is_whole = name in columns and ("task" in columns or not has_tasks)
    got = f"{', '.join(columns) or 'none'} (--task stands for the column task)"
    require(table, is_whole, f"the columns {name} and task", got)
    for where, row in rows:
        cells = dict(zip(columns, row, strict=False))
        if len(row) != len(columns):
            expected = f"{len(columns)} cells (text with a comma in quotes)"
            faults.append(f"{where}: expected {expected}, got {len(row)}")
        elif not cells[name].strip():
            faults.append(f"{where}: expected the path of a {name}, got none")
        elif (path := _normal(table.parent, cells[name])) in tasks:
            faults.append(f"{where}: expected each {name} once, got {cells[name]}")
        else:
            tasks[path] = cells.get("task")
    if faults:
        raise FaultsError("\n".join(shortened(faults)))
    require(table, bool(tasks), "at least one video", "none")
    return tasks


def read_csv(table: Path) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Return a table's columns, in lower case, and the place and cells of each row that is not blank.

    Commas, semicolons or tabs separate the cells. Raises DatasetError.
    """
    try:
        text = table.read_text(encoding="utf-8-sig")  # spreadsheets put a byte order mark first
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError.at(table, "a readable CSV file", error) from error
    header = text.partition("\n")[0]
    delimiter = next((each for each in _DELIMITERS if each in header), _DELIMITERS[0])
    rows = csv.reader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True, strict=True)
    try:
        columns = [cell.strip().lower() for cell in next(rows, [])]
        return columns, [(f"{table}: line {rows.line_num}", row) for row in rows if any(map(str.strip, row))]
    except csv.Error as error:
        where = f"{table}: line {rows.line_num}"
        raise DatasetError.at(where, 'quotes around a whole cell, and "" for a quote in it', error) from error


def _normal(root: Path, path: str) -> str:
    """Remove ``./``, outer spaces and Windows backslashes, so that equal paths compare equal."""
    path = path.strip()
    if "\\" in path and not (root / path).exists():
        path = path.replace("\\", "/")
    return PurePath(os.path.normpath(path)).as_posix()
