# SPDX-License-Identifier: MIT
"""A message names the faults of all episodes and the options to continue."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from hdf5_writers import write_robomimic
from labelling import FEW, FRONT, LEROBOT, WRIST, BrightnessScorer, Notes, command
from pictures import numbered
from rfm_client import RewardError
from rfm_client.command_line import ExitCode
from rfm_labels import DatasetError, LabelOptions, label, open_dataset, parse_episodes
from rfm_labels.datasets.faults import listed

TASK = "stack the cups"


class Asked(BrightnessScorer):
    """Counts samples, also in a run by the command."""

    def run(self, source: Path, labels: LabelOptions, *, dry_run: bool = False, task: str | None = None) -> int:
        self.said: list[str] = []
        return command(source, labels, self, self.said.append, dry_run=dry_run, picture=False, task=task)


def broken(folder: Path) -> Path:
    """Episodes 1, 3 and 5 have faults that are found at different stages."""
    root = shutil.copytree(LEROBOT / "toy_v21", folder / "toy")
    (root / "data" / "chunk-000" / "episode_000001.parquet").unlink()
    (root / "videos" / "chunk-000" / WRIST / "episode_000003.mp4").unlink()
    cut = root / "videos" / "chunk-000" / WRIST / "episode_000005.mp4"
    cut.write_bytes(cut.read_bytes()[:2000])
    return Path(root)


def without_tasks(folder: Path, *blank: str) -> Path:
    """Replace the tasks by these texts in order."""
    root = shutil.copytree(LEROBOT / "toy_v21", folder / "toy")
    file = root / "meta" / "tasks.jsonl"
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    for line, text in zip(lines, blank, strict=False):
        line["task"] = text
    file.write_text("\n".join(map(json.dumps, lines)))
    return Path(root)


def refused(source: Path, output: Path, **more: Any) -> list[str]:
    """The lines of the refusal."""
    scorer = BrightnessScorer()
    with pytest.raises(DatasetError) as caught:
        label(open_dataset(source), scorer, LabelOptions(output=output, **{**FEW, **more}))
    assert scorer.num_samples == 0
    return str(caught.value).splitlines()


def option(lines: list[str], name: str) -> str:
    """Return an option's value in the lines, as a shell reads it."""
    (found,) = (match[1] for line in lines if (match := re.search(rf"{name} (\S+)$", line)))
    return str(found)


def test_three_broken_episodes_are_named_at_once_and_left_out_by_the_list_that_is_printed(
    tmp_path: Path, output: Path
) -> None:
    root = broken(tmp_path)
    lines = refused(root, output)
    assert lines[0] == "episodes: expected 8 that can be labelled, got 3 with faults:"
    for line, fault in zip(
        lines[1:],
        (
            "episode_000001.parquet: expected a Parquet file, got none",
            "episode_000003.mp4: expected a video file, got none",
            "episode_000005.mp4: expected a whole video file, got ",
        ),
        strict=False,
    ):
        assert fault in line
    assert lines[4:] == ["to continue without the faulty episodes: --episodes 0,2,4,6:8"]
    rest = parse_episodes(option(lines, "--episodes"))
    report = label(open_dataset(root), BrightnessScorer(), LabelOptions(output=output, episodes=rest, **FEW))
    assert sorted(set(parquet.read_table(report.files[0])["episode_index"].to_pylist())) == [0, 2, 4, 6, 7]


@pytest.mark.parametrize("more", [{"shard": (0, 2)}, {"shard": (1, 2)}], ids=["first shard", "second shard"])
def test_a_shard_names_the_faults_of_all_shards_which_need_one_list(
    tmp_path: Path, output: Path, more: dict[str, Any]
) -> None:
    assert option(refused(broken(tmp_path), output, **more), "--episodes") == "0,2,4,6:8"


BLANKS = ("", "N/A", "...")


@pytest.mark.parametrize("text", BLANKS)
def test_a_placeholder_is_no_task(tmp_path: Path, output: Path, text: str) -> None:
    root = without_tasks(tmp_path, text)
    lines = refused(root, output)
    assert [line.partition(":")[0] for line in lines[1:-2]] == ["episode 0", "episode 6", "episode 7"]
    assert lines[-2:] == [
        'for the 3 without a task: --task "SENTENCE"',
        "to continue without the faulty episodes: --episodes 1:6",
    ]
    notes = Notes()
    report = label(open_dataset(root, task=TASK), BrightnessScorer(), LabelOptions(output=output, **FEW), notes)
    assert [item.episode.index for item in report.plan.items if item.episode.task == TASK] == [0, 6, 7]
    assert "tasks: 5 episodes keep their own sentence, 3 get --task" in notes.lines
    with pytest.raises(DatasetError, match="task: expected a sentence, got"):
        open_dataset(root, task=text)


