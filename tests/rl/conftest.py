# SPDX-License-Identifier: MIT
"""Clients of a reference checkpoint, with prompt and with late answers."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from environments import MODEL, LateClient
from rfm_client import RewardClient
from servers import Served


@pytest.fixture
def client(served: Served) -> Iterator[RewardClient]:
    with served.client("grpc", MODEL) as client:
        yield client


@pytest.fixture
def late(served: Served) -> Iterator[LateClient]:
    with LateClient(served.url("grpc")) as client:
        yield client
