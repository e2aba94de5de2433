# SPDX-License-Identifier: MIT
"""Who may reach what: TLS and keys of client, server and gateway, and which Triton may be reached at all."""

from __future__ import annotations

import os
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import aiohttp
import aiohttp.web
import goldens
import httpx
import numpy as np
import pytest
import trustme
from conftest import kill_model, load_engine, random_trajectory, serve_config
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from test_serve_command import EXIT_S, REPOSITORY, command, regions, wait_for_http
from typer.testing import CliRunner

import rfm_export
from rfm.config import ConfigError, ServeConfig
from rfm.supervise.cleanup import REGION_PREFIX
from rfm.supervise.installation import Installation, ServerStartError, find_installation
from rfm.supervise.listen_address import check_version
from rfm.supervise.process import Endpoints, TritonServer
from rfm.supervise.tls import GrpcTls, OwnTls
from rfm.supervise.triton_options import MAX_HTTP_BYTES, size_limits
from rfm_client import AccessDeniedError, ProgressSample, RewardClient, ServerUnavailableError
from rfm_client.status import read_status
from rfm_client.transport.access import Access
from rfm_client.transport.loop_thread import LoopThread
from rfm_commands.cli import app

PLAIN = goldens.config("c1_t1_disc10")
TRAJECTORY = random_trajectory(0, 5)
TOLERANCE = 1e-5
KEY = "a-key-that-only-tests-know"
TRITON_GATE = "triton-grpc-protocol-gate"  # gRPC metadata that Triton was told to ask for
GATED = "inference,health,metadata,model-config,statistics"
PUBLIC_HOST = "127.0.0.2"  # stands for an address that others reach
AT_ONCE_S = 20.0  # far less than the client would retry


@dataclass(frozen=True)
class Papers:
    """Certificates (PEM): of an authority, of a server and a client that it vouches for, and of a stranger's."""

    ca: Path
    certificate: Path
    key: Path
    client_certificate: Path
    client_key: Path
    other_ca: Path

    @property
    def client(self) -> dict[str, Path]:
        """Options of a client that has everything."""
        return {"ca_file": self.ca, "client_certificate": self.client_certificate, "client_key": self.client_key}


@pytest.fixture(scope="module")
def papers(tmp_path_factory: pytest.TempPathFactory) -> Papers:
    folder = tmp_path_factory.mktemp("papers")
    names = ("ca", "certificate", "key", "client_certificate", "client_key", "other_ca")
    made = Papers(*(folder / f"{name}.pem" for name in names))
    authority = trustme.CA()
    authority.cert_pem.write_to_path(made.ca)
    trustme.CA().cert_pem.write_to_path(made.other_ca)
    for identities, certificate, key in (
        (("127.0.0.1", PUBLIC_HOST), made.certificate, made.key),
        (("client",), made.client_certificate, made.client_key),
    ):
        issued = authority.issue_cert(*identities)
        issued.private_key_pem.write_to_path(key)
        for number, part in enumerate(issued.cert_chain_pems):
            part.write_to_path(certificate, append=number > 0)
    return made


