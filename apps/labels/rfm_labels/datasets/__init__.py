# SPDX-License-Identifier: MIT
"""Kinds of datasets, for programs that show more of them than ``rfm_labels.Dataset`` has."""

from rfm_labels.datasets.hdf5 import Hdf5Dataset
from rfm_labels.datasets.hdf5_layouts import opened_hdf5
from rfm_labels.datasets.lerobot import LeRobotDataset
from rfm_labels.datasets.opening import open_to_show
from rfm_labels.datasets.stored_files import Span

__all__ = ["Hdf5Dataset", "LeRobotDataset", "Span", "open_to_show", "opened_hdf5"]
