# SPDX-License-Identifier: MIT
"""Addresses that a server listens on, and the services that others reach."""

from __future__ import annotations

import os
import socket
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

import stand_in_triton
from commands import REPOSITORY, is_alive, nothing_left_behind
from in_process import rfm
from rfm.config import ServeConfig
from rfm.serve import access
from rfm.serve.access import PORTS, Endpoints, GrpcTls, callers_restrictions, check_version, free_ports
from rfm.serve.installation import ServerStartError
from rfm.serve.processes import children_of
from rfm.serve.triton_server import TritonServer
from rfm_client.options import ConfigError
from rfm_commands.serve_screen import ServeScreen, doors
from rfm_gateway import GatewayConfig
from secured import Papers
from servers import wait_for


def test_rfm_serve_refuses_an_exposed_host_with_a_vulnerable_triton_unless_accepted(
    caplog: pytest.LogCaptureFixture,
) -> None:
    done = rfm("serve", "--repository", REPOSITORY, "--host", "0.0.0.0")
    told = "rfm: --host: expected a loopback address for Triton 2.51.0, which has known remote vulnerabilities"
    assert (done.exit_code, done.stderr[: len(told)]) == (1, told)
    assert "--accept-known-vulnerabilities" in done.stderr
    assert rfm("serve", "/nowhere", "--host", "0.0.0.0", "--accept-known-vulnerabilities").exit_code == 1
    accepted = "0.0.0.0 is no loopback address, and a Triton with known remote vulnerabilities is accepted"
    assert any(message.startswith(accepted) for message in caplog.messages)


def test_an_older_triton_that_listens_elsewhere_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in, which tells the version only when it runs, unlike the wheel's. No address counts as loopback."""
    monkeypatch.setattr(access, "is_loopback", lambda _: False)
    repository, program = stand_in_triton.repository(tmp_path, "a"), stand_in_triton.installation(tmp_path)
    with (
        nothing_left_behind(),
        pytest.raises(ServerStartError, match=r"host: expected a loopback address for Triton 2\.51\.0"),
        TritonServer(repository, Endpoints.free(), program),
    ):
        raise AssertionError("it serves")


@pytest.mark.parametrize(
    ("host", "version", "accepted", "is_served"),
    [
        ("127.0.0.2", "2.51.0", False, True),
        ("10.0.0.1", "2.51.0", True, True),
        ("127.evil.example", "2.51.0", False, False),
        ("10.0.0.1", "2.70.1", False, False),
        ("10.0.0.1", "2.71.0", False, True),
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
    for tls, told in (
        (GrpcTls(papers.certificate, papers.client_key), "grpc_certificate: expected a certificate and its key"),
        (GrpcTls(papers.certificate, papers.key, Path("/nowhere")), r"grpc_client_ca: .* \(PEM\) at /nowhere, got No"),
    ):
        with pytest.raises(ServerStartError, match=f"^{told}"):
            replace(Endpoints.free(), grpc_tls=tls).check()
    with pytest.raises(ConfigError, match=r"^grpc_client_ca needs grpc_certificate$"):
        ServeConfig(grpc_client_ca=papers.ca)


ASKS: dict[str, tuple[bool, list[str], dict[str, str]]] = {
    "nothing": (False, [], {}),
    "client certificates": (True, [], {"gRPC": "needs a client certificate"}),
    "keys of tritonserver": (
        False,
        ["--grpc-restricted-protocol=health,inference:a=b", "--http-restricted-api=inference:a=b"],
        {"gRPC": "needs a key", "HTTP": "needs a key"},
    ),
    "client certificates and a key": (
        True,
        callers_restrictions("k", []),
        {"gRPC": "needs a client certificate and a key", "HTTP": "needs a key"},
    ),
    "a key for health alone": (False, ["--grpc-restricted-protocol=health:inference=b"], {}),
}


@pytest.mark.parametrize(("has_tls", "more", "asks"), ASKS.values(), ids=ASKS)
def test_the_screen_says_what_each_port_asks_for_and_shows_it_in_the_next_step(
    papers: Papers, capsys: pytest.CaptureFixture[str], has_tls: bool, more: list[str], asks: dict[str, str]
) -> None:
    tls = GrpcTls(papers.certificate, papers.key, papers.ca) if has_tls else None
    endpoints, gateway = replace(Endpoints.free(), grpc_tls=tls), GatewayConfig(host="127.0.0.1", port=8100)
    found = doors(endpoints, more, 8003, gateway, {"RFM_GATEWAY_API_KEY": "open sesame"})
    of_all = {**dict.fromkeys(("gRPC", "HTTP", "metrics", "status"), "no key needed"), "page": "needs a key"}
    assert {name: kind for name, (_, kind) in found.items()} == {**of_all, **asks}
    ServeScreen(REPOSITORY, endpoints, found, Path("triton.log")).show_ready()
    shown = capsys.readouterr().err
    assert f"  gRPC     {endpoints.grpc_url} ({asks.get('gRPC', 'no key needed')})\n" in shown
    own = " --ca-file AUTHORITY.pem --client-certificate CERTIFICATE.pem --client-key KEY.pem" * has_tls
    assert f"score VIDEO --task TASK --url {endpoints.grpc_url}{own}\n" in shown


def test_http_beside_tls_listens_on_loopback_alone(papers: Papers) -> None:
    tls = GrpcTls(papers.certificate, papers.key)
    beside = Endpoints("10.0.0.1", 8000, 8001, 8002, tls)
    assert {"--http-address=127.0.0.1", "--grpc-address=10.0.0.1"} <= set(beside.arguments())
    assert (beside.http_url, beside.grpc_url) == ("http://127.0.0.1:8000", "grpcs://10.0.0.1:8001")


def test_ports_are_free_and_given_once(monkeypatch: pytest.MonkeyPatch) -> None:
    given = [port for _ in range(20) for port in free_ports(3)]
    assert len(set(given)) == 60
    assert set(given) <= set(PORTS)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        monkeypatch.setattr(access, "PORTS", range(port, port + 1))
        with pytest.raises(OSError, match="ports: expected 1 free ones in"):
            free_ports(1)


@pytest.mark.parametrize("has_lists", [True, False])
def test_children_are_found_dead_or_alive(monkeypatch: pytest.MonkeyPatch, has_lists: bool) -> None:
    if not has_lists:  # a kernel without CONFIG_PROC_CHILDREN
        monkeypatch.setattr(Path, "glob", lambda *_: iter(()))
    children = [subprocess.Popen(["sleep", "3600"]) for _ in range(2)]
    try:
        children[0].kill()
        wait_for(lambda: not is_alive(children[0].pid))
        assert {child.pid for child in children} <= set(children_of(os.getpid()))
        assert os.getppid() not in children_of(os.getpid())
    finally:
        for child in children:
            child.kill()
            child.wait()
    assert not {child.pid for child in children} & set(children_of(os.getpid()))
