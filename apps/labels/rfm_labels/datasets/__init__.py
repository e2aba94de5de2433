# SPDX-License-Identifier: MIT
"""Datasets of episodes: LeRobot, HDF5, folders of videos, frames or arrays."""

from rfm_client.frames.orientation import Channels, Orient
from rfm_labels.datasets.opening import open_dataset
from rfm_labels.datasets.protocol import Dataset, DatasetEpisode, DatasetError, iter_episodes

__all__ = ["Channels", "Dataset", "DatasetEpisode", "DatasetError", "Orient", "iter_episodes", "open_dataset"]
