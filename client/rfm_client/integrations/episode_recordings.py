# SPDX-License-Identifier: MIT
"""Labelled episodes as recordings for Rerun's viewer. Needs ``rfm-client[rerun]`` and ``rfm-client[label]``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rfm_client.contract.results import FrameScores
from rfm_client.data.datasets.protocol import Dataset
from rfm_client.integrations.recording import Recording
from rfm_client.labelling.episode_scores import PROGRESS, SUCCESS
from rfm_client.labelling.finished_episodes import Parts
from rfm_client.labelling.plan import Item, Plan


def record_episodes(folder: Path, dataset: Dataset, plan: Plan, parts: Parts) -> Iterator[Path]:
    """The file of each episode of the plan that is labelled, as it is written. The frames are decoded once more.

    Of several cameras each has its frames and its own scores beside the fused ones.
    """
    folder.mkdir(parents=True, exist_ok=True)
    finished = parts.finished(plan.items)
    for item in plan.items:
        if item.key in finished:
            yield _record(folder, dataset, item, parts.read(item), plan.recipe.cameras)


def _record(folder: Path, dataset: Dataset, item: Item, labels: Any, cameras: Sequence[str]) -> Path:
    file = folder / f"episode_{item.episode.index:06d}.rrd"
    with Recording(file) as recording:
        films = {camera: dataset.frames(item.episode, camera) for camera in cameras}
        recording.add((), _scores(labels, ""), films if len(films) > 1 else {"": films[cameras[0]]})
        for camera in films if len(films) > 1 else ():
            recording.add((camera,), _scores(labels, f".{camera}"), {})
    return file


def _scores(labels: Any, suffix: str) -> FrameScores:
    """The columns of a part whose names end so; NaN: not predicted."""
    progress = labels[PROGRESS + suffix].to_numpy()
    name = SUCCESS + suffix
    success = labels[name].to_numpy() if name in labels.column_names else np.full_like(progress, np.nan)
    return FrameScores(progress=progress, success=success)
