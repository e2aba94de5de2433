# SPDX-License-Identifier: MIT
"""TLS and keys for gRPC, HTTP behind a proxy, and the gateway."""

from __future__ import annotations

import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import goldens
import rfm_export
from engines import load_engine, serve_config
from gateways import inside
from in_process import rfm, rfm_client
from rfm_client import AccessDeniedError, ProgressSample, RewardClient, ServerUnavailableError
from rfm_client.serving import Credentials, ServerStatus
from secured import PUBLIC_HOST, Papers, other_program
from servers import (
    KEY,
    PATIENCE_S,
    Endpoints,
    GrpcTls,
    Quiet,
    Serving,
    serving,
    start_triton,
    wait_for,
    web_server,
)
from tolerances import TOLERANCE
from trajectories import random_trajectory

PLAIN = goldens.config("c1_t1_disc10")
TRAJECTORY = random_trajectory(0, 5)
GATEWAY_PORT = Endpoints.free().http_port  # of the gateway beside ``mutual``
AT_ONCE_S = 20.0  # far less than the client would retry
GATED = "inference,health,metadata,model-config,statistics"
TRITON_GATE = "triton-grpc-protocol-gate"  # gRPC metadata that Triton was told to ask for

pytestmark = [pytest.mark.triton, pytest.mark.slow]


def scores_right(asked: RewardClient) -> None:
    expected = load_engine(PLAIN.name).evaluate([ProgressSample(TRAJECTORY)])[0]
    got = asked.progress(TRAJECTORY)
    np.testing.assert_allclose(got.progress, expected.progress, atol=TOLERANCE)  # type: ignore[union-attr]


