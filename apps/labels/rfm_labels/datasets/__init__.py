# SPDX-License-Identifier: MIT
"""Datasets of episodes: LeRobot, HDF5, folders of videos, frames or arrays."""

from rfm_client.frames import Channels, Orient
from rfm_labels.datasets.hdf5 import Hdf5Dataset, is_hdf5
from rfm_labels.datasets.hdf5_contents import opened_hdf5
from rfm_labels.datasets.lerobot import LeRobotDataset
from rfm_labels.datasets.lerobot_rows import INFO_FILE, Info
from rfm_labels.datasets.lerobot_tasks import TASK_COLUMN
from rfm_labels.datasets.opening import open_dataset
from rfm_labels.datasets.protocol import (
    Dataset,
    DatasetEpisode,
    DatasetError,
    TaskOverride,
    chosen_cameras,
    iter_episodes,
    unused_cameras,
)
from rfm_labels.datasets.video_frames import Span

__all__ = [
    "INFO_FILE",
    "TASK_COLUMN",
    "Channels",
    "Dataset",
    "DatasetEpisode",
    "DatasetError",
    "Hdf5Dataset",
    "Info",
    "LeRobotDataset",
    "Orient",
    "Span",
    "TaskOverride",
    "chosen_cameras",
    "is_hdf5",
    "iter_episodes",
    "open_dataset",
    "opened_hdf5",
    "unused_cameras",
]
