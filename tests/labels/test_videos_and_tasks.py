# SPDX-License-Identifier: MIT
"""Folders of videos with a table of tasks, and tasks given by a caller."""

from __future__ import annotations

from pathlib import Path

import pytest

from labelling import BrightnessScorer, Notes
from pictures import numbered, write_video
from rfm_labels import DatasetError, LabelOptions, label, open_dataset


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    folder = tmp_path / "videos"
    (folder / "day").mkdir(parents=True)
    write_video(folder / "b.mp4", numbered(6))
    write_video(folder / "day" / "a.mp4", numbered(4), times=[0, 1, 5, 6])
    return folder


TABLES = {
    "a line break in quotes": (
        'video,task\nb.mp4,"stack\r\n  the cups"\nday/a.mp4,open the box\n',
        ["stack the cups", "open the box"],
    ),
    "semicolons": (
        "\ufeffVideo;Task\r\nb.mp4;stack, then rest \r\nday/a.mp4;open it\n",
        ["stack, then rest", "open it"],
    ),
    "tabs": (
        "video\ttask\nb.mp4\tstack, then rest\nday/a.mp4\topen it\n",
        ["stack, then rest", "open it"],
    ),
    "spaces after commas": (
        'video, task\nb.mp4, "stack, then rest"\nday/a.mp4 , open it\n',
        ["stack, then rest", "open it"],
    ),
    "empty lines of a spreadsheet": (
        "video,task\nb.mp4,stack\n,\n\nday/a.mp4,open it\n,\n",
        ["stack", "open it"],
    ),
    "other spellings of a path": ("video,task\n./b.mp4,stack\nday\\..\\day\\a.mp4,open it\n", ["stack", "open it"]),
}


@pytest.mark.parametrize(("text", "expected"), TABLES.values(), ids=TABLES)
def test_a_table_is_read_as_spreadsheets_and_people_write_it(videos: Path, text: str, expected: list[str]) -> None:
    (videos / "tasks.csv").write_text(text, newline="")
    assert [(e.name, e.task) for e in open_dataset(videos).episodes] == list(
        zip(["b.mp4", "day/a.mp4"], expected, strict=True)
    )


def test_videos_missing_from_the_table_are_listed(videos: Path, output: Path) -> None:
    (videos / "tasks.csv").write_text("video,task\nday/a.mp4,open the box\n")
    (videos / "day" / "c.mp4").write_bytes((videos / "b.mp4").read_bytes())
    (videos / "elsewhere").mkdir()
    (videos / "elsewhere" / "d.mp4").write_bytes(b"of no listed folder")
    notes = Notes()
    label(open_dataset(videos), BrightnessScorer(), LabelOptions(output=output), notes)
    line = "tasks.csv leaves out videos beside it, which get no labels: b.mp4, day/c.mp4"
    assert [each for each in notes.lines if "tasks.csv" in each] == [line]
    (videos.parent / "link").symlink_to(videos)
    names = [f"{videos.parent}/link/b.mp4", f"{videos}/day/a.mp4", "day/c.mp4"]
    (videos / "tasks.csv").write_text("".join(f"{each}\n" for each in ("video,task", *(f"{n},a b" for n in names))))
    dataset = open_dataset(videos)
    assert not dataset.notes
    assert [each.name for each in dataset.episodes] == names


def test_videos_in_deeper_folders_get_a_note_if_there_is_no_table(videos: Path) -> None:
    (videos / ".hidden").mkdir()
    (videos / ".hidden" / "c.mp4").write_bytes(b"of another program")
    dataset = open_dataset(videos, task="open the box")
    assert [episode.name for episode in dataset.episodes] == ["b.mp4"]
    remedy = "list them in tasks.csv, or name them by a pattern (--videos)"
    assert dataset.notes == [f"videos in deeper folders get no labels: day/a.mp4: {remedy}"]


def test_all_faulty_lines_of_a_table_are_named_at_once(videos: Path) -> None:
    (videos / "tasks.csv").write_text("video,task\nb.mp4,a\n./b.mp4,b\nday/a.mp4,put it, and go\n ,c\n")
    with pytest.raises(DatasetError) as caught:
        open_dataset(videos)
    assert str(caught.value).splitlines() == [
        f"{videos}/tasks.csv: line 3: expected each video once, got ./b.mp4",
        f"{videos}/tasks.csv: line 4: expected 2 cells (text with a comma in quotes), got 3",
        f"{videos}/tasks.csv: line 5: expected the path of a video, got none",
    ]


REFUSED = {
    "a quote that does not end": (
        'video,task\nb.mp4,"stack the cups\nday/a.mp4,open the box\n',
        'expected quotes around a whole cell, and "" for a quote in it, got unexpected end of data',
    ),
    "no table": (None, "expected tasks.csv with the task of each video, got none"),
    "no column of tasks": ("video\nb.mp4\n", "expected the columns video and task, got video"),
    "no task": ("video,task\nb.mp4,\n", "b.mp4: expected a task as a sentence, got none"),
    "a task of blanks": ("video,task\nb.mp4,  \n", "b.mp4: expected a task as a sentence, got none"),
    "a video without its suffix": (
        "video,task\nday/a,open it\n",
        "day/a: expected a folder of PNG or JPEG files, got none: write the whole name, a.mp4",
    ),
    "a video that is missing": ("video,task\nc.mp4,a\n", "c.mp4: expected a video file, got none"),
}


@pytest.mark.parametrize(("text", "message"), REFUSED.values(), ids=REFUSED)
def test_a_table_of_videos_that_is_wrong_is_refused(videos: Path, text: str | None, message: str) -> None:
    if text is not None:
        (videos / "tasks.csv").write_text(text)
    with pytest.raises(DatasetError) as caught:
        _ = open_dataset(videos).episodes
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("video,task\nb.mp4,\nday/a.mp4,stack the cups\n", ["open the box", "stack the cups"]),
        ("video\nb.mp4\nday/a.mp4\n", ["open the box"] * 2),
    ],
    ids=["an empty cell", "no column"],
)
def test_a_task_fills_in_where_a_table_has_none(videos: Path, text: str, expected: list[str]) -> None:
    (videos / "tasks.csv").write_text(text)
    assert [episode.task for episode in open_dataset(videos, task="open the box").episodes] == expected


def test_a_task_replaces_those_of_episodes_only_on_request(videos: Path) -> None:
    (videos / "tasks.csv").write_text("video,task\nb.mp4,stack the cups\n")
    with pytest.raises(DatasetError) as refused:
        _ = open_dataset(videos, task="open the box").episodes
    assert str(refused.value) == (
        "task: expected none for episodes that all have tasks of their own, got 'open the box': leave it out, or put it "
        "in the place of theirs with --override-task"
    )
    with pytest.raises(DatasetError, match=r"^task: expected a sentence, got none$"):
        open_dataset(videos, override_task=True)