@pytest.fixture(scope="module")
def repository(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exposed") / "model_repository"
    rfm_export.export(PLAIN.checkpoint, folder, serve_config(PLAIN))
    return folder


@pytest.fixture(scope="module")
def secure(repository: Path, papers: Papers, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Endpoints]:
    """TLS, without certificates of clients, and with a key."""
    folder = tmp_path_factory.mktemp("secure")
    endpoints = replace(Endpoints.free(), grpc_tls=GrpcTls(papers.certificate, papers.key))
    program = other_program(folder, f"--grpc-restricted-protocol={GATED}:gate={KEY}")
    with start_triton(repository, program, endpoints):
        yield endpoints


@pytest.fixture(scope="module")
def key_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the admin key of ``mutual``."""
    file = tmp_path_factory.mktemp("mutual") / "key"
    file.touch(0o600)
    file.write_text(f"{KEY}\n")
    return file


@pytest.fixture(scope="module")
def running(repository: Path, papers: Papers, key_file: Path) -> Iterator[Serving]:
    """``rfm serve`` with TLS and certificates of clients, and a gateway beside."""
    words = ["--grpc-certificate", papers.certificate, "--grpc-key", papers.key, "--grpc-client-ca", papers.ca]
    words += ["--host", PUBLIC_HOST, "--gateway-port", GATEWAY_PORT, "--admin-key-file", key_file]
    with serving(repository, *map(str, words)) as served:
        with RewardClient(served.endpoints.http_url) as asked:
            asked.wait_ready(PATIENCE_S)
        yield served


@pytest.fixture(scope="module")
def mutual(running: Serving, papers: Papers) -> Endpoints:
    tls = GrpcTls(papers.certificate, papers.key, papers.ca)
    return replace(running.endpoints, host=PUBLIC_HOST, grpc_tls=tls)


@pytest.mark.parametrize("scheme", ["grpc", "http"])
def test_a_client_without_tls_gets_a_remedy_that_names_tls(secure: Endpoints, scheme: str) -> None:
    url = secure.grpc_url.replace("grpcs", scheme)
    with RewardClient(url, retry=False) as asked, pytest.raises(ServerUnavailableError) as caught:
        asked.progress(TRAJECTORY)
    assert caught.value.fault.startswith(f"{url}: no connection: ")
    assert f"{scheme}s://" in caught.value.remedy


def test_a_client_without_tls_or_a_certificate_gets_no_connection(
    mutual: Endpoints, proxied: str, papers: Papers
) -> None:
    """Triton hangs up, and the proxy at one moment or another."""
    unavailable, ca = ServerUnavailableError, {"ca_file": papers.ca}
    for url, options, raised in (
        (mutual.grpc_url, ca, unavailable),
        (proxied, {**ca, "api_key": KEY}, (AccessDeniedError, unavailable)),
        (mutual.grpc_url.replace("grpcs", "grpc"), {}, unavailable),
        (f"grpcs://127.0.0.1:{mutual.http_port}", ca, unavailable),
        (f"https://127.0.0.1:{mutual.http_port}", ca, unavailable),
    ):
        with RewardClient(url, retry=False, **options) as asked:
            with pytest.raises(raised):
                asked.progress(TRAJECTORY)
            assert not asked.is_ready()


def test_the_gateway_beside_tls_listens_on_loopback_alone(mutual: Endpoints) -> None:
    """Otherwise it would serve callers without a certificate, in the clear."""
    with httpx.Client(transport=httpx.HTTPTransport(retries=10)) as caller:  # it starts after Triton
        url = f"http://127.0.0.1:{GATEWAY_PORT}/health"
        wait_for(lambda: caller.get(url, timeout=AT_ONCE_S).json().get("status") == "healthy")
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((PUBLIC_HOST, GATEWAY_PORT), AT_ONCE_S)


def test_rfm_models_shows_a_certificate(mutual: Endpoints, papers: Papers, key_file: Path) -> None:
    words = ["--url", mutual.grpc_url, "--admin-key-file", str(key_file)]
    own = ["--client-certificate", str(papers.client_certificate), "--client-key", str(papers.client_key)]
    assert rfm("models", "list", "--ca-file", str(papers.ca), *own, *words).stdout.split() == ["rfm", "1", "READY"]
    for credentials in (["--ca-file", str(papers.other_ca), *own], ["--ca-file", str(papers.ca)]):
        refused = rfm("models", "list", *credentials, *words)
        assert (refused.exit_code, refused.stdout) == (1, "")
        assert refused.stderr.startswith(f"rfm: {mutual.grpc_url}: failed to connect")


class Proxy(Quiet, BaseHTTPRequestHandler):
    """An HTTPS proxy like nginx or an ingress that asks for a certificate and a key."""

    protocol_version = "HTTP/1.1"

    def __init__(self, server_url: str, *connection: Any) -> None:
        self.server_url = server_url
        super().__init__(*connection)

    def do_POST(self) -> None:
        content = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        status, kept, body = 401, {"Content-Type": "application/json"}, b'{"error": "no key"}'
        if self.headers["Authorization"] == f"Bearer {KEY}":
            passed = {name: value for name, value in self.headers.items() if name.startswith("Inference")}
            passed["Accept-Encoding"] = "identity"
            answer = httpx.request(self.command, self.server_url + self.path, content=content, headers=passed)
            status, kept, body = answer.status_code, dict(answer.headers), answer.content
        self.send_response(status)
        for name, value in {**kept, "content-length": str(len(body))}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def do_GET(self) -> None:
        self.do_POST()


@pytest.fixture(scope="module")
def proxied(mutual: Endpoints, papers: Papers) -> Iterator[str]:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(papers.certificate, papers.key)
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(papers.ca)
    with web_server(partial(Proxy, mutual.http_url), context) as url:
        yield url


@dataclass(frozen=True)
class Door:
    """A way to a server: options of a client that may enter, and of others, with what they hear."""

    url: str
    good: dict[str, Any]
    denied: list[tuple[dict[str, Any], str]]


@pytest.fixture(scope="module")
def doors(secure: Endpoints, mutual: Endpoints, proxied: str, papers: Papers) -> dict[str, Door]:
    stranger = {**papers.client, "ca_file": papers.other_ca}
    shown = {"ca_file": papers.ca, "headers": {TRITON_GATE.title(): KEY}}
    return {
        "gRPC with a key": Door(
            secure.grpc_url,
            shown,
            [
                ({"ca_file": papers.ca}, ".*is restricted"),
                ({"ca_file": papers.ca, "headers": {TRITON_GATE: "another"}}, ".*is restricted"),
                ({"ca_file": papers.other_ca}, ".*CERTIFICATE_VERIFY_FAILED"),
                ({}, r".*CERTIFICATE_VERIFY_FAILED.*with ca_file \(--ca-file\)"),
            ],
        ),
        "gRPC at another address": Door(
            secure.grpc_url.replace("127.0.0.1", "[::ffff:127.0.0.1]"), {}, [({"ca_file": papers.ca}, "")]
        ),
        "gRPC with certificates": Door(mutual.grpc_url, papers.client, [(stranger, ".*CERTIFICATE_VERIFY_FAILED")]),
        "HTTP through a proxy": Door(
            proxied,
            {**papers.client, "api_key": KEY},
            [
                (papers.client, "no key"),
                ({**papers.client, "api_key": "another"}, "no key"),
                ({**stranger, "api_key": KEY}, ".*certificate verify failed"),
            ],
        ),
    }


@pytest.mark.parametrize(
    "name", ["gRPC with a key", "gRPC at another address", "gRPC with certificates", "HTTP through a proxy"]
)
def test_a_door_answers_who_may_enter_and_denies_others_at_once(doors: dict[str, Door], name: str) -> None:
    door = doors[name]
    if door.good:
        with RewardClient(door.url, **door.good) as asked:
            scores_right(asked)
        status = ServerStatus.read(door.url, credentials=Credentials(**door.good))
        assert [model.name for model in status.models] == ["rfm"]
    for options, told in door.denied:
        with RewardClient(door.url, **options) as asked:
            started_s = time.monotonic()
            assert not asked.is_ready()
            with pytest.raises(AccessDeniedError, match=f"access denied: {told}"):
                asked.progress(TRAJECTORY)
            assert time.monotonic() - started_s < AT_ONCE_S
        with pytest.raises(AccessDeniedError, match=f"access denied: {told}"):
            ServerStatus.read(door.url, credentials=Credentials(**options))


def test_a_closed_client_leaves_no_connection_to_a_server_that_hangs(papers: Papers) -> None:
    """The server never closes TLS, for which the cancelled call's connection would wait."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(papers.certificate, papers.key)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        with RewardClient(f"https://127.0.0.1:{listener.getsockname()[1]}", ca_file=papers.ca) as asked:
            asked.submit(ProgressSample(TRAJECTORY))
            hung = context.wrap_socket(listener.accept()[0], server_side=True)
            assert hung.recv(1)  # the request
        with socket.socket(fileno=hung.detach()) as beneath:
            beneath.settimeout(AT_ONCE_S)
            while beneath.recv(1024):
                pass


def test_unusable_credentials_are_refused(papers: Papers) -> None:
    """No description has a key."""
    assert KEY not in repr(Credentials(api_key=KEY, headers={"x-api-key": KEY}))
    for url, options, message in (
        ("grpc://h:1", {"ca_file": papers.ca}, "url: expected grpcs:// or https://"),
        ("grpcs://h:1", {"api_key": f"{KEY}\n"}, "api_key: expected visible ASCII characters"),
        ("grpcs://h:1", {"headers": {"a b": "1"}}, "headers: expected letters"),
    ):
        with pytest.raises(ValueError, match=message) as refused:
            RewardClient(url, **options)
        assert KEY not in str(refused.value)


def test_the_command_has_the_same_options(mutual: Endpoints, proxied: str, papers: Papers, tmp_path: Path) -> None:
    key_file = tmp_path / "key"
    key_file.write_text(f"{KEY}\n")
    names = {"ca_file": papers.ca, "client_certificate": papers.client_certificate, "client_key": papers.client_key}
    words = [f"--{name.replace('_', '-')}={file}" for name, file in names.items()]
    wrong = f"--ca-file={papers.other_ca}"
    done = rfm_client("sample", *words, "--url", mutual.grpc_url)
    assert done.exit_code == 0, done.output
    in_environment = {f"RFM_{name.upper()}": str(file) for name, file in {**names, "api_key_file": key_file}.items()}
    for name in ("sample", "status", "wait"):
        done = rfm_client(name, "--url", proxied, env=in_environment)
        assert done.exit_code == 0, done.output
    refused = rfm_client("sample", *words[1:], wrong, "--url", mutual.grpc_url)
    assert (refused.exit_code, "access denied" in refused.stderr) == (1, True)


def test_the_gateway_serves_https_before_a_triton_with_mutual_tls(
    mutual: Endpoints, papers: Papers, tmp_path: Path
) -> None:
    port = Endpoints.free().http_port
    words = ["--triton", mutual.grpc_url, "--metrics-url", mutual.metrics_url, "--port", port]
    words += ["--certificate", papers.certificate, "--key", papers.key, "--triton-ca-file", papers.ca]
    words += ["--triton-certificate", papers.client_certificate, "--triton-key", papers.client_key]
    command = [sys.executable, "-m", "rfm_gateway", *map(str, words)]
    url, trusted = f"https://127.0.0.1:{port}", ssl.create_default_context(cafile=papers.ca)
    with (tmp_path / "log").open("w") as log, subprocess.Popen(command, stdout=log, stderr=log) as process:
        try:
            with httpx.Client(transport=httpx.HTTPTransport(verify=trusted, retries=8), base_url=url) as caller:
                assert caller.get("/health").json()["status"] == "healthy", (tmp_path / "log").read_text()
                assert caller.get("/model_info").status_code == 200
            with pytest.raises(httpx.ConnectError, match="certificate verify failed"):
                httpx.get(f"{url}/health", verify=ssl.create_default_context(cafile=papers.other_ca))
            with pytest.raises(httpx.HTTPError):
                httpx.get(f"http://127.0.0.1:{port}/health")
        finally:
            process.terminate()


def test_the_gateway_s_own_certificate_is_not_the_caller_s_fault(mutual: Endpoints, papers: Papers) -> None:
    with inside(triton=mutual.grpc_url, triton_ca_file=papers.other_ca) as caller:
        answer = caller.get("/model_info")
    assert (answer.status_code, "access denied" in answer.json()["detail"]) == (502, True)
    assert "--triton-ca-file" in answer.json()["detail"]
    assert "(--ca-file)" not in answer.json()["detail"]
