# SPDX-License-Identifier: MIT
"""A dataset by its path or Hub id, whatever its layout."""

from __future__ import annotations

import re
from pathlib import Path

from rfm_client.data.datasets.hdf5 import SUFFIXES, Hdf5Dataset
from rfm_client.data.datasets.lerobot import LeRobotDataset
from rfm_client.data.datasets.lerobot_info import INFO_FILE
from rfm_client.data.datasets.protocol import Dataset, DatasetError
from rfm_client.data.datasets.videos import TABLES, VideoFolder

_HUB_ID = re.compile(r"([\w.-]+/[\w.-]+)(?:@([\w./-]+))?")
_LAYOUTS = (
    f"a LeRobot dataset ({INFO_FILE}), an HDF5 file ({', '.join(SUFFIXES)}), "
    f"a folder of videos with {' or '.join(TABLES)}, or a Hub id org/name[@revision]"
)


def open_dataset(source: str | Path, *, task: str | None = None) -> Dataset:
    """The dataset at a path, or of a Hub id ``org/name[@revision]``, which is downloaded. A path that exists wins.

    task: what is to be done in all episodes of an HDF5 file that does not say it

    Raises DatasetError.
    """
    path = Path(source)
    if path.is_file() and path.suffix.lower() in SUFFIXES:
        return Hdf5Dataset(path, task=task)
    if task is not None:
        raise DatasetError.at("task", "none for a dataset that has its own tasks", repr(task))
    if (path / INFO_FILE).is_file():
        return LeRobotDataset(path)
    if path.exists():
        if path.is_file() and path.suffix.lower() not in (".csv", ".json"):
            raise DatasetError.at(path, _LAYOUTS, "another file")
        return VideoFolder(path)
    match = _HUB_ID.fullmatch(str(source))
    if match is None:
        raise DatasetError.at(source, _LAYOUTS, "none")
    return _from_hub(match[1], match[2])


def _from_hub(name: str, revision: str | None) -> LeRobotDataset:
    """The dataset of the Hub at a commit, a branch or a tag; None: its main branch."""
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise ImportError('datasets of the Hub need huggingface-hub: pip install "./client[label]"') from error
    try:
        folder = Path(snapshot_download(name, repo_type="dataset", revision=revision))
    except (OSError, ValueError) as error:  # what the Hub's library raises, requests' errors included
        raise DatasetError.at(name, "a local dataset or one of the Hub", str(error).splitlines()[0]) from error
    return LeRobotDataset(folder, source=name, revision=folder.name)  # the folder is called after the commit
