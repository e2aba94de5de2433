# SPDX-License-Identifier: MIT
"""Folders of videos with a table of tasks, and the tasks that a caller gives for any dataset."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from pyarrow import parquet

from labelling import LEROBOT, BrightnessScorer
from pictures import numbered, numbers, write_video
from rfm_client.labelling import DatasetError, LabelOptions, label, open_dataset


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    folder = tmp_path / "videos"
    (folder / "day").mkdir(parents=True)
    write_video(folder / "b.mp4", numbered(6))
    write_video(folder / "day" / "a.mp4", numbered(4), times=[0, 1, 5, 6])
    return folder


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("tasks.csv", "task,video\nstack the cups,b.mp4\nopen the box,day/a.mp4\n"),
        ("tasks.json", '{"b.mp4": "stack the cups", "day/a.mp4": "open the box"}'),
    ],
)
def test_a_folder_of_videos_is_read_in_the_order_of_its_table(videos: Path, name: str, text: str, output: Path) -> None:
    (videos / name).write_text(text)
    dataset = open_dataset(videos)
    assert open_dataset(videos / name).episodes == dataset.episodes
    assert [(e.name, e.task, e.num_frames, e.first_index) for e in dataset.episodes] == [
        ("b.mp4", "stack the cups", 6, 0),
        ("day/a.mp4", "open the box", 4, 6),
    ]
    for episode in dataset.episodes:
        film = np.stack(list(dataset.frames(episode, "video")))
        assert numbers(film, episode.num_frames) == list(range(episode.num_frames))
    report = label(dataset, BrightnessScorer(), LabelOptions(output=output))
    assert parquet.read_table(report.files[0])["episode_index"].to_pylist() == [0] * 6 + [1] * 4


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("tasks.csv", '\ufeffvideo,task\r\nb.mp4,"put the block in the bowl, then close the lid"\r\n'),
        ("tasks.csv", 'video,task\nb.mp4," put the block in the bowl, then close the lid "\n'),
        ("tasks.json", '{"b.mp4": "put the block in the bowl, then close the lid\\n"}'),
    ],
)
def test_a_task_may_have_commas_and_loses_the_blanks_around_it_and_the_table_its_byte_order_mark(
    videos: Path, name: str, text: str
) -> None:
    (videos / name).write_text(text)
    assert [e.task for e in open_dataset(videos).episodes] == ["put the block in the bowl, then close the lid"]


REFUSED = {
    "no table": (None, "", "expected one of tasks.csv and tasks.json with the task of each video, got none"),
    "no column of tasks": ("tasks.csv", "video\nb.mp4\n", "expected the columns video and task, got video"),
    "a video twice": ("tasks.csv", "video,task\nb.mp4,a\nb.mp4,b\n", "line 3: expected each video once, got b.mp4"),
    "no task": ("tasks.csv", "video,task\nb.mp4,\n", "b.mp4: expected a task as a sentence, got none"),
    "a task of blanks": ("tasks.csv", "video,task\nb.mp4,  \n", "b.mp4: expected a task as a sentence, got '  '"),
    "a comma without quotes": (
        "tasks.csv",
        "video,task\nday/a.mp4,a\nb.mp4,put the block in the bowl, then close the lid\n",
        "tasks.csv: line 3: expected 2 cells (text with a comma in quotes), got 3",
    ),
    "a row that ends early": (
        "tasks.csv",
        "video,note,task\nb.mp4,blue\n",
        "tasks.csv: line 2: expected 3 cells (text with a comma in quotes), got 2",
    ),
    "a video that is missing": ("tasks.json", '{"c.mp4": "a"}', "c.mp4: expected a video file, got none"),
    "no JSON": ("tasks.json", "{", "tasks.json: expected JSON, got "),
}


@pytest.mark.parametrize(("name", "text", "message"), REFUSED.values(), ids=REFUSED)
def test_a_table_of_videos_that_is_wrong_is_refused(videos: Path, name: str | None, text: str, message: str) -> None:
    if name is not None:
        (videos / name).write_text(text)
    with pytest.raises(DatasetError) as caught:
        _ = open_dataset(videos).episodes
    assert message in str(caught.value)


def lerobot(folder: Path, *tasks: str) -> Path:
    """A dataset whose first episodes have these tasks."""
    root = shutil.copytree(LEROBOT / "toy_v21", folder / "toy")
    lines = (root / "meta" / "tasks.jsonl").read_text().splitlines()
    lines[: len(tasks)] = [json.dumps({"task_index": index, "task": task}) for index, task in enumerate(tasks)]
    (root / "meta" / "tasks.jsonl").write_text("\n".join(lines))
    for file in (root / "meta").glob("episodes.jsonl"):
        episodes = [json.loads(line) for line in file.read_text().splitlines()]
        file.write_text("\n".join(json.dumps({**episode, "tasks": []}) for episode in episodes))
    return root


def hdf5(folder: Path, task: str) -> Path:
    with h5py.File(folder / "demos.hdf5", "w") as opened:
        opened.create_group("data").attrs["env_args"] = json.dumps({"env_name": "Lift", "lang": task})
        opened["data/demo_0/obs/front"] = np.zeros((3, 8, 8, 3), np.uint8)
    return folder / "demos.hdf5"


def table(folder: Path, text: str) -> Path:
    for name in ("a.mp4", "b.mp4"):
        write_video(folder / name, numbered(3))
    (folder / "tasks.csv").write_text(text)
    return folder


WITH_TASKS: dict[str, Callable[[Path], Path]] = {
    "LeRobot": lambda folder: lerobot(folder, "stack the cups"),
    "HDF5": lambda folder: hdf5(folder, "stack the cups"),
    "videos": lambda folder: table(folder, "video,task\na.mp4,stack the cups\nb.mp4,stack the cups\n"),
}
TOY_TASKS = [episode.task for episode in open_dataset(LEROBOT / "toy_v21").episodes]
WITHOUT_TASKS: dict[str, tuple[Callable[[Path], Path], list[str]]] = {
    "LeRobot": (
        lambda folder: lerobot(folder, " "),
        ["open the box" if task == TOY_TASKS[0] else task for task in TOY_TASKS],
    ),
    "HDF5": (lambda folder: hdf5(folder, ""), ["open the box"]),
    "videos, an empty cell": (
        lambda folder: table(folder, "video,task\na.mp4,\nb.mp4,stack the cups\n"),
        ["open the box", "stack the cups"],
    ),
    "videos, no column": (lambda folder: table(folder, "video\na.mp4\nb.mp4\n"), ["open the box"] * 2),
}


@pytest.mark.parametrize(("make", "expected"), WITHOUT_TASKS.values(), ids=WITHOUT_TASKS)
def test_a_task_fills_in_where_episodes_have_none(
    tmp_path: Path, make: Callable[[Path], Path], expected: list[str]
) -> None:
    source = make(tmp_path)
    with pytest.raises(DatasetError, match="--task"):
        _ = open_dataset(source).episodes
    assert [episode.task for episode in open_dataset(source, task="open the box").episodes] == expected


@pytest.mark.parametrize("make", WITH_TASKS.values(), ids=WITH_TASKS)
def test_a_task_replaces_those_of_episodes_only_on_request(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    source = make(tmp_path)
    with pytest.raises(DatasetError) as refused:
        _ = open_dataset(source, task="open the box").episodes
    assert str(refused.value) == (
        "task: expected none for episodes that all have tasks of their own, got 'open the box': leave it out, or put it "
        "in the place of theirs with --override-task"
    )
    told = {episode.task for episode in open_dataset(source, task="open the box", override_task=True).episodes}
    assert told == {"open the box"}


@pytest.mark.parametrize(("task", "got"), [(None, "none"), ("", "''"), (" ", "' '")])
def test_a_task_that_replaces_others_is_a_sentence(videos: Path, task: str | None, got: str) -> None:
    with pytest.raises(DatasetError, match=f"^task: expected a sentence, got {got}$"):
        open_dataset(videos, task=task, override_task=True)
