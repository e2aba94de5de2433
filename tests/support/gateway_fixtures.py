# SPDX-License-Identifier: MIT
"""Fixtures of the gateway and the page: a Triton with three small models, a gateway for each, and a browser.

Every test session reads this file, so each fixture imports the packages that it needs.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pytest
import torch

if TYPE_CHECKING:
    from browsers import Browser
    from gateway_requests import Ask, Triton
    from gateways import Gateway
    from rfm.families.rewind.network import RewindTransformer

TINY, ENCODERS, VLM = "rfm", "encoders", "vlm"  # models: two numbers a frame; encoders; vision-language in video mode


@pytest.fixture(scope="session")
def tiny_network() -> RewindTransformer:
    from gateway_requests import TINY_CONFIG
    from rfm.families.rewind.network import RewindTransformer

    torch.manual_seed(0)
    return RewindTransformer(TINY_CONFIG)


@pytest.fixture(scope="session")
def triton(tmp_path_factory: pytest.TempPathFactory, tiny_network: RewindTransformer) -> Iterator[Triton]:
    import goldens
    import rfm_export
    from commands import own_regions
    from engines import serve_config
    from gateway_requests import TINY_CONFIG, Triton
    from proxies import Proxy
    from rfm.config import ExportConfig
    from rfm.families.rewind.checkpoint import RewindCheckpoint
    from servers import Endpoints, start_triton

    folder = tmp_path_factory.mktemp("gateway_triton")
    repository, checkpoint = folder / "model_repository", folder / "two_wide"
    RewindCheckpoint(TINY_CONFIG, tiny_network.state_dict()).save(checkpoint)
    rfm_export.export(checkpoint, repository, ExportConfig(name=TINY, num_gpus=0, torch_threads=1))
    for config, name in ((goldens.config("enc_c1_t1_disc10"), ENCODERS), (goldens.config("q25_video_last_l2"), VLM)):
        rfm_export.export(config.checkpoint, repository, serve_config(config, name))
    regions = own_regions(os.getpid())
    with (
        start_triton(repository) as server,
        Proxy(server.endpoints.http_port) as http,
        Proxy(server.endpoints.grpc_port) as grpc,
        Proxy(server.endpoints.metrics_port) as metrics,
    ):
        endpoints = Endpoints(http_port=http.port, grpc_port=grpc.port, metrics_port=metrics.port)
        yield Triton(repository, endpoints, (http, grpc, metrics))
    assert own_regions(os.getpid()) <= regions


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """The shared browser."""
    from browsers import chromium

    with chromium(tmp_path_factory.mktemp("downloads")) as started:
        yield started


@pytest.fixture
def quiet_browser(browser: Browser) -> Iterator[Browser]:
    """The browser; fails the test if the page asks another machine or the console shows an error."""
    browser.driver.get("about:blank")  # the page of the last test asks no more
    browser.complaints()
    yield browser
    asked = browser.asked()
    assert asked
    assert [url for url in asked if not url.startswith(("http://127.0.0.1:", "blob:", "data:"))] == []
    assert [line for line in browser.complaints() if "viewer/score" not in line] == []  # of the files it refuses


def gateway_of(model: str) -> Any:
    @pytest.fixture(scope="session")
    def gateway(triton: Triton, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
        from gateways import running

        with running(triton.endpoints, tmp_path_factory.mktemp("gateway"), model) as started:
            yield started
            assert not started.metric("requests_total", code="500")

    return gateway


tiny, encoders, video = gateway_of(TINY), gateway_of(ENCODERS), gateway_of(VLM)


@pytest.fixture(params=["json", "npy"])
def ask(request: pytest.FixtureRequest) -> Ask:
    import gateway_requests

    function: Ask = getattr(gateway_requests, f"ask_{request.param}")
    return function
