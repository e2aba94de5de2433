# SPDX-License-Identifier: MIT
"""A folder with a file, or a folder, for each episode, and the tasks in ``tasks.csv`` or ``tasks.json``.

The CSV file has the columns ``video`` (or ``episode``) and ``task``, between commas, semicolons or tabs; a task with a
comma is in quotes. The JSON file is ``{"video.mp4": "put the block in the bowl"}``. Paths are relative to the table,
whose order is the order of the episodes. Without a table, the caller names the task, and the order is that of the
names, with 2 before 10.
"""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rfm_client import RewardError
from rfm_client.frames import Corrections
from rfm_labels.datasets.protocol import (
    Dataset,
    DatasetEpisode,
    TaskOverride,
    corrections_of,
    require,
)
from rfm_labels.datasets.sentences import one_line

TABLES = ("tasks.csv", "tasks.json")


@dataclass(frozen=True)
class Contents:
    """The episodes of a folder, and what the caller says of them.

    root: folder to which the names are relative
    tasks: each episode's task by its path; None: no task
    table: file of the tasks, or the folder, for messages
    """

    root: Path
    tasks: Mapping[str, Any]
    table: Path
    task: TaskOverride
    corrections: Corrections


class EpisodeFiles(Dataset):
    """Episodes in files or folders of their own."""

    def __init__(self, contents: Contents) -> None:
        self.root = contents.root
        self.source = contents.root.resolve().name
        self.corrections = corrections_of(contents.corrections, self.cameras)
        self.given_task = contents.task
        self.numbers = range(len(contents.tasks))
        self._contents, self._names = contents, list(contents.tasks)
        self._lengths: dict[str, int] = {}
        self._firsts = [0]

    def read_episode(self, number: int) -> DatasetEpisode:
        """Read an episode, and count the frames before it; a broken one before it has none. Raises DatasetError."""
        name = self._names[number]
        own = self._contents.tasks[name] or self.own_task(self.root / name)
        task = self.given_task.of(f"{self._contents.table}: {name}", own)
        num_frames = self._length(name)
        while len(self._firsts) <= number:
            self._firsts.append(self._firsts[-1] + self._length_or_0(self._names[len(self._firsts) - 1]))
        return DatasetEpisode(number, name, one_line(task), num_frames, self._firsts[number])

    def _length(self, name: str) -> int:
        if name not in self._lengths:
            self._lengths[name] = self.length(self.root / name)
            require(self.root / name, self._lengths[name] > 0, "frames", "none")
        return self._lengths[name]

    def _length_or_0(self, name: str) -> int:
        try:
            return self._length(name)
        except RewardError:  # raised again if this episode is read
            return 0

    @abstractmethod
    def length(self, file: Path) -> int:
        """Return the number of frames of an episode. Raises DatasetError."""

    def own_task(self, file: Path) -> str | None:
        """Return the task that an episode's file holds; None: it holds no task. Raises DatasetError."""
        return None


def in_natural_order(names: Iterable[str]) -> list[str]:
    """Return names of episodes, sorted with their numbers as integers: ``2`` before ``10``, ``1.2`` before ``1.10``.

    ``frame_names`` orders frames, whose numbers may be times.
    """

    def key(name: str) -> tuple[list[tuple[int, str]], str]:
        parts = re.split(r"(\d+)", name)
        return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], name

    return sorted(names, key=key)


def table_in(folder: Path) -> Path | None:
    """Return the table of tasks in a folder; None: it has none. Raises DatasetError for two tables."""
    found = [folder / name for name in TABLES if (folder / name).is_file()]
    require(folder, len(found) < 2, f"one of {' and '.join(TABLES)}", "both")
    return found[0] if found else None