@pytest.fixture(scope="module")
def repository(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exposed") / "model_repository"
    rfm_export.export(PLAIN.checkpoint, folder, serve_config(PLAIN))
    return folder


def regions_of(process_id: int) -> set[str]:
    """Shared memory of the servers that a process has started."""
    return {name for name in regions() if name.startswith(f"{REGION_PREFIX}_{process_id}_")}


@contextmanager
def nothing_left_behind() -> Iterator[None]:
    before = regions_of(os.getpid())
    yield
    assert regions_of(os.getpid()) <= before


class GatedServer(TritonServer):
    """Asks for a key over gRPC, as a proxy before it may."""

    def _arguments(self, models: Any) -> list[str]:
        return [*super()._arguments(models), f"--grpc-restricted-protocol={GATED}:gate={KEY}"]


@pytest.fixture(scope="module")
def secure(repository: Path, papers: Papers, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Endpoints]:
    """TLS, without certificates of clients, and with a key."""
    endpoints = replace(Endpoints.free(), grpc_tls=GrpcTls(papers.certificate, papers.key))
    with (
        nothing_left_behind(),
        (tmp_path_factory.mktemp("secure") / "tritonserver.log").open("wb") as log,
        GatedServer(repository, endpoints, find_installation(), log=log) as server,
    ):
        yield server.endpoints


@pytest.fixture(scope="module")
def gateway_port() -> int:
    """Of the gateway beside ``mutual``."""
    return Endpoints.free().http_port


@pytest.fixture(scope="module")
def mutual(
    repository: Path, papers: Papers, gateway_port: int, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Endpoints]:
    """``rfm serve`` with TLS and certificates of clients, and a gateway beside."""
    tls = GrpcTls(papers.certificate, papers.key, papers.ca)
    endpoints = replace(Endpoints.free(), host=PUBLIC_HOST, grpc_tls=tls)
    words = ["--grpc-certificate", papers.certificate, "--grpc-key", papers.key, "--grpc-client-ca", papers.ca]
    words += ["--host", PUBLIC_HOST, "--gateway-port", str(gateway_port)]
    log = tmp_path_factory.mktemp("mutual") / "log"
    with log.open("wb") as output:
        process = subprocess.Popen([*command(repository, endpoints), *words], stdout=output, stderr=output)
        try:
            wait_for_http(process, endpoints)
            yield endpoints
        finally:
            process.terminate()
            assert process.wait(EXIT_S) == 0, log.read_text()
            assert not regions_of(process.pid)


def client(url: str, **options: Any) -> RewardClient:
    return RewardClient(url, **options)


def scores_right(client: RewardClient) -> None:
    expected = load_engine(PLAIN.name).evaluate([ProgressSample(TRAJECTORY)])[0]
    got = client.progress(TRAJECTORY)
    np.testing.assert_allclose(got.progress, expected.progress, atol=TOLERANCE)  # type: ignore[union-attr]


@contextmanager
def denied_at_once(match: str) -> Iterator[None]:
    started_s = time.monotonic()
    with pytest.raises(AccessDeniedError, match=match):
        yield
    assert time.monotonic() - started_s < AT_ONCE_S


# gRPC


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
    with client(secure.grpc_url) as asked, denied_at_once("CERTIFICATE_VERIFY_FAILED"):  # nor by the system
        asked.progress(TRAJECTORY)


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


def test_http_beside_tls_listens_on_loopback_alone(papers: Papers, tmp_path: Path) -> None:
    tls = GrpcTls(papers.certificate, papers.key)
    endpoints = Endpoints("10.0.0.1", 8000, 8001, 8002, tls)
    arguments = TritonServer(REPOSITORY, endpoints, find_installation())._arguments(["rfm"])
    assert {"--http-address=127.0.0.1", "--grpc-address=10.0.0.1"} <= set(arguments)
    assert "--grpc-use-ssl=true" in OwnTls(tls).arguments(tmp_path)
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
def test_rfm_serve_itself_loads_over_grpc_with_tls(papers: Papers, tmp_path: Path, with_client_ca: bool) -> None:
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
        assert "rfm: rfm is started again: its process is dead" in (tmp_path / "log").read_text()
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


def test_a_certificate_that_names_no_host_is_told_before_anything_starts(papers: Papers, tmp_path: Path) -> None:
    """gRPC's clients could trust no server that has it."""
    named = x509.load_pem_x509_certificate(papers.certificate.read_bytes())
    key = serialization.load_pem_private_key(papers.key.read_bytes(), None)
    assert isinstance(key, rsa.RSAPrivateKey | ec.EllipticCurvePrivateKey)
    nobody = x509.CertificateBuilder(
        named.issuer,
        x509.Name([]),
        key.public_key(),
        1,
        named.not_valid_before_utc,
        named.not_valid_after_utc,
    ).sign(key, hashes.SHA256())
    file = tmp_path / "nobody.pem"
    file.write_bytes(nobody.public_bytes(serialization.Encoding.PEM))
    told = refused_to_serve("--grpc-certificate", file, "--grpc-key", papers.key)
    assert told == f"rfm: grpc_certificate: expected a certificate that names a host, got none at {file}\n"


# HTTP, through a proxy that has TLS and asks for a key


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


def test_http_without_the_key_is_denied(proxied: str, papers: Papers) -> None:
    for options in ({}, {"api_key": "another"}):
        with client(proxied, **papers.client, **options) as asked, denied_at_once("access denied: no key"):
            asked.progress(TRAJECTORY)
        with pytest.raises(AccessDeniedError, match="access denied: no key"):
            read_status(proxied, access=Access(**papers.client, **options))


def test_a_proxy_that_a_stranger_vouches_for_is_not_trusted(proxied: str, papers: Papers) -> None:
    options = {**papers.client, "ca_file": papers.other_ca, "api_key": KEY}
    with client(proxied, **options) as asked, denied_at_once("access denied: .*certificate verify failed"):
        asked.progress(TRAJECTORY)
    with pytest.raises(AccessDeniedError, match=r"access denied: .*certificate verify failed"):
        read_status(proxied, access=Access(**options))


def test_a_proxy_that_wants_a_certificate_refuses_without(proxied: str, papers: Papers) -> None:
    with (
        client(proxied, api_key=KEY, ca_file=papers.ca, retry=False) as asked,
        pytest.raises((AccessDeniedError, ServerUnavailableError)),  # by the moment at which the proxy hangs up
    ):
        asked.progress(TRAJECTORY)


# What the client refuses before it asks

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
    with pytest.raises(ValueError, match=message) as refused:
        client(**{"url": "grpcs://127.0.0.1:1", **options(papers)})
    assert KEY not in str(refused.value)


def test_a_key_is_in_no_description() -> None:
    access = Access(api_key=KEY, headers={"x-api-key": KEY})
    assert KEY not in repr(access)


# Commands


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


# The gateway


@contextmanager
def gateway(papers: Papers, endpoints: Endpoints, folder: Path, *words: object, **environment: str) -> Iterator[int]:
    port = Endpoints.free().http_port
    options = ["--triton", endpoints.grpc_url, "--metrics-url", endpoints.metrics_url, "--port", str(port)]
    options += ["--certificate", str(papers.certificate), "--key", str(papers.key), *map(str, words)]
    with (folder / "gateway.log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "rfm_gateway", *options],
            env={**os.environ, **environment},
            stdout=log,
            stderr=log,
        )
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
    with gateway(papers, mutual, tmp_path, *words, RFM_GATEWAY_API_KEY=KEY) as port:
        url = f"https://127.0.0.1:{port}"
        trusted = ssl.create_default_context(cafile=papers.ca)
        with httpx.Client(base_url=url, verify=trusted) as caller:
            assert caller.get("/health").json()["status"] == "healthy"
            assert caller.get("/gpu_status", headers={"X-API-Key": KEY}).status_code == 200
            keys_of_callers(caller)
        with pytest.raises(httpx.ConnectError, match="certificate verify failed"):
            httpx.get(f"{url}/health", verify=ssl.create_default_context(cafile=papers.other_ca))
        with pytest.raises(httpx.HTTPError):
            httpx.get(f"http://127.0.0.1:{port}/health")


def keys_of_callers(caller: httpx.Client) -> None:
    """Each way to show a key counts; a wrong one hides no right one."""
    bearer = {"Authorization": f"Bearer {KEY}"}
    for headers in (
        {"X-API-Key": KEY},
        bearer,
        {"X-API-Key": "wrong", **bearer},
        {"X-API-Key": KEY, "Authorization": "x"},
    ):
        assert caller.get("/model_info", headers=headers).status_code == 200
    for headers in ({}, {"X-API-Key": "wrong"}, {"Authorization": "Bearer wrong"}, {"X-API-Key": f"{KEY}x"}):
        answer = caller.get("/model_info", headers=headers)
        assert (answer.status_code, answer.headers["WWW-Authenticate"]) == (401, "Bearer")
        assert KEY not in answer.text


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
    assert "--certificate, --key: expected both or none, got one" in " ".join(done.stderr.replace("│", " ").split())


# rfm serve


def refused_to_serve(*words: object) -> str:
    done = subprocess.run(
        [*command(REPOSITORY, Endpoints.free()), *map(str, words)],
        capture_output=True,
        text=True,
        timeout=EXIT_S,
        check=False,
    )
    assert done.returncode == 1, done.stderr
    return done.stderr


def test_the_backend_s_memory_has_a_name_that_newer_tritons_guard(secure: Endpoints) -> None:
    """They refuse clients who would map what is called so. The name tells its server, too."""
    assert REGION_PREFIX.startswith("triton_python_backend_shm_region_")
    assert regions_of(os.getpid())


def test_the_wheel_s_triton_is_not_opened_to_others() -> None:
    told = refused_to_serve("--host", "0.0.0.0")
    assert told.startswith("rfm: host: expected a loopback address for Triton 2.51.0, which has known remote vulner")
    assert "--accept-known-vulnerabilities" in told


def test_an_older_triton_that_listens_elsewhere_is_stopped(repository: Path, tmp_path: Path) -> None:
    """One whose version is known only when it answers: no wheel, as far as ``rfm serve`` can see."""
    wheel = find_installation()
    assert wheel.wheel is not None
    program = tmp_path / "tritonserver"
    backends = " ".join(wheel.lay_out_backends(tmp_path / "backends"))
    program.write_text(f'#!/bin/sh\nexec {wheel.executable} {backends} "$@"\n')
    program.chmod(0o755)
    endpoints = Endpoints.free()

    class SeenFromElsewhere(TritonServer):
        """Its address counts as open, but it listens on loopback."""

        def _arguments(self, models: Any) -> list[str]:
            return [argument.replace("192.0.2.1", "127.0.0.1") for argument in super()._arguments(models)]

    class Open(Endpoints):
        @property
        def http_host(self) -> str:
            return "127.0.0.1"

        def check_free(self) -> None:
            endpoints.check_free()

    opened = Open("192.0.2.1", endpoints.http_port, endpoints.grpc_port, endpoints.metrics_port)
    installation = Installation(program, wheel.environment)
    with (
        nothing_left_behind(),
        (tmp_path / "log").open("wb") as log,
        pytest.raises(ServerStartError, match=r"host: expected a loopback address for Triton 2\.51\.0"),
        SeenFromElsewhere(repository, opened, installation, log=log),
    ):
        raise AssertionError("it serves")


@pytest.mark.parametrize(
    ("host", "version", "accepted", "is_served"),
    [
        ("127.0.0.1", "2.51.0", False, True),
        ("127.0.0.2", "2.51.0", False, True),
        ("localhost", "2.51.0", False, True),
        ("10.0.0.1", "2.51.0", True, True),
        ("10.0.0.1", "2.51.0", False, False),
        ("127.evil.example", "2.51.0", False, False),
        ("10.0.0.1", "2.70.1", False, False),
        ("10.0.0.1", "2.71.0", False, True),
        ("10.0.0.1", "3.0.0", False, True),
        ("10.0.0.1", "", False, False),
    ],
)
def test_which_triton_others_may_reach(host: str, version: str, accepted: bool, is_served: bool) -> None:
    try:
        check_version(host, version, accepted=accepted)
    except ServerStartError as error:
        assert not is_served, error
        assert host in str(error)
    else:
        assert is_served


def test_files_of_tls_are_read_before_anything_starts(papers: Papers) -> None:
    told = refused_to_serve("--grpc-certificate", papers.certificate, "--grpc-key", papers.client_key)
    assert told.startswith("rfm: grpc_certificate, grpc_key: expected a certificate and its key")
    told = refused_to_serve(
        "--grpc-certificate", papers.certificate, "--grpc-key", papers.key, "--grpc-client-ca", "/nowhere"
    )
    assert told.startswith("rfm: grpc_client_ca: expected certificates (PEM) at /nowhere, got: No such file")
    assert "expected both or none" in refused_to_serve("--grpc-key", papers.key)
    assert "expected an option that rfm serve leaves open" in refused_to_serve("--", "--grpc-use-ssl=true")
    with pytest.raises(ConfigError, match="grpc_client_ca: expected with grpc_certificate and grpc_key"):
        ServeConfig(grpc_client_ca=str(papers.ca))


def test_a_triton_that_can_limit_requests_is_told_to(tmp_path: Path) -> None:
    knows = tmp_path / "tritonserver"
    knows.write_bytes(b"\x00OPTION\x00http-max-input-size\x00")
    assert size_limits(Installation(knows), []) == [f"--http-max-input-size={MAX_HTTP_BYTES}"]
    assert size_limits(Installation(knows), ["--http-max-input-size=1"]) == []
    assert size_limits(find_installation(), []) == []  # 2.51 has no such option, and would not start with it
