# SPDX-License-Identifier: MIT
"""Calls that share requests, at a real server."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from mixtures import MODEL, assert_same, counts, mixed_samples
from reference_server import Served
from rfm_client import (
    AsyncRewardClient,
    InvalidSampleError,
    ProgressSample,
    Result,
    RewardClient,
    Sample,
)
from rfm_client.contract.model_info import ModelInfo
from trajectories import random_trajectory


def asked_by_tasks(url: str, samples: Sequence[Sample], **options: Any) -> list[Result | BaseException]:
    async def ask() -> list[Result | BaseException]:
        async with AsyncRewardClient(url, model=MODEL, **{"join": True, **options}) as client:
            await client.model_info()
            calls: list[Awaitable[Result]] = [client.score(sample) for sample in samples]
            return await asyncio.gather(*calls, return_exceptions=True)

    return asyncio.run(ask())


def asked_by_threads(url: str, samples: Sequence[Sample], **options: Any) -> list[Result | BaseException]:
    with RewardClient(url, model=MODEL, **{"join": True, **options}) as client, ThreadPoolExecutor(32) as pool:
        client.model_info()

        def ask(sample: Sample) -> Result | BaseException:
            return client.evaluate([sample], return_errors=True)[0]

        return list(pool.map(ask, samples))


def asked_by_futures(url: str, samples: Sequence[Sample], **options: Any) -> list[Result | BaseException]:
    with RewardClient(url, model=MODEL, **{"join": True, **options}) as client:
        client.model_info()
        futures = [client.submit(sample) for sample in samples]  # type: ignore[call-overload]
        return [future.exception() or future.result() for future in futures]


STYLES = [asked_by_tasks, asked_by_threads, asked_by_futures]


@pytest.mark.parametrize("style", STYLES, ids=lambda style: str(style.__name__))
def test_joined_calls_give_the_answers_of_calls_apart_with_fewer_requests(
    served: Served, protocol: str, style: Callable[..., list[Result | BaseException]]
) -> None:
    samples = mixed_samples(150)
    samples[40:40] = [ProgressSample(random_trajectory(0, 20))]  # longer than the checkpoint takes
    num_before = counts(served, MODEL)[0]
    joined = style(served.url(protocol), samples)
    num_joined = counts(served, MODEL)[0] - num_before
    apart = style(served.url(protocol), samples, join=False)
    # Triton counts the one that is refused as a success if it is refused later than ``execute`` returns.
    assert counts(served, MODEL)[0] - num_before - num_joined in (150, 151)
    assert num_joined < 120
    for index, (one, other) in enumerate(zip(joined, apart, strict=True)):
        if index == 40:
            assert isinstance(one, InvalidSampleError)
            assert isinstance(other, InvalidSampleError)
            assert one.message == other.message
            assert "num_frames: expected at most 16" in one.message
        else:
            assert_same(one, other)


INSTANCE_GROUPS: dict[str, tuple[list[dict[str, Any]], int]] = {
    "on the CPU": ([{"count": 3, "kind": "KIND_CPU", "gpus": []}], 3),
    "on each of two GPUs": ([{"count": 2, "kind": "KIND_GPU", "gpus": [0, 1]}], 4),
    "in two groups": ([{"count": 1, "gpus": [0]}, {"count": 2}], 3),
    "an ensemble": ([], 0),
}


@pytest.mark.parametrize(("groups", "instances"), INSTANCE_GROUPS.values(), ids=INSTANCE_GROUPS)
def test_instances_are_counted_on_every_device(groups: list[dict[str, Any]], instances: int) -> None:
    config = {"name": "rfm", "max_batch_size": 8, "input": [], "output": [], "instance_group": groups}
    assert ModelInfo.from_config(config).instances == instances


def test_a_server_tells_how_many_instances_it_has(served: Served, protocol: str) -> None:
    with served.client(protocol) as client:
        assert client.model_info().instances == 1
