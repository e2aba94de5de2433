# SPDX-License-Identifier: MIT
"""Several servers of one checkpoint, and a request that ends the model process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from patients import CALLERS, DEADLY, MARK, calling, make_repository, references, trajectory
from rfm_client import (
    ProgressSample,
    RewardClient,
)
from servers import MODEL, PATIENCE_S, Serving, serving

pytestmark = [pytest.mark.triton, pytest.mark.slow]

__all__ = ["references"]  # a fixture

POISON = trajectory(99, mark=MARK)
NUM_SERVERS = 3
LONG_S = 4 * PATIENCE_S  # generous, for slow machines


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[list[Serving]]:
    """Servers that heal themselves. A marked sample ends the model process."""
    with ExitStack() as stack:
        folders = [tmp_path / f"server-{number}" for number in range(NUM_SERVERS)]
        served = [stack.enter_context(serving(make_repository(folder, more_code=DEADLY))) for folder in folders]
        for server in served:
            server.wait_ready(True, LONG_S)
        yield served
        for server in served:
            server.process.terminate()  # side by side: each takes seconds


def test_a_request_that_ends_its_process_ends_two_of_a_fleet(
    fleet: list[Serving], references: list[np.ndarray[Any, Any]]
) -> None:
    urls = [server.endpoints.grpc_url for server in fleet]
    with (
        RewardClient(urls, timeout_s=LONG_S) as client,
        RewardClient(urls, timeout_s=LONG_S) as other,
        calling(client, references) as callers,
    ):
        callers.wait_for_all()
        # In a request with two others, which fail with it, by another client than the callers.
        batch = [ProgressSample(sample) for sample in (trajectory(0), POISON, trajectory(1))]
        outcomes = other.evaluate(batch, return_errors=True)
        assert all("ended twice during this request" in str(outcome) for outcome in outcomes), outcomes
        for server in fleet:
            server.wait_ready(True, LONG_S)
        assert sum(server.metric("rfm_serve_restarts_total", what=MODEL) for server in fleet) == 2
        lost = len(callers.lost)
        callers.wait_for_all()
    assert callers.wrong == 0
    # Who was in one batch with it twice is lost, too.
    assert all("ended twice during this request" in str(error) for error in callers.lost)
    assert len(callers.lost) == lost < CALLERS
