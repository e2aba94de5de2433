# SPDX-License-Identifier: MIT
"""TLS and keys: of gRPC, of HTTP behind a proxy, and of the gateway."""

from __future__ import annotations

import os
import re
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import aiohttp
import aiohttp.web
import httpx
import pytest
from typer.testing import CliRunner

from commands import EXIT_S
from repositories import kill_model
from rfm.launch.endpoints import Endpoints
from rfm.launch.triton_options import MAX_HTTP_BYTES
from rfm_client import AccessDeniedError, ServerUnavailableError
from rfm_client.transport.access import Access
from rfm_client.transport.loop_thread import LoopThread
from rfm_client.transport.status import read_status
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


@contextmanager
def proxy(endpoints: Endpoints, papers: Papers, *, client_ca: Path | None = None) -> Iterator[str]:
    """What nginx or an ingress would be."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(papers.certificate, papers.key)
    if client_ca is not None:
        context.verify_mode = ssl.CERT_REQUIRED
        context.load_verify_locations(client_ca)

    async def forward(request: aiohttp.web.Request) -> aiohttp.web.Response:
        if request.headers.get("Authorization") != f"Bearer {KEY}":
            return aiohttp.web.json_response({"error": "no key"}, status=401)
        url = f"{endpoints.http_url}{request.path_qs}"
        headers = {name: value for name, value in request.headers.items() if name.startswith("Inference")}
        async with (
            aiohttp.ClientSession(auto_decompress=False) as session,
            session.request(request.method, url, data=await request.read(), headers=headers) as answer,
        ):
            kept = {name: value for name, value in answer.headers.items() if name != "Content-Length"}
            return aiohttp.web.Response(status=answer.status, body=await answer.read(), headers=kept)

    app = aiohttp.web.Application(client_max_size=MAX_HTTP_BYTES)
    app.router.add_route("*", "/{tail:.*}", forward)
    runner = aiohttp.web.AppRunner(app, access_log=None)
    bound = socket.create_server(("127.0.0.1", 0))

    async def start() -> None:
        await runner.setup()
        await aiohttp.web.SockSite(runner, bound, ssl_context=context).start()

    loop = LoopThread("proxy")
    try:
        loop.wait(start())
        yield f"https://127.0.0.1:{bound.getsockname()[1]}"
    finally:
        loop.stop(runner.cleanup)


@pytest.fixture(scope="module")
def proxied(mutual: Endpoints, papers: Papers) -> Iterator[str]:
    with proxy(mutual, papers, client_ca=papers.ca) as url:
        yield url


def test_http_through_a_proxy_with_tls_and_a_key(proxied: str, papers: Papers) -> None:
    with client(proxied, api_key=KEY, **papers.client) as asked:
        scores_right(asked)
    status = read_status(proxied, access=Access(**papers.client, api_key=KEY))
    assert [model.name for model in status.models] == ["rfm"]


def test_a_proxy_denies_who_shows_no_key_or_certificate_and_is_not_trusted_by_strangers(
    proxied: str, papers: Papers
) -> None:
    stranger = {**papers.client, "ca_file": papers.other_ca}
    for options, told in (
        (papers.client, "no key"),
        ({**papers.client, "api_key": "another"}, "no key"),
        ({**stranger, "api_key": KEY}, ".*certificate verify failed"),
    ):
        with client(proxied, **options) as asked, denied_at_once(f"access denied: {told}"):
            asked.progress(TRAJECTORY)
        with pytest.raises(AccessDeniedError, match=f"access denied: {told}"):
            read_status(proxied, access=Access(**options))
    with (
        client(proxied, api_key=KEY, ca_file=papers.ca, retry=False) as asked,
        pytest.raises((AccessDeniedError, ServerUnavailableError)),  # by the moment at which the proxy hangs up
    ):
        asked.progress(TRAJECTORY)


BAD = {
    "certificates without TLS": (
        lambda p: {"url": "grpc://h:1", "ca_file": p.ca},
        "url: expected grpcs:// or https://",
    ),
    "half a pair": (lambda p: {"client_key": p.key}, "client_certificate, client_key: expected both or none, got one"),
    "no file": (lambda p: {"ca_file": "/nowhere"}, "ca_file: expected certificates .* got: No such file"),
    "no certificate": (lambda p: {"ca_file": p.key}, "ca_file: expected certificates"),
    "another's key": (
        lambda p: {"client_certificate": p.certificate, "client_key": p.client_key},
        "client_certificate, client_key: expected a certificate and its key .* got: KEY_VALUES_MISMATCH",
    ),
    "a line break": (lambda p: {"api_key": f"{KEY}\n"}, "authorization: expected visible ASCII characters"),
    "a header's name": (lambda p: {"headers": {"a b": "1"}}, "headers: expected letters"),
}


@pytest.mark.parametrize(("options", "message"), BAD.values(), ids=BAD.keys())
def test_what_cannot_be_used_is_refused(
    papers: Papers, options: Callable[[Papers], dict[str, Any]], message: str
) -> None:
    """No description has a key."""
    assert KEY not in repr(Access(api_key=KEY, headers={"x-api-key": KEY}))
    with pytest.raises(ValueError, match=message) as refused:
        client(**{"url": "grpcs://127.0.0.1:1", **options(papers)})
    assert KEY not in str(refused.value)


def rfm_client(*words: object, **environment: str) -> subprocess.CompletedProcess[str]:
    program = Path(sys.executable).parent / "rfm-client"
    return subprocess.run(
        [str(program), *map(str, words)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=EXIT_S,
        check=False,
    )


def test_the_command_has_the_same_options(mutual: Endpoints, proxied: str, papers: Papers, tmp_path: Path) -> None:
    key_file = tmp_path / "key"
    key_file.write_text(f"{KEY}\n")
    words = [
        "--ca-file",
        papers.ca,
        "--client-certificate",
        papers.client_certificate,
        "--client-key",
        papers.client_key,
    ]
    done = rfm_client(*words, "sample", "--url", mutual.grpc_url)
    assert done.returncode == 0, done.stderr
    in_environment = {
        "RFM_CA_FILE": str(papers.ca),
        "RFM_CLIENT_CERTIFICATE": str(papers.client_certificate),
        "RFM_CLIENT_KEY": str(papers.client_key),
        "RFM_API_KEY_FILE": str(key_file),
    }
    for name in ("sample", "status", "wait"):
        done = rfm_client(name, "--url", proxied, **in_environment)
        assert done.returncode == 0, done.stderr
    refused = rfm_client("--ca-file", papers.other_ca, "sample", "--url", mutual.grpc_url)
    assert refused.returncode == 1
    assert "access denied" in refused.stderr


@contextmanager
def gateway(papers: Papers, endpoints: Endpoints, folder: Path, *words: object) -> Iterator[int]:
    port = Endpoints.free().http_port
    options = ["--triton", endpoints.grpc_url, "--metrics-url", endpoints.metrics_url, "--port", str(port)]
    options += ["--certificate", str(papers.certificate), "--key", str(papers.key), *map(str, words)]
    with (folder / "gateway.log").open("w") as log:
        process = subprocess.Popen([sys.executable, "-m", "rfm_gateway", *options], stdout=log, stderr=log)
    try:
        while True:
            assert process.poll() is None, (folder / "gateway.log").read_text()
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                break
            except ConnectionRefusedError:
                time.sleep(0.1)
        yield port
    finally:
        process.terminate()
        process.wait(EXIT_S)


def test_the_gateway_serves_https_before_a_triton_with_mutual_tls(
    mutual: Endpoints, papers: Papers, tmp_path: Path
) -> None:
    words = ["--triton-ca-file", papers.ca, "--triton-certificate", papers.client_certificate]
    words += ["--triton-key", papers.client_key]
    with gateway(papers, mutual, tmp_path, *words) as port:
        url = f"https://127.0.0.1:{port}"
        with httpx.Client(base_url=url, verify=ssl.create_default_context(cafile=papers.ca)) as caller:
            assert caller.get("/health").json()["status"] == "healthy"
            assert caller.get("/model_info").status_code == 200
        with pytest.raises(httpx.ConnectError, match="certificate verify failed"):
            httpx.get(f"{url}/health", verify=ssl.create_default_context(cafile=papers.other_ca))
        with pytest.raises(httpx.HTTPError):
            httpx.get(f"http://127.0.0.1:{port}/health")


def test_the_gateway_s_own_certificate_is_not_the_caller_s_fault(
    mutual: Endpoints, papers: Papers, tmp_path: Path
) -> None:
    with gateway(papers, mutual, tmp_path, "--triton-ca-file", papers.other_ca) as port:
        trusted = ssl.create_default_context(cafile=papers.ca)
        answer = httpx.get(f"https://127.0.0.1:{port}/model_info", verify=trusted)
        assert (answer.status_code, "access denied" in answer.json()["detail"]) == (502, True)


def test_half_a_certificate_of_the_gateway_is_refused(papers: Papers) -> None:
    done = rfm_client("gateway", "--triton", "grpc://127.0.0.1:1", "--certificate", papers.certificate)
    assert done.returncode == 2
    assert "'--certificate, --key': expected both or none, got one" in done.stderr


def test_rfm_serve_heals_with_tls(mutual: Endpoints, papers: Papers, mutual_folder: Path, repository: Path) -> None:
    """It is told of no certificate for itself."""
    kill_model(repository)
    with client(mutual.grpc_url, **papers.client) as asked:  # it asks again until the model is back
        scores_right(asked)
    log = (mutual_folder / "log").read_text()
    assert re.search("rfm: triton is started again: (rfm: )?a process of it is dead", log)
