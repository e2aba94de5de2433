# SPDX-License-Identifier: MIT
"""A folder of videos, one for each episode, with their tasks in ``tasks.csv`` or ``tasks.json``. Needs PyAV.

The CSV file has the columns ``video`` and ``task``; a task with a comma is in quotes. The JSON file is
``{"video.mp4": "put the block in the bowl"}``. Paths are relative to the table, whose order is the order of the
episodes. Every frame of a video counts.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping, Sequence, Set
from functools import lru_cache
from pathlib import Path

from rfm_client.contract.samples import UInt8Array
from rfm_client.data.datasets.protocol import (
    Dataset,
    DatasetEpisode,
    DatasetError,
    TaskOverride,
    chosen_cameras,
    orientations_of,
    require,
)
from rfm_client.data.datasets.video_frames import Span, decode, video_identity, video_packets
from rfm_client.data.lerobot_videos import check_local_video
from rfm_client.data.orientation import Orient
from rfm_client.data.video_decoding import decoder

TABLES = ("tasks.csv", "tasks.json")

_FILES_AT_A_TIME = 4


class VideoFolder(Dataset):
    """Videos and their tasks. table: the table of tasks, or its folder"""

    kind = "videos"
    cameras = ("video",)

    def __init__(self, table: Path, *, task: TaskOverride = TaskOverride(), orient: Orient = Orient()) -> None:
        self._table = _table_in(table) if table.is_dir() else table
        self.root = self._table.parent
        self.source = self.root.resolve().name
        self._packets = lru_cache(_FILES_AT_A_TIME)(video_packets)
        self._task = task
        self.orientations = orientations_of(orient, self.cameras)
        self._tasks = _read(self._table, {"video"} if task.text else {"video", "task"})

    def read_episodes(self) -> Sequence[DatasetEpisode]:
        episodes: list[DatasetEpisode] = []
        first = 0
        for index, (name, own) in enumerate(self._tasks.items()):
            task = self._task.of(f"{self._table}: {name}", own)
            check_local_video(self.root / name)
            num_frames = len(self._packets(self.root / name).times_s)
            require(self.root / name, num_frames > 0, "frames", "none")
            episodes.append(DatasetEpisode(index, name, task.strip(), num_frames, first))
            first += num_frames
        self._task.check_used(episodes)
        return episodes

    def decoder(self, camera: str) -> str | None:
        return decoder()

    def identity(self, episode: DatasetEpisode, camera: str, *, verify: bool) -> str:
        return video_identity(self.root / episode.name, verify=verify)

    def check(self, episode: DatasetEpisode, camera: str) -> int:
        chosen_cameras(self, [camera])
        return sum(self._packets(self.root / episode.name).num_bytes)

    def stored_frames(self, episode: DatasetEpisode, camera: str) -> Iterator[UInt8Array]:
        file = self.root / episode.name
        times_s = self._packets(file).times_s
        gaps_s = times_s[1:] - times_s[:-1]
        tolerance_s = 0.5 * float(gaps_s.min()) if len(gaps_s) else 0.5
        return decode(Span(file, times_s, tolerance_s, episode.name))


def _table_in(folder: Path) -> Path:
    found = [folder / name for name in TABLES if (folder / name).is_file()]
    all_of_one = f'(cd {folder}; (echo video; ls *.mp4) > tasks.csv) and --task "SENTENCE"'
    got = "both" if found else f"none: write it, or, if all videos have one task, {all_of_one}"
    require(folder, len(found) == 1, f"one of {' and '.join(TABLES)} with the task of each video", got)
    return found[0]


def _read(table: Path, required: Set[str]) -> Mapping[str, str | None]:
    """The task of each video, by path; None: no task. required: columns of a CSV file"""
    try:
        text = table.read_text(encoding="utf-8-sig")  # spreadsheets put a byte order mark first
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError.at(table, "a readable table of tasks", error) from error
    return _from_json(table, text) if table.suffix.lower() == ".json" else _from_csv(table, text, required)


def _from_json(table: Path, text: str) -> Mapping[str, str | None]:
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DatasetError.at(table, "JSON", error) from error
    if not isinstance(document, dict) or not document:
        raise DatasetError.at(table, "an object of tasks by video", type(document).__name__)
    return document


def _from_csv(table: Path, text: str, required: Set[str]) -> Mapping[str, str | None]:
    rows = csv.DictReader(text.splitlines())
    columns = rows.fieldnames or ()
    got = f"{', '.join(columns) or 'none'} (--task stands for the column task)"
    require(table, not required - set(columns), "the columns video and task", got)
    tasks: dict[str, str | None] = {}
    for row in rows:
        where = f"{table}: line {rows.line_num}"
        num_cells = sum(isinstance(cell, str) for cell in row.values()) + len(row.get(None, ()))  # in no column
        require(where, num_cells == len(columns), f"{len(columns)} cells (text with a comma in quotes)", num_cells)
        require(where, row["video"] not in tasks, "each video once", row["video"])
        tasks[row["video"]] = row.get("task")
    require(table, bool(tasks), "at least one video", "none")
    return tasks
