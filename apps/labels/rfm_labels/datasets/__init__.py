# SPDX-License-Identifier: MIT
"""Datasets of episodes: LeRobot, HDF5, folders of videos, frames or arrays."""

from rfm_labels.datasets.dataset import Dataset, DatasetEpisode, TaskOverride, iter_episodes
from rfm_labels.datasets.faults import DatasetError
from rfm_labels.datasets.hdf5 import Hdf5Dataset, is_hdf5
from rfm_labels.datasets.hdf5_contents import opened_hdf5
from rfm_labels.datasets.lerobot import LeRobotDataset
from rfm_labels.datasets.lerobot_meta import INFO_FILE, Info
from rfm_labels.datasets.lerobot_rows import TASK_COLUMN
from rfm_labels.datasets.opening import open_dataset
from rfm_labels.datasets.stored_files import Span

__all__ = [
    "INFO_FILE",
    "TASK_COLUMN",
    "Dataset",
    "DatasetEpisode",
    "DatasetError",
    "Hdf5Dataset",
    "Info",
    "LeRobotDataset",
    "Span",
    "TaskOverride",
    "is_hdf5",
    "iter_episodes",
    "open_dataset",
    "opened_hdf5",
]