def test_a_message_names_twenty_faults_and_counts_the_others(tmp_path: Path) -> None:
    (tmp_path / "tasks.csv").write_text("video,task\n" + "".join(f"{k}.mp4,{TASK}\n" for k in range(30)))
    with pytest.raises(DatasetError) as caught:
        _ = open_dataset(tmp_path).episodes
    lines = str(caught.value).splitlines()
    assert (len(lines), lines[-1]) == (22, "... and 10 more")
    assert lines[20].endswith("19.mp4: expected a video file, got none")


def write_demos(file: Path, *lengths: int, task: str | None = TASK) -> None:
    """Write demonstrations with 5 frames and these numbers of actions."""
    write_robomimic(file, [{"front": numbered(5)} for _ in lengths], task)
    with h5py.File(file, "r+") as opened:
        for index, length in enumerate(lengths):
            del opened[f"data/demo_{index}/actions"]
            opened[f"data/demo_{index}/actions"] = np.zeros((length, 7))


def test_the_faults_of_all_files_of_a_folder_are_named_before_the_first_is_labelled(tmp_path: Path) -> None:
    write_demos(tmp_path / "a.hdf5", 5, 5)
    write_demos(tmp_path / "b.hdf5", 5, 3, 5, 2)
    write_demos(tmp_path / "c.hdf5", 3, 5)
    (tmp_path / "d.hdf5").write_bytes(b"no HDF5")
    scorer = Asked()
    with pytest.raises(RewardError) as caught:
        scorer.run(tmp_path, LabelOptions())
    lines = str(caught.value).splitlines()
    assert [line.removeprefix(f"{tmp_path}/")[:30] for line in lines] == [
        "b.hdf5: episodes: expected 4 t",
        "b.hdf5: data/demo_1: expected ",
        "b.hdf5: data/demo_3: expected ",
        "b.hdf5: to continue without th",
        "c.hdf5: data/demo_0: expected ",
        "c.hdf5: to continue without th",
        "d.hdf5: expected an HDF5 file,",
    ]
    assert lines[3].endswith("--episodes 0,2")
    assert scorer.num_samples == 0


def test_a_task_fills_the_files_of_a_folder_that_have_none(tmp_path: Path) -> None:
    write_demos(tmp_path / "a.hdf5", 5)
    scorer = Asked()
    with pytest.raises(DatasetError, match="task: expected none for episodes that all have tasks of their own"):
        scorer.run(tmp_path, LabelOptions(), task="open the drawer")
    write_demos(tmp_path / "b.hdf5", 5, task=None)
    with pytest.raises(DatasetError, match='got none: add --task "SENTENCE"'):
        scorer.run(tmp_path, LabelOptions())
    assert scorer.run(tmp_path, LabelOptions(), task="open the drawer") is ExitCode.OK
    assert "note: tasks: 0 episodes keep their own sentence, 1 get --task" in scorer.said
    assert scorer.tasks == {TASK, "open the drawer"}


def test_episodes_that_fail_while_they_are_scored_are_left_out_by_the_list_that_is_printed(output: Path) -> None:
    class Picky(Asked):
        def evaluate(self, samples: Any) -> Any:
            if samples[0].trajectory.task == "put the green block in the bowl":  # of episodes 2 to 4
                raise RewardError("no green block")
            return super().evaluate(samples)

    scorer = Picky()
    assert scorer.run(LEROBOT / "toy_v21", LabelOptions(output=output, **FEW)) is ExitCode.FAILED
    assert option(scorer.said, "--episodes") == "0:2,5:8"


def test_episodes_that_share_rows_are_refused_before_a_score(tmp_path: Path, output: Path) -> None:
    root = shutil.copytree(LEROBOT / "toy_v21", tmp_path / "toy")
    for file in sorted((root / "data").rglob("*.parquet")):
        table = parquet.read_table(file, partitioning=None)
        place = table.column_names.index("index")
        parquet.write_table(table.set_column(place, "index", table["frame_index"]), file)
    lines = refused(root, output)
    assert lines[1] == (
        "episode 1: index: expected 29 or more, since episode 0 ends at 28, got 0: renumber the rows in the order of the "
        "episodes"
    )


