# SPDX-License-Identifier: MIT
"""gRPC with TLS and keys."""

from __future__ import annotations

import re
import socket
import subprocess
from dataclasses import replace
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner

import rfm_export
from commands import EXIT_S, REPOSITORY, command, wait_for_http
from engines import serve_config
from repositories import kill_model
from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints, TritonServer
from rfm.launch.tls import GrpcTls
from rfm_client import ServerUnavailableError
from rfm_client.transport.access import Access
from rfm_client.transport.status import read_status
from rfm_commands.cli import app
from secured import (
    AT_ONCE_S,
    KEY,
    PLAIN,
    PUBLIC_HOST,
    TRAJECTORY,
    Papers,
    client,
    denied_at_once,
    scores_right,
)

pytestmark = [pytest.mark.triton, pytest.mark.slow]


TRITON_GATE = "triton-grpc-protocol-gate"  # gRPC metadata that Triton was told to ask for


def test_grpc_is_encrypted_and_shows_the_key(secure: Endpoints, papers: Papers) -> None:
    assert secure.grpc_url.startswith("grpcs://127.0.0.1:")
    with client(secure.grpc_url, ca_file=papers.ca, headers={TRITON_GATE.title(): KEY}) as asked:
        asked.wait_ready(AT_ONCE_S)
        scores_right(asked)


@pytest.mark.parametrize("headers", [{}, {TRITON_GATE: "another"}], ids=["none", "another"])
def test_grpc_without_the_key_is_denied(secure: Endpoints, papers: Papers, headers: dict[str, str]) -> None:
    with (
        client(secure.grpc_url, ca_file=papers.ca, headers=headers) as asked,
        denied_at_once("access denied: .*is restricted"),
    ):
        asked.progress(TRAJECTORY)


def test_a_server_that_a_stranger_vouches_for_is_not_trusted(secure: Endpoints, papers: Papers) -> None:
    with client(secure.grpc_url, ca_file=papers.other_ca) as asked:
        assert not asked.is_ready()
        with denied_at_once("access denied: .*CERTIFICATE_VERIFY_FAILED"):
            asked.progress(TRAJECTORY)
    with (  # nor by the system
        client(secure.grpc_url) as asked,
        denied_at_once(r"CERTIFICATE_VERIFY_FAILED.*with ca_file \(--ca-file\)"),
    ):
        asked.progress(TRAJECTORY)


@pytest.mark.parametrize("scheme", ["grpc", "http"])
def test_a_client_without_tls_is_told(secure: Endpoints, scheme: str) -> None:
    url = secure.grpc_url.replace("grpcs", scheme)
    with client(url, retry=False) as asked, pytest.raises(ServerUnavailableError) as caught:
        asked.progress(TRAJECTORY)
    assert f" without TLS, got TLS: use {url.replace(scheme, f'{scheme}s')}" in str(caught.value)


def test_a_server_of_another_name_is_not_trusted(secure: Endpoints, papers: Papers) -> None:
    with (
        client(secure.grpc_url.replace("127.0.0.1", "localhost"), ca_file=papers.ca) as asked,
        denied_at_once("access"),
    ):
        asked.progress(TRAJECTORY)


def test_a_client_with_a_certificate_is_known(mutual: Endpoints, papers: Papers) -> None:
    with client(mutual.grpc_url, **papers.client) as asked:
        scores_right(asked)
    assert read_status(mutual.grpc_url, access=Access(**papers.client)).ready


def test_a_client_without_a_certificate_is_refused(mutual: Endpoints, papers: Papers) -> None:
    with client(mutual.grpc_url, ca_file=papers.ca, retry=False) as asked:  # Triton hangs up and does not say why
        with pytest.raises(ServerUnavailableError, match="Socket closed"):
            asked.progress(TRAJECTORY)
        assert not asked.is_ready()


