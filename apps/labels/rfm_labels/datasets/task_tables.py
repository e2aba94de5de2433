# SPDX-License-Identifier: MIT
"""Read ``tasks.csv``, which lists the episodes of a folder with their tasks, in their order.

Its columns ``video`` (or ``episode``) and ``task`` lie between commas, semicolons or tabs. A task with a comma is in
quotes. Paths are relative to the table.
"""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Iterator, Mapping, Set
from pathlib import Path, PurePath
from typing import TypeAlias

from rfm_labels.datasets.faults import DatasetError, FaultsError, require, shortened

TABLE = "tasks.csv"

_NAMES = ("video", "episode")  # columns of the path
_DELIMITERS = ",;\t"

_Line: TypeAlias = tuple[str, str, str | None]  # place, path and task


def read_table_of_tasks(table: Path, *, has_tasks: bool) -> Mapping[str, str | None]:
    """Return the task of each episode, by path; None: no task. Raises DatasetError, which lists all faulty lines.

    has_tasks: True: the file needs the column ``task``
    """
    try:
        text = table.read_text(encoding="utf-8-sig")  # spreadsheets put a byte order mark first
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError.at(table, "a readable table of tasks", error) from error
    faults: list[str] = []
    name, lines = _from_csv(table, text, has_tasks, faults)
    tasks: dict[str, str | None] = {}
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
