# SPDX-License-Identifier: MIT
"""Patterns for files below episode folders, and the pattern that a refusal prints for a layout."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from labelling import BrightnessScorer, Notes
from pictures import numbered, write_video
from rfm_labels import DatasetError, LabelOptions, label, open_dataset

TASK = "stack the cups"

LAYOUTS: dict[str, tuple[list[str], list[str], list[str], str]] = {  # files, episodes, cameras, printed pattern
    "AgiBot": (
        [
            f"observations/327/{episode}/videos/{camera}.mp4"
            for episode in (648642, 648649)
            for camera in ("hand_left", "head")
        ],
        ["observations/327/648642", "observations/327/648649"],
        ["hand_left", "head"],
        "{episode}/videos/{camera}.mp4",
    ),
    "Unitree": (
        [f"episode_000{n}/colors/{t:06d}_color_{c}.jpg" for n in range(2) for t in range(9, 12) for c in range(2)],
        ["episode_0000", "episode_0001"],
        ["color_0", "color_1"],
        "{episode}/colors/*_{camera}.jpg",
    ),
    "RLBench": (
        [
            f"variation0/episodes/episode{n}/{camera}_rgb/{t}.png"
            for n in (0, 2, 10)
            for camera in ("front", "wrist")
            for t in range(9, 12)
        ],
        ["variation0/episodes/episode0", "variation0/episodes/episode2", "variation0/episodes/episode10"],
        ["front_rgb", "wrist_rgb"],
        "{episode}/{camera}/*.png",
    ),
    "a folder for each camera": (
        [f"videos/{camera}/episode_{n}.mp4" for camera in ("front", "wrist") for n in (2, 10)],
        ["episode_2", "episode_10"],
        ["front", "wrist"],
        "videos/{camera}/{episode}.mp4",
    ),
    "one video below each folder": (
        [f"{day}/{n}/video.mp4" for day in ("monday", "tuesday") for n in range(2)],
        ["monday/0", "monday/1", "tuesday/0", "tuesday/1"],
        ["video"],
        "{episode}/video.mp4",
    ),
    "the camera before the number": (
        [f"run{n}/images/cam{c}_{t:03d}.png" for n in range(2) for c in range(2) for t in range(3)],
        ["run0", "run1"],
        ["cam0", "cam1"],
        "{episode}/images/{camera}_*.png",
    ),
    "videos of many days": (
        [f"day{d}/morning/{n}.mp4" for d in range(2) for n in range(3)],
        [f"day{d}/morning/{n}" for d in range(2) for n in range(3)],
        ["video"],
        "{episode}.mp4",
    ),
    "a word that ends in the number": (
        [f"ep{n}/img/{side}{t:04d}.png" for n in range(2) for side in ("left", "right") for t in range(9, 12)],
        ["ep0", "ep1"],
        ["left", "right"],
        "{episode}/img/{camera}*.png",
    ),
}


def write(root: Path, names: list[str]) -> None:
    for name in names:
        file = root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix == ".mp4":
            write_video(file, numbered(3))
        else:
            number = re.findall(r"\d+", file.stem)[-1 if file.stem.startswith("cam") else 0]
            Image.fromarray(np.full((16, 16, 3), int(number), np.uint8)).save(file)


@pytest.mark.parametrize(("files", "episodes", "cameras", "pattern"), LAYOUTS.values(), ids=LAYOUTS)
def test_the_pattern_that_a_refusal_prints_opens_the_folder(
    tmp_path: Path, files: list[str], episodes: list[str], cameras: list[str], pattern: str
) -> None:
    write(tmp_path, [*files, ".trash/0/videos/head.mp4"])
    with pytest.raises(DatasetError) as refused:
        open_dataset(tmp_path, task=TASK)
    *each, printed = re.findall(r"--videos '(.*?)'", str(refused.value))
    assert each == ["{episode}.mp4"] * (files[0].endswith("mp4") and pattern != "{episode}.mp4")
    assert (printed, files[0].rpartition("/")[0] in str(refused.value)) == (pattern, True)
    dataset = open_dataset(tmp_path, task=TASK, videos=printed)
    assert [each.name for each in dataset.episodes] == episodes
    assert list(dataset.cameras) == cameras
    assert {each.num_frames for each in dataset.episodes} == {3}
    if files[0].endswith(("jpg", "png")):  # frames in the order of their numbers
        shown = [int(frame.mean().round()) for frame in dataset.frames(dataset.episodes[-1], cameras[-1])]
        assert shown in ([0, 1, 2], [9, 10, 11])


def test_a_table_gives_tasks_and_the_order_and_others_are_listed(tmp_path: Path) -> None:
    files, (first, second), *_ = LAYOUTS["AgiBot"]
    write(tmp_path, [*files, "observations/328/1/videos/head.mp4", "observations/328/1/videos/hand_left.mp4"])
    pattern = LAYOUTS["AgiBot"][3]
    with pytest.raises(DatasetError, match=r"expected tasks.csv with the task of each episode, got none: write it"):
        open_dataset(tmp_path, videos=pattern)
    (tmp_path / "tasks.csv").write_text(f"episode,task\n{second},open it\n{first},close it\n")
    notes = Notes()
    report = label(open_dataset(tmp_path, videos=pattern), BrightnessScorer(), LabelOptions(), notes)
    assert [(item.episode.name, item.episode.task) for item in report.plan.items] == [
        (second, "open it"),
        (first, "close it"),
    ]
    assert any(
        "tasks.csv leaves out episodes beside it, which get no labels: observations/328/1" in each
        for each in notes.lines
    )
    (tmp_path / "tasks.csv").write_text(f"episode,task\n{second},open it\ngone,close it\n")
    with pytest.raises(DatasetError, match=r"tasks\.csv: expected episodes of .*, got gone; there are observations"):
        open_dataset(tmp_path, videos=pattern)


def test_an_episode_without_a_camera_is_left_out_by_the_list_that_is_printed(tmp_path: Path) -> None:
    write(tmp_path, ["0/a.mp4", "1/a.mp4", "1/b.mp4", "2/b.mp4"])
    dataset = open_dataset(tmp_path, videos="{episode}/{camera}.mp4", task=TASK)
    with pytest.raises(
        DatasetError, match=r"2: expected a camera .*, got a: missing in 2\nto continue .*: --episodes 0:2$"
    ):
        label(dataset, BrightnessScorer())
    label(dataset, BrightnessScorer(), LabelOptions(episodes=[0, 1]))


REFUSED: dict[str, tuple[str, str]] = {
    "no episode": ("videos/{camera}.mp4", "videos: expected {episode} once and {camera} at most once in a path below"),
    "an episode twice": ("{episode}/{episode}.mp4", "videos: expected {episode} once"),
    "another field": ("{episode}/{view}.mp4", "videos: expected {episode} once"),
    "another folder": ("../{episode}.mp4", "videos: expected {episode} once"),
    "an absolute path": ("/data/{episode}.mp4", "videos: expected {episode} once"),
    "pictures without a number": (
        "{episode}/{camera}.jpg",
        "videos: expected a * for the frame's number in a picture's n",
    ),
    "no files": (
        "{episode}/{camera}.mkv",
        "files {episode}/{camera}.mkv, got none; it has 0/a.mp4, 0/b.mp4, 0/x/a.mp4",
    ),
    "two files of a camera": (
        "{episode}/*.mp4",
        "one file of each episode and camera, got 0/a.mp4 and 0/b.mp4: name more",
    ),
}


@pytest.mark.parametrize(("pattern", "message"), REFUSED.values(), ids=REFUSED)
def test_a_wrong_pattern_is_refused(tmp_path: Path, pattern: str, message: str) -> None:
    for name in ("0/a.mp4", "0/x/a.mp4", "0/b.mp4"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(DatasetError) as refused:
        open_dataset(tmp_path, videos=pattern, task=TASK)
    assert message in str(refused.value)
