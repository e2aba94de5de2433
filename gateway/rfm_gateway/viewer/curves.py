# SPDX-License-Identifier: MIT
"""The curve of an episode as its points come: each frame is scored on its prefix, a few prefixes at a time."""

from __future__ import annotations

import itertools
import math
from collections.abc import AsyncIterator, Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from rfm_client.async_client import AsyncRewardClient
from rfm_client.contract.errors import RewardError
from rfm_client.contract.results import ProgressResult
from rfm_client.contract.samples import ProgressSample, Trajectory, UInt8Array
from rfm_client.data.sampling import Sampling, prefix_samples
from rfm_client.transport.off_loop import off_loop
from rfm_gateway.versions import check_one, versions_of

MOST_PREFIXES = 32  # of one video at a time
MOST_BYTES = 64 * 2**20  # of the frames of these


@dataclass(frozen=True)
class Points:
    """Points of a curve, one after the other. first: the frame of the first one; None: the checkpoint has no score."""

    first: int
    progress: Sequence[float | None]
    success: Sequence[float | None]
    model_version: str | None


@dataclass(frozen=True)
class Call:
    """How a curve is asked for. timeout_s: of each of its calls, between which points come"""

    sampling: Sampling
    timeout_s: float
    request_id: str


@dataclass(frozen=True)
class Parts:
    """The prefixes of an episode that are asked about at a time.

    sample_bytes: of the frames of the largest prefix's sample; most: prefixes in a part
    """

    sample_bytes: int
    most: int

    @classmethod
    def of(cls, frames: UInt8Array, sampling: Sampling) -> Parts:
        """Those of an episode with these frames."""
        num_slots = max(sampling.frames or 0, len(frames))
        sample_bytes = num_slots * math.prod(frames.shape[1:])
        return cls(sample_bytes, max(min(MOST_PREFIXES, len(frames), MOST_BYTES // sample_bytes), 1))

    @property
    def num_bytes(self) -> int:
        """Bytes of the frames of one part."""
        return self.most * self.sample_bytes


async def curve(client: AsyncRewardClient, trajectory: Trajectory, call: Call) -> AsyncIterator[Points]:
    """The points of an episode of frames, in order. The first come alone, then twice as many, so that none waits long.

    Raises RewardError, also if one version of the checkpoint did not give all points.
    """
    assert trajectory.frames is not None
    parts = Parts.of(trajectory.frames, call.sampling)
    samples, first, count = prefix_samples(trajectory, call.sampling), 0, 1
    versions: set[str | None] = set()
    while part := await off_loop(count * parts.sample_bytes, _next, samples, count):
        outcomes = await client.evaluate(part, return_errors=True, timeout_s=call.timeout_s, request_id=call.request_id)
        points = _points(first, outcomes, call.sampling)
        versions |= versions_of(outcomes)
        check_one(versions)
        yield points
        first, count = first + len(part), min(2 * count, parts.most)


def or_none(score: float) -> float | None:
    """A score as JSON has it: null for one that the checkpoint does not predict."""
    return None if math.isnan(score) else score


def _next(samples: Iterator[ProgressSample], count: int) -> list[ProgressSample]:
    return list(itertools.islice(samples, count))


def _points(first: int, outcomes: Sequence[object], sampling: Sampling) -> Points:
    for outcome in outcomes:
        if isinstance(outcome, RewardError):
            raise outcome
    results = cast("Sequence[ProgressResult]", outcomes)
    reads = [sampling.prefix(t).read for t in range(first, first + len(results))]
    progress = np.array([result.progress[read] for result, read in zip(results, reads, strict=True)], np.float32)
    success = np.array([result.success[read] for result, read in zip(results, reads, strict=True)], np.float32)
    return Points(
        first,
        [or_none(score) for score in progress.tolist()],
        [or_none(score) for score in success.tolist()],
        results[-1].model_version,
    )
