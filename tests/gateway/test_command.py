# SPDX-License-Identifier: MIT
"""The command that runs a gateway: its options, its key, and what it tells when it starts. No Triton is needed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gateways import running
from rfm.launch.process import Endpoints
from rfm_commands.cli import app
from rfm_gateway.command import gateway_command, page_link
from rfm_gateway.config import GatewayConfig

KEY = "open sesame"


@pytest.mark.parametrize("key", [KEY, None])
def test_an_open_address_without_a_key_is_warned_of(tmp_path: Path, key: str | None) -> None:
    (tmp_path / "key.txt").write_text(f"{KEY}\n")
    options = ("--host", "0.0.0.0", *(["--api-key-file", str(tmp_path / "key.txt")] if key else []))
    with running(Endpoints.free(), tmp_path, "rfm", *options) as gateway:
        assert gateway.get("/viewer/live", headers={"X-API-Key": KEY}).ok
        assert gateway.get("/viewer/live").ok is (key is None)
        warning = "WARNING rfm_gateway: 0.0.0.0 is no loopback address, and no key is required"
        assert (warning in gateway.log) is (key is None)
        assert f"look at rewards in the browser: {gateway.url}/\n" in gateway.log
        assert KEY not in gateway.log


def test_the_key_is_that_of_the_file_or_else_of_the_variable(tmp_path: Path) -> None:
    (tmp_path / "key.txt").write_text(f"{KEY}\n")
    environment = {"RFM_GATEWAY_API_KEY": "another"}
    assert GatewayConfig(api_key_file=tmp_path / "key.txt").api_key(environment) == KEY
    assert GatewayConfig().api_key(environment) == "another"
    assert GatewayConfig().api_key({}) is None


BAD_OPTIONS: dict[str, tuple[list[str], str]] = {
    "no URL": (
        ["--triton", "localhost:8001"],
        "url: expected grpc://host:port or http://host:port, or grpcs:// or https://, got",
    ),
    "no folder": (["--allow-folder", "nowhere"], "No such file or directory"),
    "no key file": (["--api-key-file", "nowhere"], "'--api-key-file': expected a text file, got"),
    "an empty key": (
        ["--api-key-file", os.devnull],
        "'--api-key-file': expected a key, here or in RFM_GATEWAY_API_KEY, got no character",
    ),
    "no port": (["--port", "0"], "Input should be greater than or equal to 1"),
    "an address of another machine": (["--host", "192.0.2.1"], "Cannot assign requested address; --host names another"),
    "a time-out that never ends": (["--timeout", "inf"], "Input should be less than or equal to 86400"),
}


@pytest.mark.parametrize(("options", "message"), BAD_OPTIONS.values(), ids=BAD_OPTIONS)
def test_wrong_options_are_refused(options: list[str], message: str, tmp_path: Path) -> None:
    given = ["gateway", *([] if "--triton" in options else ["--triton", "grpc://localhost:1"]), *options]
    result = CliRunner().invoke(app, given, env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert message in result.output


WITHOUT_GATEWAY = "import sys; sys.modules['rfm_gateway'] = None; sys.argv = {words}; from {module} import main; main()"


@pytest.mark.parametrize(
    ("module", "words", "message"),
    [
        (
            "rfm_client.cli",
            ["rfm-client", "gateway", "--triton", "grpc://localhost:1"],
            "pip install ./client ./gateway",
        ),
        ("rfm_commands.cli", ["rfm", "serve", "--gateway-port", "8100"], "pip install ./client ./gateway ."),
    ],
    ids=["rfm-client", "rfm"],
)
def test_a_gateway_that_is_not_installed_is_told_with_the_command_that_installs_it(
    module: str, words: list[str], message: str
) -> None:
    program = WITHOUT_GATEWAY.format(words=words, module=module)
    done = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.endswith(f"{message}\n")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("config", "link"),
    [
        (GatewayConfig(8100), "http://127.0.0.1:8100/"),
        (GatewayConfig(host="0.0.0.0"), "http://127.0.0.1:8000/"),
        (GatewayConfig(8100, host="::1"), "http://[::1]:8100/"),
        (GatewayConfig(8443, host="robot", certificate=Path("a.pem"), key=Path("a.key")), "https://robot:8443/"),
    ],
    ids=["loopback", "every address", "IPv6", "HTTPS"],
)
def test_the_link_is_one_that_a_browser_can_open(config: GatewayConfig, link: str) -> None:
    assert page_link(config) == link


@pytest.mark.parametrize("viewer", [True, False])
def test_a_gateway_beside_triton_is_told_whether_there_is_a_page(viewer: bool) -> None:
    words = gateway_command(GatewayConfig(8100, viewer=viewer))
    assert [word for word in words if "viewer" in word] == ["--viewer" if viewer else "--no-viewer"]
