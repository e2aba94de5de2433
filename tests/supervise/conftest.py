# SPDX-License-Identifier: MIT
"""Certificates, servers with TLS and keys, and one with versions to roll out."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import trustme

import rfm_export
import rollout
from administered import KEY, Running
from commands import EXIT_S, command, wait_for_http
from engines import serve_config
from one_model import BriefServer
from rfm.launch.endpoints import Endpoints, GrpcTls
from rfm.launch.installation import find_installation
from rollout import WITH_ENCODERS
from secured import (
    PLAIN,
    PUBLIC_HOST,
    GatedServer,
    Papers,
    nothing_left_behind,
    regions_of,
)


def write_key(file: Path) -> Path:
    file.touch(0o600)
    file.write_text(f"{KEY}\n")
    return file


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
def mutual_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log and the admin key of ``mutual``."""
    folder = tmp_path_factory.mktemp("mutual")
    write_key(folder / "key")
    return folder


@pytest.fixture(scope="module")
def mutual(repository: Path, papers: Papers, gateway_port: int, mutual_folder: Path) -> Iterator[Endpoints]:
    """``rfm serve`` with TLS and certificates of clients, and a gateway beside."""
    tls = GrpcTls(papers.certificate, papers.key, papers.ca)
    endpoints = replace(Endpoints.free(), host=PUBLIC_HOST, grpc_tls=tls)
    words = ["--grpc-certificate", papers.certificate, "--grpc-key", papers.key, "--grpc-client-ca", papers.ca]
    words += ["--host", PUBLIC_HOST, "--gateway-port", str(gateway_port), "--admin-key-file", mutual_folder / "key"]
    with (mutual_folder / "log").open("wb") as output:
        process = subprocess.Popen([*command(repository, endpoints), *words], stdout=output, stderr=output)
        try:
            wait_for_http(process, endpoints)
            yield endpoints
        finally:
            process.terminate()
            process.wait(EXIT_S)  # Triton 2.51 gives 1 where a request met a dead process
            assert not regions_of(process.pid)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("running")
    repository, key_file = folder / "repository", write_key(folder / "key")
    rollout.export(WITH_ENCODERS.checkpoint, repository)
    log = folder / "tritonserver.log"
    with (
        log.open("wb") as lines,
        BriefServer(repository, Endpoints.free(), find_installation(), log=lines, admin_key=KEY) as server,
    ):
        yield Running(repository, server.endpoints, key_file, log)
    assert KEY not in log.read_text()
