# SPDX-License-Identifier: MIT
"""Proxies from the environment, and local IPv6 addresses."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from client_commands import invoke
from engine_server import EngineServer
from proxies import HttpProxy, Proxy
from rfm_client import DeadlineExceededError, RewardClient
from rfm_client.contract.addresses import grpc_proxy
from rfm_client.contract.triton import unreachable
from rfm_client.serving import ServerStatus
from servers import Endpoints

VARIABLES = ("http_proxy", "https_proxy", "grpc_proxy", "HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY")
DEAD = "http://user:secret@127.0.0.1:9"
SHOWN = "http://***@127.0.0.1:9"
ELSEWHERE = "elsewhere.invalid"  # which only a proxy can find


@pytest.fixture(autouse=True)
def no_proxies(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (*VARIABLES, "no_proxy", "NO_PROXY", "no_grpc_proxy"):
        monkeypatch.delenv(name, raising=False)


def port_of(endpoints: Endpoints, scheme: str) -> int:
    return endpoints.grpc_port if scheme == "grpc" else endpoints.http_port


@pytest.fixture
def proxy(no_proxies: None, engines: EngineServer) -> Iterator[HttpProxy]:
    with HttpProxy(int(engines.url.rpartition(":")[2])) as proxy:
        yield proxy


@pytest.mark.parametrize(("scheme", "host"), [("grpc", "localhost"), ("http", "127.1.2.3")])
def test_this_machine_is_reached_without_a_proxy(
    demo_server: Endpoints, monkeypatch: pytest.MonkeyPatch, scheme: str, host: str
) -> None:
    for name in VARIABLES:
        monkeypatch.setenv(name, DEAD)
    with Proxy(port_of(demo_server, scheme), host=host) as near:
        url = f"{scheme}://{host}:{near.port}"
        with RewardClient(url, retry=False) as client:
            assert client.model_info().name == "rfm"
        assert ServerStatus.read(url, metrics_url=demo_server.metrics_url).devices


def test_other_hosts_are_reached_through_it(proxy: HttpProxy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", proxy.url)
    with RewardClient(f"grpc://{ELSEWHERE}:8001", retry=False) as client:
        assert client.model_info().name == "rfm"
    assert proxy.asked == [f"{ELSEWHERE}:8001"]
    assert ServerStatus.read(f"grpc://{ELSEWHERE}:8001", metrics_url="http://127.0.0.1:1").ready


def test_an_error_names_the_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("grpc_proxy", DEAD)
    for command in ("sample", "status"):
        message = invoke(command, "--url", "grpc://192.0.2.1:8001").stderr
        assert f"192.0.2.1:8001 through grpc_proxy={SHOWN}: no connection: " in message
        assert "add the host to no_proxy, unless this proxy leads to it" in message
        assert "secret" not in message
    monkeypatch.setenv("no_proxy", "192.0.2.0/24")
    assert "proxy" not in str(unreachable("grpc://192.0.2.1:8001", "Connection refused"))


def test_an_error_names_a_proxy_that_does_not_answer(engines: EngineServer, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        value = f"http://127.0.0.1:{silent.getsockname()[1]}"
        monkeypatch.setenv("http_proxy", value)
        url = "grpc://192.0.2.1:8001"
        late = f"^{url} through http_proxy={value}: no answer within 0.5 s$"
        with RewardClient(url, timeout_s=0.5) as client, pytest.raises(DeadlineExceededError, match=late):
            client.model_info()
        with pytest.raises(DeadlineExceededError, match=late):
            ServerStatus.read(url, timeout_s=0.5)
        monkeypatch.setenv("http_proxy", DEAD)
        error = ServerStatus.read(engines.url, metrics_url="http://192.0.2.1:8002/metrics").metrics_error
        assert f"(through http_proxy={SHOWN})" in str(error)


EXCEPTED = {
    "no variable": ({}, None),
    "empty": ({"grpc_proxy": "", "http_proxy": DEAD}, None),
    "the first that is set": ({"http_proxy": "http://b:1", "grpc_proxy": "http://a:1"}, "grpc_proxy=http://a:1"),
    "the end of its name": ({"http_proxy": DEAD, "no_proxy": ".LAB"}, None),
    "others": ({"http_proxy": DEAD, "no_proxy": "other.lab,localhost"}, f"http_proxy={SHOWN}"),
    "gRPC's own": ({"http_proxy": DEAD, "no_proxy": ".lab", "no_grpc_proxy": "other"}, f"http_proxy={SHOWN}"),
    "upper case": ({"HTTP_PROXY": DEAD}, None),
    "the host beside a network": ({"http_proxy": DEAD, "no_proxy": "10.0.0.0/8, server.lab"}, None),
}


@pytest.mark.parametrize(("environment", "expected"), EXCEPTED.values(), ids=EXCEPTED)
def test_which_proxy_grpc_takes(
    proxy: HttpProxy, monkeypatch: pytest.MonkeyPatch, environment: dict[str, str], expected: str | None
) -> None:
    """Also ask gRPC itself, which asks its proxy for the host."""
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert grpc_proxy("grpc://server.lab:8001") == expected
    assert grpc_proxy("grpc://localhost:8001") is grpc_proxy("http://server.lab:8000") is None
    for name, value in environment.items():
        if value and "no_" not in name:
            monkeypatch.setenv(name, proxy.url)
    with RewardClient("grpc://server.lab:8001", retry=False, timeout_s=10.0) as client:
        assert client.is_ready() == bool(proxy.asked) == (expected is not None)


def test_ipv6_addresses_are_reached(demo_server: Endpoints) -> None:
    with Proxy(demo_server.grpc_port, host="::1") as near:
        url, other = (f"{scheme}://[::1]:{near.port}" for scheme in ("grpc", "http"))
        with RewardClient(url) as client:
            assert client.model_info().name == "rfm"
        status = ServerStatus.read(url)
        assert (status.ready, status.metrics_url) == (True, None)
        message = invoke("sample", "--url", other).stderr
        assert "use grpc:// for its gRPC port" in message
