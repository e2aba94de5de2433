# SPDX-License-Identifier: MIT
"""LeRobot and HDF5 datasets for the page, with or without labels. Needs pyarrow, and h5py for HDF5.

T frames per episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from rfm_labels import DatasetError, find_label_files
from rfm_labels.datasets import Hdf5Dataset, LeRobotDataset, opened_hdf5
from rfm_page.shown import ShownDataset, check_links

_FILES_KNOWN = 64  # HDF5 files whose last check is remembered


@dataclass(frozen=True)
class ShownLeRobot(ShownDataset):
    """A LeRobot dataset for the page."""

    dataset: LeRobotDataset

    @property
    def cameras(self) -> Sequence[str]:
        """The cameras with videos, and those with colour pictures."""
        unused, videos = self.dataset.unused_cameras(self.dataset.cameras), self.dataset.info.videos
        return [camera for camera in self.dataset.cameras if camera in videos or camera not in unused]


@dataclass(frozen=True)
class ShownHdf5(ShownDataset):
    """An HDF5 dataset for the page.

    Refuses a file that links to other files or stores data in them: its author could show files from this
    machine.
    """

    dataset: Hdf5Dataset

    @property
    def path(self) -> Path:
        """The single file that holds the dataset."""
        return self.dataset.file

    def check(self) -> None:
        """Raise DatasetError if the dataset or its labels keep data in other files."""
        check_links(self.root, [self.path, *find_label_files(self.path)])
        _check_inside(self.path, _changed_ns(self.path))

    @property
    def cameras(self) -> Sequence[str]:
        """The cameras that are labelled by default."""
        return self.dataset.chosen_cameras()


def _changed_ns(file: Path) -> int:
    """Return when a file last changed, a time that its author cannot set. Raises DatasetError."""
    try:
        return file.stat().st_ctime_ns
    except OSError as error:
        raise DatasetError.at(file, "an HDF5 file", error.strerror) from error


@lru_cache(_FILES_KNOWN)
def _check_inside(file: Path, _changed_ns: int) -> None:
    """Raise DatasetError for data in another file."""
    import h5py

    def leaves(name: str, link: Any) -> str | None:
        if isinstance(link, h5py.ExternalLink):
            return name
        found = opened.get(name) if isinstance(link, h5py.HardLink) else None
        is_outside = isinstance(found, h5py.Dataset) and (found.external or found.is_virtual)
        return name if is_outside else None

    with opened_hdf5(file) as opened:
        name = opened.visititems_links(leaves)
    if name is not None:
        raise DatasetError.at(f"{file}: {name}", "data in the file", "data in another file: copy them into it")
