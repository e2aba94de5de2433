# SPDX-License-Identifier: MIT
"""A message names the faults of all episodes and the options to continue."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from hdf5_writers import write_robomimic
from labelling import FEW, LEROBOT, WRIST, BrightnessScorer, Notes, command
from pictures import numbered
from rfm_client import RewardError
from rfm_client.command_line import ExitCode
from rfm_labels import DatasetError, LabelOptions, label, open_dataset, parse_episodes

TASK = "stack the cups"


class Asked(BrightnessScorer):
    """Counts samples, also in a run by the command."""

    def run(self, source: Path, labels: LabelOptions, *, dry_run: bool = False, task: str | None = None) -> int:
        self.said: list[str] = []
        return command(source, labels, self, self.said.append, dry_run=dry_run, task=task)


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
            "episode_000005.mp4: expected a file with a video stream, got ",
        ),
        strict=False,
    ):
        assert fault in line
    assert lines[4:] == ["to continue without the faulty episodes: --episodes 0,2,4,6:8"]
    assert parse_episodes(option(lines, "--episodes")) == [0, 2, 4, 6, 7]

    assert option(refused(root, output, shard=(0, 2)), "--episodes") == "0,2,4,6:8"  # a list for all shards


@pytest.mark.parametrize("text", ["", "N/A", "..."])
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
    assert "tasks: 3 episodes with that of --task, 5 with others" in notes.lines
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
    assert "note: tasks: 1 episode with that of --task, 0 with others" in scorer.said
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


def test_a_broken_episode_in_a_table_of_several_lets_the_others_through(tmp_path: Path, output: Path) -> None:
    root = shutil.copytree(LEROBOT / "toy_v30_many", tmp_path / "toy")
    for file in sorted((root / "data").rglob("*.parquet")):
        table = parquet.read_table(file, partitioning=None)
        rows = [row | {"frame_index": 7} if row["episode_index"] == 1 else row for row in table.to_pylist()]
        parquet.write_table(pa.Table.from_pylist(rows, schema=table.schema), file)
    options: dict[str, Any] = {"output": output, **FEW}
    with pytest.raises(DatasetError, match=r"episode 1: .* frame_index: expected"):
        label(open_dataset(root), BrightnessScorer(), LabelOptions(episodes=[0, 1], **options))
    report = label(open_dataset(root), BrightnessScorer(), LabelOptions(episodes=[0, 2, 3], **options))
    whole = open_dataset(LEROBOT / "toy_v30_many")
    assert [item.episode for item in report.plan.items] == [whole.episode(number) for number in (0, 2, 3)]
