# SPDX-License-Identifier: MIT
"""A broken episode that is not chosen does not stop the others."""

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

from labelling import FRONT, LEROBOT, WRIST, BrightnessScorer
from rfm_labels import DatasetError, LabelOptions, label, open_dataset

TASK = "stack the cups"


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
    "v2.1, no table": (v21, lambda root: tables_of(root, "data")[1].unlink(), "expected a Parquet file, got none"),
    "v2.1, no video": (
        v21,
        lambda root: (root / "videos" / "chunk-000" / WRIST / "episode_000001.mp4").unlink(),
        "expected a video file, got none",
    ),
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
