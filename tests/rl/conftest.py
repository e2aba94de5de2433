# SPDX-License-Identifier: MIT
"""Clients for the tests of the wrappers."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from environments import MODEL, LateClient
from reference_server import Served
from rfm_client import RewardClient


@pytest.fixture
def client(served: Served) -> Iterator[RewardClient]:
    with served.client("grpc", MODEL) as client:
        yield client


@pytest.fixture
def late(served: Served) -> Iterator[LateClient]:
    with LateClient(served.url("grpc")) as client:
        yield client
