# SPDX-License-Identifier: MIT
"""Datasets for the page: copies of the toy datasets, labelled without a server, and what their labels say."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import av
import numpy as np
from pyarrow import parquet

from encoding import encode
from labelling import LEROBOT, BrightnessScorer
from rfm_client.data.datasets.lerobot import LeRobotDataset
from rfm_client.labelling import LabelOptions, label, open_dataset

CAMERAS = ("observation.images.front", "observation.images.wrist")
CODINGS = {
    "far between": ("libx264", {"g": "60", "keyint_min": "60", "sc_threshold": "0", "bf": "0"}),
    "AV1": ("libsvtav1", {"g": "2", "preset": "12"}),
}
NEEDS_LATER = ("libx264", {"g": "60", "keyint_min": "60", "sc_threshold": "0", "bf": "3", "b_strategy": "0"})


def copied(name: str, folder: Path) -> Path:
    """A copy of a toy dataset in a folder."""
    return Path(shutil.copytree(LEROBOT / name, folder / name))


def labelled(name: str, folder: Path, options: LabelOptions | None = None) -> Path:
    """A copy of a toy dataset, with labels: progress is how bright a frame is, success how red."""
    root = copied(name, folder)
    label(open_dataset(root), BrightnessScorer(), options or LabelOptions())
    return root


def columns_of(root: Path, episode: int, name: str = "rfm_progress.parquet") -> dict[str, np.ndarray[Any, Any]]:
    """The labels of an episode, read by themselves."""
    table = parquet.read_table(root / name)
    own = table["episode_index"].to_numpy() == episode
    return {column: table[column].to_numpy()[own] for column in table.column_names}


def dataset(root: Path) -> LeRobotDataset:
    return LeRobotDataset(root)


def encoded_anew(root: Path, codec: str, options: dict[str, str], noise: np.random.Generator | None = None) -> None:
    """Codes the films of a dataset in another way, or noise in their place."""
    for file in sorted(root.rglob("*.mp4")):
        with av.open(str(file)) as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        if noise is not None:
            frames = [noise.integers(0, 256, frame.shape, np.uint8) for frame in frames]
        encode(file, frames, codec, options)
