# SPDX-License-Identifier: MIT
"""Readers: functions of users that yield the episodes of a folder. T frames, H x W pixels."""

from __future__ import annotations

import runpy
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeAlias

from rfm_labels.datasets.dataset import AskedCorrections, TaskOverride
from rfm_labels.datasets.episodes import Episode, EpisodeDataset
from rfm_labels.datasets.faults import faults_of_reader, require

Reader: TypeAlias = Callable[[Path], Iterable[Episode]]
_MODULE = "rfm_reader"  # the name of a reader's module


def open_read(reader: str | Reader, folder: Path, task: TaskOverride, corrections: AskedCorrections) -> EpisodeDataset:
    """Call a reader, and return its episodes as a dataset. Raises DatasetError."""
    name = _name_of(reader)
    return EpisodeDataset(read_episodes(reader, folder), folder, f"reader {name}", name, task, corrections)


def read_episodes(reader: str | Reader, folder: Path) -> Iterator[Episode]:
    """Yield a reader's episodes. Raises DatasetError, for an error in the reader with its line."""
    require(folder, folder.is_dir(), "the folder of the recordings, which the reader is called with", "none")
    function, where = reader_named(reader) if isinstance(reader, str) else reader, f"reader: {_name_of(reader)}"
    with faults_of_reader(where):
        for episode in function(folder):
            expected = "rfm_labels.Episode(name, frames) of each recording"
            require(where, isinstance(episode, Episode), expected, type(episode).__name__)
            yield episode


def _name_of(reader: str | Reader) -> str:
    """The file's and the function's name, which are the same on every machine."""
    return Path(reader).name if isinstance(reader, str) else getattr(reader, "__name__", type(reader).__name__)


def reader_named(name: str) -> Reader:
    """Return the function that ``FILE.py:FUNCTION`` names. Raises DatasetError."""
    path, _, function = name.rpartition(":")
    file = Path(path)
    is_name = is_reader(name) and function.isidentifier()
    require("reader", is_name, "FILE.py:FUNCTION, such as my_reader.py:episodes", repr(name))
    require(f"reader: {file}", file.is_file(), "a Python file", "none")
    with faults_of_reader(f"reader: {file}"):
        found = runpy.run_path(str(file), run_name=_MODULE)
    reader: Reader = found.get(function)  # type: ignore[assignment]  # checked below
    known = [each for each, value in found.items() if getattr(value, "__module__", "") == _MODULE]
    require(f"reader: {file}", callable(reader), f"a function {function}", ", ".join(known) or "none")
    return reader


def is_reader(text: str) -> bool:
    """True for a text that names a reader, ``FILE.py:FUNCTION``."""
    return text.rpartition(":")[0].endswith(".py")
