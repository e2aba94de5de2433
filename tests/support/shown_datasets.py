# SPDX-License-Identifier: MIT
"""Datasets for the page: copies of the toy datasets, videos coded otherwise, and what labels say."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import av
import numpy as np
from pyarrow import parquet

from encoding import encode
from labelling import LEROBOT

CAMERAS = ("observation.images.front", "observation.images.wrist")
CODINGS = {
    "far between": ("libx264", {"g": "60", "keyint_min": "60", "sc_threshold": "0", "bf": "0"}),
    "AV1": ("libsvtav1", {"g": "2", "preset": "12"}),
}


def copied(name: str, folder: Path) -> Path:
    """A copy of a toy dataset in a folder."""
    return Path(shutil.copytree(LEROBOT / name, folder / name))


def columns_of(root: Path, episode: int, name: str = "rfm_progress.parquet") -> dict[str, np.ndarray[Any, Any]]:
    """The labels of an episode, read by themselves."""
    table = parquet.read_table(root / name)
    own = table["episode_index"].to_numpy() == episode
    return {column: table[column].to_numpy()[own] for column in table.column_names}


def encoded_anew(video: Path, codec: str, options: dict[str, str], noise: np.random.Generator | None = None) -> None:
    """Codes a video in another way, or noise in its place."""
    with av.open(str(video)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    if noise is not None:
        frames = [noise.integers(0, 256, frame.shape, np.uint8) for frame in frames]
    encode(video, frames, codec, options)
