# SPDX-License-Identifier: MIT
"""What others may reach of a server."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from rfm.config import ConfigError, ServeConfig
from rfm.launch.cleanup import REGION_PREFIX
from rfm.launch.installation import Installation, ServerStartError, find_installation
from rfm.launch.listen_address import check_version
from rfm.launch.process import Endpoints, TritonServer
from rfm.launch.triton_options import MAX_HTTP_BYTES, size_limits
from secured import (
    Papers,
    nothing_left_behind,
    refused_to_serve,
    regions_of,
)

pytestmark = [pytest.mark.triton, pytest.mark.slow]


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
        ServeConfig(grpc_client_ca=papers.ca)


def test_a_triton_that_can_limit_requests_is_told_to(tmp_path: Path) -> None:
    knows = tmp_path / "tritonserver"
    knows.write_bytes(b"\x00OPTION\x00http-max-input-size\x00")
    assert size_limits(Installation(knows), []) == [f"--http-max-input-size={MAX_HTTP_BYTES}"]
    assert size_limits(Installation(knows), ["--http-max-input-size=1"]) == []
    assert size_limits(find_installation(), []) == []  # 2.51 has no such option, and would not start with it
