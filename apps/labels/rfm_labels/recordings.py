# SPDX-License-Identifier: MIT
"""Write Rerun recordings (.rrd) of labelled episodes. Needs ``rfm-client[rerun]``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client import FrameScores
from rfm_client.recording import PROGRESS, SUCCESS, Recording
from rfm_labels.datasets.dataset import Dataset
from rfm_labels.finished_episodes import Parts
from rfm_labels.plan import Item, Plan


def record_episodes(folder: Path, dataset: Dataset, plan: Plan, parts: Parts) -> Iterator[Path]:
    """Write a file for each labelled episode of the plan, and yield its path. Frames are decoded again.

    Each of several cameras has its frames, and its own scores beside the fused scores.
    """
    folder.mkdir(parents=True, exist_ok=True)
    finished = parts.finished(plan.items)
    for item in plan.items:
        if item.key in finished:
            yield _record(folder, dataset, item, parts.read(item), plan.recipe.cameras)


def _record(folder: Path, dataset: Dataset, item: Item, labels: Any, cameras: Sequence[str]) -> Path:
    file = folder / f"episode_{item.episode.index:06d}.rrd"
    with Recording(file) as recording:
        videos = {camera: dataset.frames(item.episode, camera) for camera in cameras}
        recording.add((), _scores(labels, ""), videos if len(videos) > 1 else {"": videos[cameras[0]]})
        for camera in videos if len(videos) > 1 else ():
            recording.add((camera,), _scores(labels, f".{camera}"), {})
    return file


def _scores(labels: Any, suffix: str) -> FrameScores:
    """The columns of a part with this suffix; NaN: not predicted."""
    progress = labels[PROGRESS + suffix].to_numpy()
    name = SUCCESS + suffix
    success = labels[name].to_numpy() if name in labels.column_names else np.full_like(progress, np.nan)
    return FrameScores(progress=progress, success=success)
