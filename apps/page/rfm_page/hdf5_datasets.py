# SPDX-License-Identifier: MIT
"""HDF5 datasets for the page, whose pictures are encoded as a video. Needs h5py. T frames of an episode.

A file with links to other files, or with data in them, is refused, since its author could show files of this machine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rfm_labels import DatasetEpisode, DatasetError, find_label_files
from rfm_labels.datasets import Hdf5Dataset, opened_hdf5
from rfm_page.encoded import encoded
from rfm_page.links import check_links
from rfm_page.shown import ShownDataset

_FILES_KNOWN = 64  # files whose last check is remembered


@dataclass(frozen=True)
class ShownHdf5(ShownDataset):
    """An HDF5 dataset for the page."""

    has_stored_pixels = False

    dataset: Hdf5Dataset

    @property
    def path(self) -> Path:
        """The file of the dataset."""
        return self.dataset.file

    def check(self) -> None:
        """Raise DatasetError for data in other files, in the dataset or its labels."""
        check_links(self.root, [self.path, *find_label_files(self.path)])
        _check_inside(self.path, _changed_ns(self.path))

    @property
    def cameras(self) -> Sequence[str]:
        """The cameras that are labelled without a choice."""
        return self.dataset.chosen_cameras()

    @property
    def fps(self) -> float:
        """Frames a second: robosuite's control frequency, else its default."""
        return self.dataset.fps

    def times_s(self, episode: DatasetEpisode) -> npt.NDArray[np.float64]:
        """Return float64 [T], times at equal distances, since the file has none."""
        return np.arange(episode.num_frames) / self.fps

    def mp4(self, episode: DatasetEpisode, camera: str, take: Callable[[int], object]) -> bytes:
        """Return the episode's pictures, as stored, as a video of nearly the same colours. Raises DatasetError."""
        return encoded(self.dataset.stored_frames(episode, camera), self.fps, take)


def _changed_ns(file: Path) -> int:
    """The time of a file's last change, which its author cannot set. Raises DatasetError."""
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
