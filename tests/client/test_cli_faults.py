# SPDX-License-Identifier: MIT
"""rfm-client when a server goes away during a request, and URLs with a wrong port."""

from __future__ import annotations

import json
import re
import subprocess
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from client_commands import RFM_CLIENT, invoke, rows
from engine_server import EngineServer
from gateways import running
from proxies import Proxy
from rfm_client import RewardClient, ServerUnavailableError
from rfm_client.command_line import ExitCode
from servers import Endpoints, folder_server, wait_for

NUM_SOURCES = 1000  # more than are scored before the server is gone
NOT_ASKED = "not asked, since no server answers any more"


PORTS = {
    "gRPC to HTTP": ("grpc", "http_port", "Triton's gRPC port, got its HTTP port: use http://{address}"),
    "HTTP to gRPC": ("http", "grpc_port", "Triton's HTTP port, got its gRPC port: use grpc://{address}"),
    "gRPC to metrics": (
        *("grpc", "metrics_port"),
        "Triton's gRPC port, got its metrics port: use grpc://127.0.0.1:8001, unless the server was given another",
    ),
    "HTTP to metrics": (
        *("http", "metrics_port"),
        "Triton's HTTP port, got its metrics port: use http://127.0.0.1:8000, unless the server was given another",
    ),
}


@pytest.mark.parametrize(("scheme", "port", "told"), PORTS.values(), ids=PORTS)
def test_a_wrong_port_is_told_with_the_right_one(demo_server: Endpoints, scheme: str, port: str, told: str) -> None:
    address = f"127.0.0.1:{getattr(demo_server, port)}"
    expected = f"{scheme}://{address}: expected {told.format(address=address)}"
    for command in ("sample", "status", "wait"):
        result = invoke(command, "--url", f"{scheme}://{address}")
        assert result.exit_code == ExitCode.UNAVAILABLE
        assert result.stderr.splitlines()[-1] == f"rfm-client: {expected}"
    with RewardClient(f"{scheme}://{address}", retry=False) as client, pytest.raises(ServerUnavailableError) as caught:
        client.model_info()
    assert str(caught.value) == expected


def test_tls_where_there_is_none_is_told(demo_server: Endpoints) -> None:
    for url in (demo_server.grpc_url, demo_server.http_url):
        secure = url.replace("://", "s://")
        with RewardClient(secure, retry=False) as client, pytest.raises(ServerUnavailableError) as caught:
            client.model_info()
        assert " with TLS, got its " in str(caught.value)
        assert str(caught.value).endswith(f" without: use {url}")


def test_a_gateway_is_no_triton(demo_server: Endpoints, tmp_path: Path) -> None:
    with running(demo_server, tmp_path) as gateway:
        for url in (gateway.url, gateway.url.replace("http", "grpc")):
            result = invoke("sample", "--url", url)
            assert result.exit_code == ExitCode.UNAVAILABLE
            assert "got a gateway's: use that of the Triton behind it, by default 800" in result.stderr


def test_the_port_of_something_else_is_not_told_wrong(tmp_path: Path) -> None:
    with folder_server(tmp_path) as url:
        result = invoke("sample", "--url", url)
    assert result.exit_code != ExitCode.OK
    assert "expected Triton's" not in result.stderr


ENDS = {"has gone": ExitCode.UNAVAILABLE, "hangs": ExitCode.DEADLINE}


@pytest.mark.slow
@pytest.mark.parametrize("how", ENDS)
def test_a_server_that_goes_away_is_not_asked_any_more(engines: EngineServer, tmp_path: Path, how: str) -> None:
    random = np.random.default_rng(0)
    source, target = tmp_path / "episode.npz", tmp_path / "scores.json"
    shown, told = tmp_path / "stdout", tmp_path / "stderr"
    embeddings = {"video_embeddings": random.random((8, 64)), "text_embedding": random.random(32)}
    np.savez(source, **{name: array.astype(np.float32) for name, array in embeddings.items()})
    with ExitStack() as proxies:
        proxy = proxies.enter_context(Proxy(int(engines.url.rpartition(":")[2])))
        url = f"grpc://127.0.0.1:{proxy.port}"
        words = ("score", *[source] * NUM_SOURCES, "--timeout", 1, "--json", target, "--url", url)
        with shown.open("w") as out, told.open("w") as err:
            process = subprocess.Popen([str(RFM_CLIENT), *map(str, words)], stdout=out, stderr=err)
            wait_for(lambda: len(rows(shown.read_text(), str(source))) >= 5)  # they come while others are asked
            if how == "hangs":
                proxies.enter_context(proxy.held())
            else:
                proxies.close()
            assert process.wait(timeout=60) == ENDS[how], told.read_text()
    scored = rows(shown.read_text(), str(source))
    outcomes = json.loads(target.read_text())["videos"]
    failures = [outcome for outcome in outcomes if "error" in outcome]
    assert len(outcomes) == NUM_SOURCES == len(scored) + len(failures)
    not_asked = [failure for failure in failures if failure["error"] == NOT_ASKED]
    assert 0 < len(failures) - len(not_asked) <= 8
    assert len(re.findall(f"^rfm-client: {source}: {NOT_ASKED}$", told.read_text(), re.MULTILINE)) == len(not_asked) > 0
