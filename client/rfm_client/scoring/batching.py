# SPDX-License-Identifier: MIT
"""Group samples into requests: samples in a group fit the same arrays, within count and byte limits."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby

from rfm_client.contract.samples import Sample, stackable
from rfm_client.contract.wire import frames_name

MAX_REQUEST_BYTES = 8 * 2**20  # more gains nothing, because Triton batches requests


def model_of(sample: Sample, model: str) -> str:
    """Return the name of the model that scores the sample: the one for embeddings or for raw frames."""
    return model if sample.trajectories[0].frames is None else frames_name(model)


def groups(samples: Mapping[int, Sample], model: str) -> Iterator[tuple[str, list[int]]]:
    """Yield groups of samples that fit the same arrays: the model's name and the indices, short samples first."""

    def key(index: int) -> tuple[str, list[tuple[int, ...]], tuple[int, ...]]:
        trajectories = samples[index].trajectories
        shapes = [together[0].positions.shape[1:] for together in stackable(trajectories)]
        first = trajectories[0]
        shapes += [(number, *view.shape[1:]) for number, view in enumerate(first.views)]
        shapes += [] if first.goal is None else [first.goal.shape]
        text = first.text_embedding
        return model_of(samples[index], model), shapes, () if text is None else text.shape

    if len(samples) == 1:
        yield from ((model_of(sample, model), [index]) for index, sample in samples.items())
        return
    by_length = sorted(samples, key=lambda index: (key(index), num_positions(samples[index])))
    for (name, *_), group in groupby(by_length, key=key):
        yield name, list(group)


def parts(samples: Mapping[int, Sample], group: Sequence[int], max_batch_size: int) -> Iterator[list[int]]:
    """Split a group into requests: at most ``max_batch_size`` samples and, unless one has more, MAX_REQUEST_BYTES."""
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
    """Return how many bytes one request's frames or embeddings take with padding. The samples fit the same arrays."""
    longest: list[int] = [max(sizes) for sizes in zip(*map(array_bytes, samples), strict=True)]
    return len(samples) * sum(longest)


def num_positions(sample: Sample) -> int:
    """Return the frame count over all trajectories in the sample."""
    return sum(trajectory.num_frames for trajectory in sample.trajectories)


def array_bytes(sample: Sample) -> list[int]:
    """Return how many bytes the sample's frames or embeddings take in each array of the request."""
    first = sample.trajectories[0]
    if len(sample.trajectories) == 1:
        goal = () if first.goal is None else (first.goal,)
        return [array.nbytes for array in (first.positions, *first.views, *goal)]
    return [sum(t.positions.nbytes for t in together) for together in stackable(sample.trajectories)]
