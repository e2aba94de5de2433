# SPDX-License-Identifier: MIT
"""RLDS datasets for the page, whose pictures are encoded as a video. T frames of an episode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rfm_labels import DatasetEpisode
from rfm_page.encoded import encoded
from rfm_page.links import check_links, links_in
from rfm_page.shown import ShownDataset


@dataclass(frozen=True)
class ShownRlds(ShownDataset):
    """An RLDS dataset for the page."""

    has_stored_pixels = False
    fps = 10.0  # the dataset does not say

    def check(self) -> None:
        """Raise DatasetError for a link out of the folder."""
        check_links(self.root, links_in(self.root))

    @property
    def cameras(self) -> Sequence[str]:
        """All cameras of the dataset."""
        return self.dataset.cameras

    def times_s(self, episode: DatasetEpisode) -> npt.NDArray[np.float64]:
        """Return float64 [T], times at equal distances, since the dataset has none."""
        return np.arange(episode.num_frames) / self.fps

    def mp4(self, episode: DatasetEpisode, camera: str, take: Callable[[int], object]) -> bytes:
        """Return the episode's pictures as a video of nearly the same colours. Raises DatasetError."""
        return encoded(self.dataset.stored_frames(episode, camera), self.fps, take)
