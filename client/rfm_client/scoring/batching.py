# SPDX-License-Identifier: MIT
"""Which samples go into one request: those that fit the same arrays, bounded in number and bytes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby

from rfm_client.contract.names import frames_name
from rfm_client.contract.samples import Sample, stackable

MAX_REQUEST_BYTES = 8 * 2**20  # more gains nothing: Triton puts requests together


def model_of(sample: Sample, model: str) -> str:
    """Name of the model that scores the sample: that of embeddings or that of raw frames."""
    return model if sample.trajectories[0].frames is None else frames_name(model)


def groups(samples: Mapping[int, Sample], model: str) -> Iterator[tuple[str, list[int]]]:
    """The samples in groups that fit the same arrays: the model of each group, and its indices, short ones first."""

    def key(index: int) -> tuple[str, list[tuple[int, ...]], tuple[int, ...]]:
        trajectories = samples[index].trajectories
        shapes = [together[0].positions.shape[1:] for together in stackable(trajectories)]
        text = trajectories[0].text_embedding
        return model_of(samples[index], model), shapes, () if text is None else text.shape

    by_length = sorted(samples, key=lambda index: (key(index), num_positions(samples[index])))
    for (name, *_), group in groupby(by_length, key=key):
        yield name, list(group)


def parts(samples: Mapping[int, Sample], group: Sequence[int], max_batch_size: int) -> Iterator[list[int]]:
    """A group cut into requests of at most ``max_batch_size`` samples, and MAX_REQUEST_BYTES unless one has more."""
    part: list[int] = []
    longest: list[int] = []
    for index in group:
        sizes = array_bytes(samples[index])
        longest = list(map(max, longest, sizes)) if part else sizes
        if part and ((len(part) + 1) * sum(longest) > MAX_REQUEST_BYTES or len(part) == max_batch_size):
            yield part
            part, longest = [], sizes
        part.append(index)
    yield part


def padded_bytes(samples: Sequence[Sample]) -> int:
    """Bytes of the frame positions of one request of these samples, which fit the same arrays."""
    longest: list[int] = [max(sizes) for sizes in zip(*map(array_bytes, samples), strict=True)]
    return len(samples) * sum(longest)


def num_positions(sample: Sample) -> int:
    """Number of frames of all trajectories of the sample."""
    return sum(trajectory.num_frames for trajectory in sample.trajectories)


def array_bytes(sample: Sample) -> list[int]:
    """Bytes of the sample's frame positions in each of the arrays that hold them."""
    if len(sample.trajectories) == 1:
        return [sample.trajectories[0].positions.nbytes]
    return [sum(t.positions.nbytes for t in together) for together in stackable(sample.trajectories)]
