# SPDX-License-Identifier: MIT
"""The sentence of a LeRobot row: the column, gaps in numbers, contradictions, and notes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from labelling import FEW, LEROBOT, WRIST, BrightnessScorer, Notes, change_column, change_info, tasks_of
from rfm_labels import DatasetError, LabelOptions, label, open_dataset
from rfm_labels.datasets.lerobot_rows import read_sentences

V21, V30 = LEROBOT / "toy_v21", LEROBOT / "toy_v30_many"
LENGTH = 58  # of episode 0 of V30
CUT = 20  # first row with the second subtask
SUBTASKS = ("reach for the block", "lift the block")


def rows_of(root: Path) -> list[Path]:
    return sorted((root / "data").rglob("*.parquet"))


def with_columns(folder: Path, source: Path = V30, **columns: Callable[[int, int], Any]) -> Path:
    """Copy a dataset and add columns computed from the episode and frame of a row."""
    root = Path(shutil.copytree(source, folder / "toy"))
    for file in rows_of(root):
        table = parquet.read_table(file, partitioning=None)
        places = list(zip(table["episode_index"].to_pylist(), table["frame_index"].to_pylist(), strict=True))
        for name, value in columns.items():
            table = table.append_column(name, pa.array([value(*place) for place in places]))
        parquet.write_table(table, file)
    return root


def persistent(*subtasks: tuple[float, str | None], style: str = "subtask") -> list[dict[str, Any]]:
    """Return ``language_persistent`` in an episode's rows, as LeRobot 0.6 writes it."""
    rest = {"role": "assistant", "camera": None, "tool_calls": None}
    plan = {"content": "first this, then that", "style": "plan", "timestamp": 0.0, **rest}
    return [plan, *({"content": text, "style": style, "timestamp": time_s, **rest} for time_s, text in subtasks)]


def in_two(episode: int, frame: int) -> int:
    return int(frame >= CUT)


SENTENCES = tasks_of(V30)
ANNOTATION = "annotation.human.action.task_description"
IN_TWO = ((0, SUBTASKS[0]), (CUT, SUBTASKS[1]))
COLUMNS: dict[str, tuple[str, Callable[[int, int], Any], Any]] = {
    "sentences": ("annotation.human.coarse_action", lambda *place: SUBTASKS[in_two(*place)], IN_TWO),
    "numbers of tasks": (ANNOTATION, lambda *place: 1 + in_two(*place), ((0, SENTENCES[1]), (CUT, SENTENCES[2]))),
    "numbers with a gap in another episode": (
        ANNOTATION,
        lambda episode, frame: None if episode else 1 + in_two(episode, frame),
        ((0, SENTENCES[1]), (CUT, SENTENCES[2])),
    ),
    "numbers of subtasks": ("subtask_index", in_two, IN_TWO),
    "LeRobot's persistent subtasks": (
        "language_persistent",
        lambda *_: persistent((0.0, SUBTASKS[0]), (CUT / 10, SUBTASKS[1])),
        IN_TWO,
    ),
}


@pytest.mark.parametrize(("name", "value", "expected"), COLUMNS.values(), ids=COLUMNS)
def test_a_column_names_the_tasks(
    tmp_path: Path, output: Path, name: str, value: Callable[[int, int], Any], expected: Any
) -> None:
    root = with_columns(tmp_path, **{name: value})
    subtasks = pa.table({"subtask_index": [0, 1], "__index_level_0__": list(SUBTASKS)})
    parquet.write_table(subtasks, root / "meta" / "subtasks.parquet")
    dataset, scorer = open_dataset(root, task_column=name), BrightnessScorer()
    assert dataset.episode(0).tasks == expected
    report = label(dataset, scorer, LabelOptions(output=output, episodes=[0], **FEW))
    assert scorer.tasks == {sentence for _, sentence in expected}
    first = open_dataset(root, task_column=name, several_tasks="first").episode(0)
    assert (first.task, first.tasks) == (expected[0][1], ())
    with pytest.raises(DatasetError, match="several_tasks: expected one of each, first, got 'last'"):
        open_dataset(root, several_tasks="last")  # type: ignore[arg-type]
    own = label(open_dataset(root), scorer, LabelOptions(output=output, name="own", episodes=[0], **FEW))
    assert own.plan.items[0].digest != report.plan.items[0].digest


