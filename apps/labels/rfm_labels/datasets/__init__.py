# SPDX-License-Identifier: MIT
"""Dataset classes, for programs that show more than ``rfm_labels.Dataset`` offers."""

from rfm_labels.datasets.hdf5 import Hdf5Dataset
from rfm_labels.datasets.hdf5_contents import opened_hdf5
from rfm_labels.datasets.lerobot import LeRobotDataset
from rfm_labels.datasets.opening import open_to_show
from rfm_labels.datasets.stored_files import Span

__all__ = ["Hdf5Dataset", "LeRobotDataset", "Span", "open_to_show", "opened_hdf5"]
