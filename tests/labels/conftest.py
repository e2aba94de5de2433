# SPDX-License-Identifier: MIT
"""The demo's checkpoint, which knows the toy world of the datasets."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rfm_client import RewardClient
from servers import Endpoints


@pytest.fixture
def client(demo_server: Endpoints) -> Iterator[RewardClient]:
    with RewardClient(demo_server.grpc_url) as client:
        yield client


@pytest.fixture
def output(tmp_path: Path) -> Path:
    folder = tmp_path / "labels"
    folder.mkdir()
    return folder
