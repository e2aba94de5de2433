# SPDX-License-Identifier: MIT
"""A dataset by its path or Hub id, whatever its layout."""

from __future__ import annotations

import re
from pathlib import Path

from rfm_client.data.datasets.hdf5 import SUFFIXES, Hdf5Dataset
from rfm_client.data.datasets.lerobot import LeRobotDataset
from rfm_client.data.datasets.lerobot_info import INFO_FILE
from rfm_client.data.datasets.other_layouts import described
from rfm_client.data.datasets.protocol import Dataset, DatasetError, GivenTask
from rfm_client.data.datasets.videos import TABLES, VideoFolder
from rfm_client.data.orientation import Orient

_HUB_ID = re.compile(r"([\w.-]+/[\w.-]+)(?:@([\w./-]+))?")
_LAYOUTS = (
    f"a LeRobot dataset ({INFO_FILE}), an HDF5 file ({', '.join(SUFFIXES)}), "
    f"a folder of videos with {' or '.join(TABLES)}, or a Hub id org/name[@revision]"
)


def open_dataset(
    source: str | Path, *, task: str | None = None, override_task: bool = False, orient: Orient = Orient()
) -> Dataset:
    """The dataset at a path, or of a Hub id ``org/name[@revision]``, which is downloaded. A path that exists wins.

    task: what is to be done in the episodes that do not say it; override_task: in all episodes
    orient: how the pictures of each camera are turned; HDF5 files that say that they are LIBERO's are turned without it

    Raises DatasetError.
    """
    path, given = Path(source), GivenTask(task, override_task)
    if path.is_file() and path.suffix.lower() in SUFFIXES:
        return Hdf5Dataset(path, task=given, orient=orient)
    if (path / INFO_FILE).is_file():
        return LeRobotDataset(path, task=given, orient=orient)
    if path.exists():
        has_table = path.suffix.lower() in (".csv", ".json") or any((path / table).is_file() for table in TABLES)
        other = None if has_table else described(path)
        if other is not None or (path.is_file() and not has_table):
            raise DatasetError.at(path, _LAYOUTS, other or "another file")
        return VideoFolder(path, task=given, orient=orient)
    match = _HUB_ID.fullmatch(str(source))
    if match is None:
        raise DatasetError.at(source, _LAYOUTS, "none")
    return _from_hub(match[1], match[2], given, orient)


def _from_hub(name: str, revision: str | None, task: GivenTask, orient: Orient) -> LeRobotDataset:
    """The dataset of the Hub at a commit, a branch or a tag; None: its main branch."""
    try:
        from huggingface_hub import snapshot_download
    except ImportError as error:
        raise ImportError('datasets of the Hub need huggingface-hub: pip install "./client[label]"') from error
    try:
        folder = Path(snapshot_download(name, repo_type="dataset", revision=revision))
    except (OSError, ValueError) as error:  # what the Hub's library raises, requests' errors included
        raise DatasetError.at(name, "a local dataset or one of the Hub", str(error).splitlines()[0]) from error
    commit = folder.name  # the folder is called after it
    return LeRobotDataset(folder, source=name, revision=commit, task=task, orient=orient)