def test_the_longest_episode_is_named_with_the_list_of_those_that_fit(output: Path) -> None:
    scorer = BrightnessScorer(max_frames=30)
    with pytest.raises(DatasetError, match=r"got 53: use mode prefix .* short enough: --episodes 0:2,3,6:8$"):
        label(open_dataset(LEROBOT / "toy_v21"), scorer, LabelOptions(output=output, mode="whole"))


@pytest.mark.parametrize("numbers", [[0], [0, 1, 2], [3, 4, 9, 11, 12], [1, 3, 5]])
def test_listed_episodes_can_be_given_to_the_option(numbers: list[int]) -> None:
    assert parse_episodes(listed(numbers)) == numbers


def v21(folder: Path, break_it: Callable[[Path], object]) -> Path:
    root = shutil.copytree(LEROBOT / "toy_v21", folder / "toy")
    break_it(root)
    return root


def v30(folder: Path, break_it: Callable[[Path], object]) -> Path:
    root = shutil.copytree(LEROBOT / "toy_v30_many", folder / "toy")
    break_it(root)
    return root


def tables_of(root: Path, below: str) -> list[Path]:
    return sorted((root / below).rglob("*.parquet"))


def changed(below: str, change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    """Change the rows of episode 1 in a folder's tables."""

    def apply(root: Path) -> None:
        for file in tables_of(root, below):
            table = parquet.read_table(file, partitioning=None)
            rows = table.to_pylist()
            for row in rows:
                if row["episode_index"] == 1:
                    change(row)
            parquet.write_table(pa.Table.from_pylist(rows, schema=table.schema), file)

    return apply


def longer_metadata(root: Path) -> None:
    file = root / "meta" / "episodes.jsonl"
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    lines[1]["length"] = "many"
    file.write_text("\n".join(map(json.dumps, lines)))


BROKEN_LEROBOT: dict[str, tuple[Callable[..., Path], Callable[[Path], object], str]] = {
    "v2.1, metadata": (v21, longer_metadata, "length: expected a whole number"),
    "v3.0, rows": (v30, changed("data", lambda row: row.update(frame_index=7)), "episode 1: .* frame_index: expected"),
    "v3.0, metadata": (
        v30,
        changed("meta/episodes", lambda row: row.update({"dataset_to_index": row["dataset_to_index"] + 1})),
        "episode 1: .*length: expected",
    ),
}


@pytest.mark.parametrize(("make", "break_it", "message"), BROKEN_LEROBOT.values(), ids=BROKEN_LEROBOT)
def test_a_broken_episode_of_lerobot_lets_the_others_through(
    tmp_path: Path, output: Path, make: Callable[..., Path], break_it: Callable[[Path], object], message: str
) -> None:
    whole = make(tmp_path / "whole", lambda root: None)
    expected = {number: open_dataset(whole).episodes[number] for number in (0, 2, 3)}
    broken = make(tmp_path / "broken", break_it)
    options: dict[str, Any] = {"output": output, "cameras": (WRIST,), "frames": 2, "formats": ("progress",)}
    with pytest.raises(DatasetError, match=message):
        label(open_dataset(broken), BrightnessScorer(), LabelOptions(episodes=[0, 1], **options))
    dataset = open_dataset(broken)
    report = label(dataset, BrightnessScorer(), LabelOptions(episodes=[0, 2, 3], **options))
    assert not report.failures
    assert {item.episode.index: item.episode for item in report.plan.items} == expected
    table = parquet.read_table(report.files[0])
    assert sorted(set(table["episode_index"].to_pylist())) == [0, 2, 3]
    for number in (0, 2, 3):
        frames = list(open_dataset(whole).frames(expected[number], FRONT))
        np.testing.assert_array_equal(list(dataset.frames(expected[number], FRONT)), frames)


def test_episodes_that_are_not_chosen_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = v21(tmp_path, lambda root: None)
    read: list[Path] = []
    read_table = parquet.read_table

    def seen(file: Path, **options: Any) -> Any:
        read.append(file)
        return read_table(file, **options)

    monkeypatch.setattr(parquet, "read_table", seen)
    label(
        open_dataset(root), BrightnessScorer(), LabelOptions(output=tmp_path, episodes=[2], cameras=(WRIST,), frames=2)
    )
    assert {file.name for file in read if "data" in file.parts} == {"episode_000002.parquet"}
