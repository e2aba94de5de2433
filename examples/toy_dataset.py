# SPDX-License-Identifier: MIT
"""Write toy-world videos with known outcomes, a dataset to label with several checkpoints and compare.

    python examples/toy_dataset.py FOLDER

Successes and failures alternate; tasks and failure kinds take turns. Training saw none of these clips.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from toy_world import FAILURES, TASKS, make_clip
from toy_world.video import write_video


def write(
    folder: Annotated[Path, typer.Argument(help="Where the dataset goes; must not exist.")],
    clips: Annotated[int, typer.Option(help="Videos, half of them successes.")] = 24,
    seed: Annotated[int, typer.Option(help="Of the first clip.")] = 3_000_000,
) -> None:
    """Write the videos, tasks.csv for `rfm label`, and outcomes.csv for `rfm-client evaluate`."""
    if folder.exists():
        raise typer.BadParameter(f"expected a folder that does not exist, got {folder}")
    folder.mkdir(parents=True)
    tasks, outcomes = [], []
    for index in range(clips):
        pair = index // 2
        kind = "success" if index % 2 == 0 else FAILURES[pair % len(FAILURES)]
        clip = make_clip(kind, TASKS[pair % len(TASKS)], seed + index)
        name = f"clip_{index:02}.mp4"
        write_video(folder / name, clip.frames)
        tasks.append((name, clip.task.sentence()))
        outcomes.append((index, int(clip.success[-1])))
    _write_table(folder / "tasks.csv", ("video", "task"), tasks)
    _write_table(folder / "outcomes.csv", ("episode", "success"), outcomes)
    typer.echo(f"{folder}: {clips} videos, {sum(success for _, success in outcomes)} of them successes")


def _write_table(file: Path, columns: tuple[str, str], rows: Iterable[tuple[object, object]]) -> None:
    with file.open("w", newline="") as opened:
        csv.writer(opened, lineterminator="\n").writerows([columns, *rows])


if __name__ == "__main__":
    typer.run(write)
