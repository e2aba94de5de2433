# SPDX-License-Identifier: MIT
"""The demo's repository, whose checkpoint knows the toy world of the datasets."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from paths import ROOT
from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints, TritonServer
from rfm_client import RewardClient


@pytest.fixture(scope="module")
def demo_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Endpoints]:
    folder = tmp_path_factory.mktemp("demo")
    repository = shutil.copytree(ROOT / "model_repository", folder / "model_repository")
    with (
        (folder / "tritonserver.log").open("wb") as log,
        TritonServer(repository, Endpoints.free(), find_installation(), log=log) as server,
    ):
        yield server.endpoints


@pytest.fixture
def client(demo_server: Endpoints) -> Iterator[RewardClient]:
    with RewardClient(demo_server.grpc_url) as client:
        yield client


@pytest.fixture
def output(tmp_path: Path) -> Path:
    folder = tmp_path / "labels"
    folder.mkdir()
    return folder
