# SPDX-License-Identifier: MIT
"""A refused request leaves nothing in memory, also before Python's collector of cycles runs."""

from __future__ import annotations

import gc

import numpy as np
import pytest

from gateway_requests import FIRST, SECOND, TINY, Json, Triton, dumped, filmed, preference, progress
from gateways import inside
from rfm_client import Trajectory
from rfm_gateway.schema import TrajectoryInput
from servers import Endpoints, wait_for

pytestmark = [pytest.mark.triton, pytest.mark.nightly]


def held() -> int:
    """How many objects with arrays there are."""
    return sum(type(each) in (Trajectory, TrajectoryInput) for each in gc.get_objects())


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
        gc.collect()
        before = held()
        gc.disable()
        try:
            for _ in range(3):
                assert client.post("/evaluate_batch", content=body).status_code == code
            wait_for(lambda: held() == before)
        finally:
            gc.enable()
