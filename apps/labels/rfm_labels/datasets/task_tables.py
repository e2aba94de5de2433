# SPDX-License-Identifier: MIT
"""Read ``tasks.csv`` and ``tasks.json``, which list the episodes of a folder with their tasks.

The CSV file has the columns ``video`` (or ``episode``) and ``task``, between commas, semicolons or tabs; a task with a
comma is in quotes. The JSON file is ``{"video.mp4": "put the block in the bowl"}``. Paths are relative to the table,
whose order is the order of the episodes.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
from collections.abc import Iterator, Mapping, Set
from pathlib import Path, PurePath
from typing import Any, TypeAlias

from rfm_labels.datasets.faults import DatasetError, FaultsError, require, shortened

TABLES = ("tasks.csv", "tasks.json")

_NAMES = ("video", "episode")  # columns of the path
_DELIMITERS = ",;\t"

_Line: TypeAlias = tuple[str, str, Any]  # place, path and task


def table_in(folder: Path) -> Path | None:
    """Return the table of tasks in a folder; None: it has none. Raises DatasetError for two tables."""
    found = [folder / name for name in TABLES if (folder / name).is_file()]
    require(folder, len(found) < 2, f"one of {' and '.join(TABLES)}", "both")
    return found[0] if found else None


def read_table_of_tasks(table: Path, *, has_tasks: bool) -> Mapping[str, Any]:
    """Return the task of each episode, by path; None: no task. Raises DatasetError, which lists all faulty lines.

    has_tasks: True: a CSV file needs the column ``task``
    """
    try:
        text = table.read_text(encoding="utf-8-sig")  # spreadsheets put a byte order mark first
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError.at(table, "a readable table of tasks", error) from error
    faults: list[str] = []
    is_json = table.suffix.lower() == ".json"
    name, lines = ("video", _from_json(table, text)) if is_json else _from_csv(table, text, has_tasks, faults)
    tasks: dict[str, Any] = {}
    for where, path, task in lines:
        if not path.strip():
            faults.append(f"{where}: expected the path of a {name}, got none")
        elif (known := _normal(table.parent, path)) in tasks:
            faults.append(f"{where}: expected each {name} once, got {path}")
        else:
            tasks[known] = task
    if faults:
        raise FaultsError.listing(shortened(faults))
    require(table, bool(tasks), "at least one video", "none")
    return tasks


def _normal(root: Path, path: str) -> str:
    """A path without ``./``, outer spaces or Windows backslashes, so that paths of the same file are equal."""
    path = path.strip()
    if "\\" in path and not (root / path).exists():
        path = path.replace("\\", "/")
    return PurePath(os.path.normpath(path)).as_posix()


def _from_json(table: Path, text: str) -> Iterator[_Line]:
    try:
        document = json.loads(text, object_pairs_hook=tuple)  # a dict would keep the last of equal keys
    except (ValueError, RecursionError) as error:
        raise DatasetError.at(table, "JSON", error) from error
    got = "an empty one" if document == () else type(document).__name__
    require(table, isinstance(document, tuple) and bool(document), "an object of tasks by video", got)
    return ((str(table), path, task) for path, task in document)


def _from_csv(table: Path, text: str, has_tasks: bool, faults: list[str]) -> tuple[str, Iterator[_Line]]:
    """The name of the path column, and the lines."""
    first, _, _ = text.partition("\n")
    delimiter = next((each for each in _DELIMITERS if not set(_header(first, each)).isdisjoint(_NAMES)), ",")
    columns = _header(first, delimiter)
    name = next((column for column in _NAMES if column in columns), _NAMES[0])
    required: Set[str] = {name, "task"} if has_tasks else {name}
    got = f"{', '.join(columns) or 'none'} (--task stands for the column task)"
    require(table, not required - set(columns), f"the columns {name} and task", got)
    return name, _lines(table, text, delimiter, columns, name, faults)


def _header(line: str, delimiter: str) -> list[str]:
    return [cell.strip().lower() for cell in next(csv.reader([line], delimiter=delimiter), [])]


def _lines(table: Path, text: str, delimiter: str, columns: list[str], name: str, faults: list[str]) -> Iterator[_Line]:
    """The lines below the header, except lines with a wrong number of cells, which go to ``faults``."""
    has_blanks = re.search(f'{delimiter} +"', text) is not None  # before a quote they would make it a part of the text
    rows = csv.reader(io.StringIO(text), delimiter=delimiter, skipinitialspace=has_blanks, strict=True)
    try:
        next(rows)
        for row in rows:
            where = f"{table}: line {rows.line_num}"
            if not any(map(str.strip, row)):
                continue
            if len(row) != len(columns):
                expected = f"{len(columns)} cells (text with a comma in quotes)"
                faults.append(f"{where}: expected {expected}, got {len(row)}")
                continue
            cells = dict(zip(columns, row, strict=True))
            yield where, cells[name], cells.get("task")
    except csv.Error as error:
        where = f"{table}: line {rows.line_num}"
        raise DatasetError.at(where, 'quotes around a whole cell, and "" for a quote in it', error) from error
