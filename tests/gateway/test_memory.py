# SPDX-License-Identifier: MIT
"""What refused requests leave in memory: nothing, also before Python's collector of cycles runs."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from gateway_requests import FIRST, SECOND, TINY, Json, Triton, dumped, filmed, preference, progress
from gateways import inside, poll
from rfm_client import PreferenceSample, ProgressSample, RewardClient, RewardError, Sample, Trajectory
from rfm_gateway.schema import TrajectoryInput
from servers import Endpoints

pytestmark = [pytest.mark.triton, pytest.mark.nightly]


def held() -> int:
    """How many objects with arrays there are."""
    return sum(type(each) in (Trajectory, TrajectoryInput) for each in gc.get_objects())


@contextmanager
def without_collector() -> Iterator[int]:
    """Yields how many objects with arrays there are at the beginning."""
    gc.collect()
    gc.disable()
    try:
        yield held()
    finally:
        gc.enable()


TOO_LONG = {**FIRST, "video_embeddings": np.zeros((3, 2), np.float32) + 3e38}
REFUSED: dict[str, tuple[list[Json], int]] = {
    "by the gateway": ([progress(filmed(1, 2)), progress(FIRST)], 422),
    "at a field": ([progress(FIRST), progress({**FIRST, "text_embedding": [[1.0]]})], 422),
    "by the model": ([progress(TOO_LONG), progress(FIRST), preference(TOO_LONG, SECOND)], 422),
    "by no Triton": ([progress(FIRST)], 503),
}


@pytest.mark.parametrize(("samples", "code"), REFUSED.values(), ids=REFUSED)
def test_a_refused_request_is_freed_at_once(triton: Triton, samples: list[Json], code: int) -> None:
    body = dumped(samples)
    url = triton.endpoints.grpc_url if code == 422 else Endpoints.free().grpc_url
    with inside(triton=url, model=TINY) as client:
        client.post("/evaluate_batch", content=dumped([progress(FIRST)]))
        with without_collector() as before:
            for _ in range(3):
                assert client.post("/evaluate_batch", content=body).status_code == code
            poll(lambda: held() == before)


def questions() -> list[Sample]:
    bad, good = (
        Trajectory(video_embeddings=np.full((3, 2), value, np.float32), text_embedding=np.ones(2, np.float32))
        for value in (3e38, 1.0)
    )
    return [ProgressSample(bad), ProgressSample(good), PreferenceSample(good, bad)]


CALLS: tuple[Callable[[RewardClient], object], ...] = (
    lambda client: client.progress(questions()[0].trajectories[0]),
    lambda client: client.evaluate(questions(), subsample=True),
    lambda client: client.preference(*questions()[2].trajectories, both_orders=True),
)


@pytest.mark.parametrize("is_there", [True, False], ids=["refused", "no Triton"])
def test_an_error_of_the_client_is_freed_with_its_arrays(triton: Triton, is_there: bool) -> None:
    url = triton.endpoints.grpc_url if is_there else Endpoints.free().grpc_url
    with RewardClient(url, model=TINY, retry=False, timeout_s=30) as client:
        for call in CALLS:
            with without_collector() as before:
                for _ in range(3):
                    with pytest.raises(RewardError):
                        call(client)
                poll(lambda before=before: held() == before)  # type: ignore[misc]
