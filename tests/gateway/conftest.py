# SPDX-License-Identifier: MIT
"""A Triton with three small models, and a gateway for each."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
import torch

import goldens
import rfm_export
from browsers import Browser, chromium
from engines import serve_config
from gateway_requests import (
    ENCODERS,
    TINY,
    TINY_CONFIG,
    VLM,
    Ask,
    Triton,
    ask_json,
    ask_npy,
    fixture_of,
)
from proxies import Proxy
from rfm.config import ExportConfig
from rfm.launch.cleanup import REGION_PREFIX, SHARED_MEMORY
from rfm.rewind.checkpoint import RewindCheckpoint
from rfm.rewind.network import RewindTransformer
from servers import Endpoints, start_triton


@pytest.fixture(scope="package")
def tiny_network() -> RewindTransformer:
    torch.manual_seed(0)
    return RewindTransformer(TINY_CONFIG)


@pytest.fixture(scope="package")
def triton(tmp_path_factory: pytest.TempPathFactory, tiny_network: RewindTransformer) -> Iterator[Triton]:
    folder = tmp_path_factory.mktemp("gateway_triton")
    repository, checkpoint = folder / "model_repository", folder / "two_wide"
    RewindCheckpoint(TINY_CONFIG, tiny_network.state_dict()).save(checkpoint)
    rfm_export.export(checkpoint, repository, ExportConfig(name=TINY, num_gpus=0, torch_threads=1))
    for config, name in ((goldens.config("enc_c1_t1_disc10"), ENCODERS), (goldens.config("q25_video_last_l2"), VLM)):
        rfm_export.export(config.checkpoint, repository, serve_config(config, name))
    ours = f"{REGION_PREFIX}_{os.getpid()}_*"  # others test beside us
    regions = set(SHARED_MEMORY.glob(ours))
    with (
        start_triton(repository) as server,
        Proxy(server.endpoints.http_port) as http,
        Proxy(server.endpoints.grpc_port) as grpc,
        Proxy(server.endpoints.metrics_port) as metrics,
    ):
        endpoints = Endpoints(http_port=http.port, grpc_port=grpc.port, metrics_port=metrics.port)
        yield Triton(repository, endpoints, (http, grpc, metrics))
    assert set(SHARED_MEMORY.glob(ours)) <= regions


@pytest.fixture(scope="package")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """The one browser of all tests of the page."""
    with chromium(tmp_path_factory.mktemp("downloads")) as started:
        yield started


@pytest.fixture
def quiet_browser(browser: Browser) -> Iterator[Browser]:
    """The browser, which asks nothing outside this machine in the test and whose console shows no error."""
    browser.driver.get("about:blank")  # the page of the test before asks its gateway no more
    browser.complaints()
    yield browser
    asked = browser.asked()
    assert asked
    assert [url for url in asked if not url.startswith(("http://127.0.0.1:", "blob:", "data:"))] == []
    assert [line for line in browser.complaints() if "viewer/score" not in line] == []  # of the files it refuses


tiny, encoders, video = fixture_of(TINY), fixture_of(ENCODERS), fixture_of(VLM)


strict = fixture_of(TINY, "--timeout", "1", "--max-in-flight", "1", "--max-waiting", "0", "--max-body-mib", "1")


@pytest.fixture(params=[ask_json, ask_npy], ids=["json", "npy"])
def ask(request: pytest.FixtureRequest) -> Ask:
    function: Ask = request.param
    return function
