# SPDX-License-Identifier: MIT
"""Find the faults of all chosen episodes before the first frame is scored."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

from rfm_client import RewardError
from rfm_labels.datasets.dataset import Dataset, DatasetEpisode
from rfm_labels.datasets.faults import FaultsError, require
from rfm_labels.options import LabelOptions
from rfm_labels.plan import chosen_numbers


@contextmanager
def all_faults(dataset: Dataset, options: LabelOptions) -> Iterator[None]:
    """Replace the error of a single episode by FaultsError with the faults of all chosen episodes.

    Other errors pass. A shard reports the faults of all shards, because all need the same episodes.
    """
    try:
        yield
    except RewardError:
        check_episodes(dataset, options)
        raise


def check_episodes(dataset: Dataset, options: LabelOptions) -> None:
    """Check the tables and frames of all chosen episodes, without decoding. Raises FaultsError, DatasetError."""
    numbers = chosen_numbers(dataset, replace(options, shard=None))
    cameras = dataset.chosen_cameras(options.cameras, numbers)
    faults: dict[int, RewardError] = {}
    before: list[DatasetEpisode] = []
    for number in numbers:
        try:
            episode = dataset.episode(number)
            check_order([*before[-1:], episode])
            for camera in cameras:
                dataset.check(episode, camera)
            before.append(episode)
        except RewardError as fault:
            faults[number] = fault
    if faults:
        raise FaultsError.of(faults, numbers)


def check_order(episodes: Sequence[DatasetEpisode]) -> None:
    """Raise DatasetError if two episodes share rows, or their rows have another order."""
    for before, episode in itertools.pairwise(episodes):
        end = before.first_index + before.num_frames
        got = f"{episode.first_index}: renumber the rows in the order of the episodes"
        expected = f"{end} or more, since {before.name} ends at {end - 1}"
        require(f"{episode.name}: index", episode.first_index >= end, expected, got)
