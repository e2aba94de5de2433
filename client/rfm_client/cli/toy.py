# SPDX-License-Identifier: MIT
"""Samples made up from a seed, to see that a server answers and how fast. Their scores mean nothing."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum

import numpy as np

from rfm_client.client import RewardClient
from rfm_client.contract.errors import ModelNotFoundError
from rfm_client.contract.made_up import random_trajectory
from rfm_client.contract.model_info import ModelInfo
from rfm_client.contract.samples import PreferenceSample, ProgressSample, Sample, SimilaritySample, Trajectory

TASK = "put the block in the bowl"

_LENGTHS = re.compile(r"([1-9][0-9]{0,3})(?:-([1-9][0-9]{0,3}))?")  # a longer one would only fill the memory


class SampleKind(str, Enum):
    """The type of a sample, by its name on the command line."""

    progress = "progress"
    preference = "preference"
    similarity = "similarity"


@dataclass(frozen=True)
class Toy:
    """A recipe for made-up samples.

    lengths: frames of the trajectories, taken in turn, in an order that the seed gives
    use_frames: raw frames; else embeddings, unless the served checkpoint reads frames alone
    """

    kind: SampleKind
    num_samples: int
    lengths: Sequence[int]
    use_frames: bool
    seed: int

    def samples(self, client: RewardClient) -> list[Sample]:
        """The samples, in the widths of the served checkpoint. Raises ModelNotFoundError if it does not take them."""
        info = self._model_info(client)
        random = np.random.default_rng(self.seed)
        trajectories = self._trajectories(random, info)
        if self.kind is SampleKind.progress:
            return [ProgressSample(next(trajectories)) for _ in range(self.num_samples)]
        pair = PreferenceSample if self.kind is SampleKind.preference else SimilaritySample
        return [pair(next(trajectories), next(trajectories)) for _ in range(self.num_samples)]

    def _model_info(self, client: RewardClient) -> ModelInfo:
        if not self.use_frames:
            with suppress(ModelNotFoundError):
                return client.model_info()
        return client.model_info(frames=True)

    def _trajectories(self, random: np.random.Generator, info: ModelInfo) -> Iterator[Trajectory]:
        for length in itertools.cycle(random.permutation(self.lengths).tolist()):
            yield random_trajectory(random, length, info.widths, task=TASK)


def are_frames(samples: Sequence[Sample]) -> bool:
    """Whether made-up samples are of raw frames."""
    return samples[0].trajectories[0].frames is not None


def parse_lengths(text: str) -> list[int]:
    """The lengths that ``8``, ``4,8,16`` or ``4-16`` names. Raises ValueError."""
    lengths: list[int] = []
    for part in text.split(","):
        match = _LENGTHS.fullmatch(part.strip())
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise ValueError(f"expected a length (8), several (4,8,16) or a range (4-16), got {text!r}")
        lengths += range(int(match[1]), int(match[2] or match[1]) + 1)
    return lengths