def test_a_column_of_v21_counts_in_its_own_table(tmp_path: Path) -> None:
    root = with_columns(tmp_path, V21, subtask_index=in_two)
    lines = [{"subtask_index": k, "subtask": text} for k, text in enumerate(SUBTASKS)]
    (root / "meta" / "subtasks.jsonl").write_text("\n".join(map(json.dumps, lines)))
    assert open_dataset(root, task_column="subtask_index").episode(0).tasks == IN_TWO


def test_frames_before_the_first_subtask_get_the_callers_task(tmp_path: Path, output: Path) -> None:
    root = with_columns(tmp_path, language_persistent=lambda *_: persistent((CUT / 10, SUBTASKS[1])))
    with pytest.raises(DatasetError, match="episode 0: language_persistent: expected a task as a sentence, got none"):
        open_dataset(root, task_column="language_persistent").episode(0)
    dataset = open_dataset(root, task_column="language_persistent", task=SUBTASKS[0])
    assert dataset.episode(0).tasks == IN_TWO
    notes = Notes()
    label(dataset, BrightnessScorer(), LabelOptions(output=output, episodes=[0, 1], **FEW), notes)
    assert "tasks: 2 episodes with that of --task, 0 with others" in notes.lines


CANDIDATES = "expected one of task_index, annotation.human.coarse_action, language_persistent, got "
UNUSABLE = {
    "unknown": ("subtask", CANDIDATES),
    "no text": ("is_valid", CANDIDATES),
    "identity": ("frame_index", CANDIDATES),
    "events": ("language_events", CANDIDATES),
    "a number without a sentence": ("task_index", "episode 0: task 9 in meta/tasks: expected a task as a sentence"),
    "half a number": ("half", "half 0.5 in meta/tasks: expected a task as a sentence, got 0.5: correct it"),
    "two subtasks at a time": ("language_persistent", "expected one subtask at a time, got several"),
}


@pytest.mark.parametrize(("name", "message"), UNUSABLE.values(), ids=UNUSABLE)
def test_a_column_without_tasks_is_refused(tmp_path: Path, name: str, message: str) -> None:
    columns: dict[str, Callable[[int, int], Any]] = {
        "annotation.human.coarse_action": lambda *_: SUBTASKS[0],
        "is_valid": lambda *_: True,
        "half": lambda *_: 0.5,
        "language_persistent": lambda *_: persistent((0.0, SUBTASKS[0]), (0.0, SUBTASKS[1])),
        "language_events": lambda *_: [{"role": "user", "content": "stop", "style": "interjection"}],
    }
    root = with_columns(tmp_path, **columns)
    change_column(rows_of(root)[0], "task_index", lambda values: [9] * LENGTH + values[LENGTH:])
    with pytest.raises(DatasetError) as caught:
        _ = open_dataset(root, task_column=name).episodes
    assert message in str(caught.value)


def test_a_column_is_no_task_of_another_dataset_or_of_an_override(tmp_path: Path) -> None:
    (tmp_path / "tasks.csv").write_text("video,task\na.mp4,stack the cups\n")
    with pytest.raises(DatasetError, match=r"task_column: expected none, since .* is no LeRobot or RLDS dataset, "):
        open_dataset(tmp_path, task_column="task")
    with pytest.raises(DatasetError, match="task_column: expected none with --override-task, which reads no tasks"):
        open_dataset(V21, task="stack the cups", override_task=True, task_column="task_index")


def rename_tasks(root: Path, *texts: str) -> None:
    """Other sentences in ``meta/tasks.jsonl``; ``meta/episodes.jsonl`` keeps the old ones."""
    file = root / "meta" / "tasks.jsonl"
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    for line, text in zip(lines, texts, strict=False):
        line["task"] = text
    file.write_text("\n".join(json.dumps(line, ensure_ascii=False) for line in lines))


def test_outdated_sentences_in_the_metadata_are_refused_with_the_option_that_follows_the_rows(tmp_path: Path) -> None:
    root = Path(shutil.copytree(V21, tmp_path / "toy"))
    rename_tasks(root, "lift the block onto the plate")
    with pytest.raises(DatasetError) as caught:
        open_dataset(root).episode(0)
    assert str(caught.value) == (
        "episode 0: meta/episodes: tasks: expected 'lift the block onto the plate', got "
        "['put the blue block on the plate']: correct it, or follow the rows, as LeRobot's reader does: "
        "--task-column task_index"
    )
    episodes = open_dataset(root, task_column="task_index").episodes
    assert [episode.task for episode in episodes][:2] == [
        "lift the block onto the plate",
        "put the red block in the bowl",
    ]


