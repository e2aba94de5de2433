# SPDX-License-Identifier: MIT
"""Datasets for the page: copies of the toy datasets, videos coded otherwise, and columns of labels."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pyarrow as pa
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


def encoded_anew(video: Path, codec: str, options: dict[str, str]) -> None:
    """Encode a video in another way."""
    with av.open(str(video)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    encode(video, frames, codec, options)


def large(root: Path, num_episodes: int, seed: int = 0) -> Path:
    """Write a LeRobot v3.0 dataset of N two-frame episodes without videos, and labels."""
    source, numbers = LEROBOT / "toy_v30_many", np.arange(num_episodes)
    (root / "meta" / "episodes" / "chunk-000").mkdir(parents=True)
    (root / "data" / "chunk-000").mkdir(parents=True)
    shutil.copy(source / "meta" / "tasks.parquet", root / "meta")
    info = json.loads((source / "meta" / "info.json").read_text())
    info["features"] = {name: each for name, each in info["features"].items() if each["dtype"] != "video"}
    info |= {"total_episodes": num_episodes, "total_frames": 2 * num_episodes}
    (root / "meta" / "info.json").write_text(json.dumps(info))
    zeros, identity = np.zeros_like(numbers), {"index": np.arange(2 * num_episodes), "episode_index": numbers.repeat(2)}
    identity["frame_index"] = np.tile([0, 1], num_episodes)
    file = Path("chunk-000", "file-000.parquet")
    episodes = {"episode_index": numbers, "length": zeros + 2, "data/chunk_index": zeros, "data/file_index": zeros}
    names = parquet.read_table(root / "meta" / "tasks.parquet").to_pandas().index.tolist()
    episodes |= {"tasks": [[names[0]]] * num_episodes}
    episodes |= {"dataset_from_index": 2 * numbers, "dataset_to_index": 2 * numbers + 2}
    parquet.write_table(pa.table(episodes), root / "meta" / "episodes" / file)
    rows = {**identity, "timestamp": np.float32(identity["frame_index"] / 10), "task_index": zeros.repeat(2)}
    parquet.write_table(pa.table(rows), root / "data" / file)
    random = np.random.default_rng(seed)
    scores = {name: np.float32(random.random(2 * num_episodes)) for name in ("progress_sparse", "success")}
    parquet.write_table(pa.table({**identity, **scores}), root / "rfm_progress.parquet")
    return root


def hdf5(folder: Path) -> Path:
    """Write two demonstrations with smooth pictures of odd size, and depth maps."""
    file = folder / "demos.hdf5"
    rows, columns = np.mgrid[:63, :81]
    with h5py.File(file, "w") as opened:
        for number in (3, 7):
            pictures = [np.stack([rows * 3, columns * 3, rows * 0 + 10 * t + number], -1) for t in range(12)]
            opened[f"data/demo_{number}/obs/front"] = np.array(pictures, np.uint8)
            opened[f"data/demo_{number}/obs/range"] = np.ones((12, 63, 81), np.uint16)
        about = {"env_name": "Lift", "lang": "open the drawer", "env_kwargs": {"control_freq": 10}}
        opened["data"].attrs["env_args"] = json.dumps(about)
    return file
