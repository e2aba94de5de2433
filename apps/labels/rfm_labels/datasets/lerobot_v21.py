# SPDX-License-Identifier: MIT
"""Episodes of LeRobot v2.0 and v2.1: each has a table, and a video of each camera."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rfm_client.options import checked_count
from rfm_labels.datasets.lerobot_rows import Entry, Info
from rfm_labels.datasets.lerobot_tasks import by_number
from rfm_labels.datasets.protocol import DatasetError, require

EPISODES_FILE = Path("meta", "episodes.jsonl")
TASKS_FILE = Path("meta", "tasks.jsonl")


def read_entries(info: Info) -> Iterator[tuple[int, Entry | DatasetError]]:
    """Yield the number of each episode with its metadata, or with their fault. Raises DatasetError."""
    for where, line in json_lines(info.root / EPISODES_FILE):
        index = _number(where, line, "episode_index")
        try:
            yield index, _entry(info, where, index, line)
        except DatasetError as error:
            yield index, error


def read_tasks(root: Path, file: Path = TASKS_FILE, name: str = "task") -> dict[int, str | None]:
    """Return each task's sentence by its number. Raises DatasetError.

    name: key of the sentences; that of the numbers is ``<name>_index``
    """
    lines = [(_number(where, line, f"{name}_index"), line.get(name, "")) for where, line in json_lines(root / file)]
    return by_number(root / file, lines)


def json_lines(file: Path) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield each object of a file of JSON lines, after its place for messages. Raises DatasetError."""
    try:
        texts = file.read_text(encoding="utf-8-sig").split("\n")  # a sentence may have other separators of lines
    except FileNotFoundError as error:
        raise DatasetError.at(file, "a file of JSON lines", "none") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError.at(file, "a readable file of JSON lines", str(error)) from error
    for number, text in enumerate(texts, 1):
        where = f"{file}: line {number}"
        if not text.strip():
            continue
        try:
            line = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise DatasetError.at(where, "a JSON object", str(error)) from error
        require(where, isinstance(line, dict), "a JSON object", type(line).__name__)
        yield where, line


def _entry(info: Info, where: str, index: int, line: Mapping[str, Any]) -> Entry:
    values = {"episode_chunk": index // info.chunks_size, "episode_index": index}
    tasks = line.get("tasks")
    return Entry(
        index=index,
        tasks=[task for task in tasks if isinstance(task, str)] if isinstance(tasks, list) else [],
        length=_number(where, line, "length"),
        first_index=None,
        data_file=info.path(info.data_path, **values),
        videos={key: (info.path(info.video_path, **values, video_key=key), 0.0) for key in info.videos},
    )


def _number(where: str, line: Mapping[str, Any], name: str) -> int:
    return checked_count(f"{where}: {name}", line.get(name), least=0, error=DatasetError)