def test_a_sentence_may_have_any_character_that_is_no_end_of_a_line(tmp_path: Path) -> None:
    root = Path(shutil.copytree(V21, tmp_path / "toy"))
    text = "lift the block\u2028onto\x85the plate\u2029"
    rename_tasks(root, text)
    content = (root / "meta" / "tasks.jsonl").read_text().replace("\n", "\r\n")
    (root / "meta" / "tasks.jsonl").write_bytes(b"\xef\xbb\xbf" + content.encode())
    assert open_dataset(root, task_column="task_index").episode(0).task == text


def test_identifiers_in_place_of_sentences_are_listed(tmp_path: Path, output: Path) -> None:
    root = Path(shutil.copytree(V21, tmp_path / "toy"))
    rename_tasks(root, "PnPCupToDrawerClose", "pick_place_cup", "lift it", "杯子放进抽屉里")
    notes = Notes()
    dataset = open_dataset(root, task_column="task_index")
    label(dataset, BrightnessScorer(), LabelOptions(output=output, **FEW), notes)
    assert [line for line in notes.lines if line.startswith("tasks:")] == [
        "tasks: 2 of 4 are a single word, not a sentence (PnPCupToDrawerClose, pick_place_cup); --task with "
        "--override-task gives all episodes a sentence, --task-column reads another column (LeRobot)"
    ]


def test_a_note_says_that_an_override_is_the_task_of_all_episodes(output: Path) -> None:
    notes = Notes()
    dataset = open_dataset(V21, task="stack the cups", override_task=True)
    label(dataset, BrightnessScorer(), LabelOptions(output=output, limit=3, **FEW), notes)
    assert [line for line in notes.lines if line.startswith("tasks:")] == ["tasks: --task for all 3 episodes"]


def test_episode_numbers_may_have_gaps_and_lie_in_several_chunks(tmp_path: Path) -> None:
    root, whole = Path(shutil.copytree(V21, tmp_path / "toy")), open_dataset(V21)
    lines = (root / "meta" / "episodes.jsonl").read_text().splitlines()
    (root / "meta" / "episodes.jsonl").write_text("\n".join(lines[number] for number in (0, 2, 7)))
    change_info(root, lambda info: info.update(chunks_size=5))
    for name in ("data/chunk-{}/episode_000007.parquet", f"videos/chunk-{{}}/{WRIST}/episode_000007.mp4"):
        target = root / name.format("001")
        target.parent.mkdir(parents=True)
        (root / name.format("000")).rename(target)
    dataset = open_dataset(root)
    assert dataset.episodes == [whole.episode(number) for number in (0, 2, 7)]
    last = dataset.episode(7)
    np.testing.assert_array_equal(list(dataset.frames(last, WRIST)), list(whole.frames(last, WRIST)))
    with pytest.raises(DatasetError, match="expected some of the dataset's 3 episodes, got 1; it has 0,2,7"):
        label(dataset, BrightnessScorer(), LabelOptions(output=tmp_path, episodes=[0, 1]))


TABLES: dict[str, tuple[dict[str, list[Any]], list[str]]] = {
    "an index without a name": ({"task_index": [0, 1], "__index_level_0__": ["a b", "c d"]}, ["a b", "c d"]),
    "a column of sentences": ({"task": ["a b", "c d"], "task_index": [0, 1]}, ["a b", "c d"]),
    "further columns": ({"task_index": [0, 1], "task": ["a b", "c d"], "robot": ["x", "y"]}, ["a b", "c d"]),
    "another name": ({"task_index": [0, 1], "sentence": ["a b", "c d"]}, ["a b", "c d"]),
}


@pytest.mark.parametrize(("columns", "expected"), TABLES.values(), ids=TABLES)
def test_a_table_of_tasks_is_read_as_its_writers_name_its_columns(
    tmp_path: Path, columns: dict[str, list[Any]], expected: list[str]
) -> None:
    (tmp_path / "meta").mkdir()
    parquet.write_table(pa.table(columns), tmp_path / "meta" / "tasks.parquet")
    assert list(read_sentences(tmp_path / "meta" / "tasks.parquet").values()) == expected
