# SPDX-License-Identifier: MIT
"""gRPC with TLS and keys."""

from __future__ import annotations

import re
import socket
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner

from repositories import kill_model
from rfm.launch.endpoints import Endpoints
from rfm_client import ServerUnavailableError
from rfm_client.status import read_status
from rfm_client.transport.access import Access
from rfm_commands.cli import app
from secured import (
    AT_ONCE_S,
    KEY,
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


def test_a_server_of_a_stranger_or_of_another_name_is_not_trusted(secure: Endpoints, papers: Papers) -> None:
    for url, options, told in (
        (secure.grpc_url, {"ca_file": papers.other_ca}, "access denied: .*CERTIFICATE_VERIFY_FAILED"),
        (secure.grpc_url, {}, r"CERTIFICATE_VERIFY_FAILED.*with ca_file \(--ca-file\)"),
        (secure.grpc_url.replace("127.0.0.1", "localhost"), {"ca_file": papers.ca}, "access"),
    ):
        with client(url, **options) as asked:
            assert not asked.is_ready()
            with denied_at_once(told):
                asked.progress(TRAJECTORY)


@pytest.mark.parametrize("scheme", ["grpc", "http"])
def test_a_client_without_tls_is_told(secure: Endpoints, scheme: str) -> None:
    url = secure.grpc_url.replace("grpcs", scheme)
    with client(url, retry=False) as asked, pytest.raises(ServerUnavailableError) as caught:
        asked.progress(TRAJECTORY)
    assert f" without TLS, got TLS: use {url.replace(scheme, f'{scheme}s')}" in str(caught.value)


def test_a_client_is_known_by_its_certificate(mutual: Endpoints, papers: Papers) -> None:
    with client(mutual.grpc_url, **papers.client) as asked:
        scores_right(asked)
    assert read_status(mutual.grpc_url, access=Access(**papers.client)).ready
    with client(mutual.grpc_url, ca_file=papers.ca, retry=False) as asked:  # Triton hangs up and does not say why
        with pytest.raises(ServerUnavailableError, match="Socket closed"):
            asked.progress(TRAJECTORY)
        assert not asked.is_ready()


def test_tls_on_one_side_alone_gives_no_connection(mutual: Endpoints, papers: Papers) -> None:
    with client(mutual.grpc_url.replace("grpcs", "grpc"), retry=False) as asked, pytest.raises(ServerUnavailableError):
        asked.progress(TRAJECTORY)
    for scheme in ("grpcs", "https"):
        url = f"{scheme}://127.0.0.1:{mutual.http_port}"
        with client(url, ca_file=papers.ca, retry=False) as asked, pytest.raises(ServerUnavailableError):
            asked.progress(TRAJECTORY)


def test_the_gateway_beside_tls_listens_on_loopback_alone(mutual: Endpoints, gateway_port: int) -> None:
    """Else whoever has no certificate would be served by it, in the clear."""
    with httpx.Client(transport=httpx.HTTPTransport(retries=10)) as caller:  # it starts after Triton
        assert caller.get(f"http://127.0.0.1:{gateway_port}/health", timeout=AT_ONCE_S).json()["status"] == "healthy"
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((PUBLIC_HOST, gateway_port), AT_ONCE_S)


def test_rfm_models_shows_a_certificate(mutual: Endpoints, papers: Papers, mutual_folder: Path) -> None:
    list_models = ["list", "--url", mutual.grpc_url, "--admin-key-file", str(mutual_folder / "key")]
    own = ["--client-certificate", str(papers.client_certificate), "--client-key", str(papers.client_key)]
    trusted = ["--ca-file", str(papers.ca), *own]
    assert CliRunner().invoke(app, ["models", *trusted, *list_models]).stdout.split() == ["rfm", "1", "READY"]
    for access in (["--ca-file", str(papers.other_ca), *own], trusted[:2]):
        refused = CliRunner().invoke(app, ["models", *access, *list_models])
        assert (refused.exit_code, refused.stdout) == (1, "")
        assert refused.stderr.startswith(f"rfm: {mutual.grpc_url}: failed to connect")


def test_rfm_serve_heals_with_tls(mutual: Endpoints, papers: Papers, mutual_folder: Path, repository: Path) -> None:
    """It is told of no certificate for itself."""
    kill_model(repository)
    with client(mutual.grpc_url, **papers.client) as asked:  # it asks again until the model is back
        scores_right(asked)
    log = (mutual_folder / "log").read_text()
    assert re.search("rfm: triton is started again: (rfm: )?a process of it is dead", log)