def test_http_beside_tls_listens_on_loopback_alone(papers: Papers) -> None:
    tls = GrpcTls(papers.certificate, papers.key)
    endpoints = Endpoints("10.0.0.1", 8000, 8001, 8002, tls)
    arguments = TritonServer(REPOSITORY, endpoints, find_installation())._arguments(["rfm"])
    assert {"--http-address=127.0.0.1", "--grpc-address=10.0.0.1"} <= set(arguments)
    assert "--grpc-use-ssl=true" in tls.arguments()
    assert endpoints.http_url == "http://127.0.0.1:8000"


def test_the_gateway_beside_tls_listens_on_loopback_alone(mutual: Endpoints, gateway_port: int) -> None:
    """Else whoever has no certificate would be served by it, in the clear."""
    with httpx.Client(transport=httpx.HTTPTransport(retries=10)) as caller:  # it starts after Triton
        assert caller.get(f"http://127.0.0.1:{gateway_port}/health", timeout=AT_ONCE_S).json()["status"] == "healthy"
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((PUBLIC_HOST, gateway_port), AT_ONCE_S)


def test_tls_on_one_side_alone_gives_no_connection(mutual: Endpoints, papers: Papers) -> None:
    plain_grpc = mutual.grpc_url.replace("grpcs", "grpc")
    with client(plain_grpc, retry=False) as asked, pytest.raises(ServerUnavailableError):
        asked.progress(TRAJECTORY)
    for scheme in ("grpcs", "https"):
        url = f"{scheme}://127.0.0.1:{mutual.http_port}"
        with client(url, ca_file=papers.ca, retry=False) as asked, pytest.raises(ServerUnavailableError):
            asked.progress(TRAJECTORY)


@pytest.mark.parametrize("with_client_ca", [False, True], ids=["server", "mutual"])
def test_rfm_serve_heals_with_tls(papers: Papers, tmp_path: Path, with_client_ca: bool) -> None:
    """It is told of no certificate for itself. `rfm models` is, and shows that there is no other way in."""
    repository, endpoints = tmp_path / "model_repository", Endpoints.free()
    rfm_export.export(PLAIN.checkpoint, repository, serve_config(PLAIN))
    tls = GrpcTls(papers.certificate, papers.key, papers.ca if with_client_ca else None)
    endpoints = replace(endpoints, grpc_tls=tls)
    key_file = tmp_path / "key"
    key_file.touch(0o600)
    key_file.write_text(KEY)
    words = ["--grpc-certificate", papers.certificate, "--grpc-key", papers.key, "--admin-key-file", key_file]
    words += ["--grpc-client-ca", papers.ca] if with_client_ca else []
    with (tmp_path / "log").open("wb") as output:
        process = subprocess.Popen([*command(repository, endpoints), *map(str, words)], stdout=output, stderr=output)
    try:
        wait_for_http(process, endpoints)
        kill_model(repository)
        with client(endpoints.grpc_url, **papers.client) as asked:  # it asks again until the model is back
            scores_right(asked)
        log = (tmp_path / "log").read_text()
        assert re.search("rfm: triton is started again: (rfm: )?a process of it is dead", log)
        list_models = ["list", "--url", endpoints.grpc_url, "--admin-key-file", str(key_file)]
        own = ["--client-certificate", str(papers.client_certificate), "--client-key", str(papers.client_key)]
        trusted = ["--ca-file", str(papers.ca), *own]
        assert CliRunner().invoke(app, ["models", *trusted, *list_models]).stdout.split() == ["rfm", "1", "READY"]
        stranger = ["--ca-file", str(papers.other_ca), *own]
        for access in [stranger, trusted[:2]] if with_client_ca else [stranger]:
            refused = CliRunner().invoke(app, ["models", *access, *list_models])
            assert (refused.exit_code, refused.stdout) == (1, "")
            assert refused.stderr.startswith(f"rfm: {endpoints.grpc_url}: failed to connect")
    finally:
        process.terminate()
        process.wait(EXIT_S)  # Triton 2.51 gives 1 where a request met the dead process
