# SPDX-License-Identifier: MIT
"""The gateway command: options, the key, and the first lines. No Triton is needed."""

from __future__ import annotations

import logging
import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import pytest
import uvicorn

from gateways import NO_TRITON, free_port, inside, running
from in_process import rfm
from rfm_client import ServerError
from rfm_client.contract.process import MOST_FILES, LogLines
from rfm_client.contract.triton import denied, not_served, unreachable
from rfm_gateway import GatewayConfig, mounting
from rfm_gateway.command import page_link
from rfm_gateway.state import TritonState
from servers import Endpoints

KEY = "open sesame"


def test_a_gateway_opens_all_the_files_that_it_may_and_needs_the_key_of_its_variable(tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    num_open = sum(1 for _ in Path("/proc/self/fd").iterdir())
    resource.setrlimit(resource.RLIMIT_NOFILE, (num_open + 256, limits[1]))  # which the gateway inherits
    try:
        with running(Endpoints.free(), tmp_path, RFM_GATEWAY_API_KEY=KEY) as gateway:
            soft, hard = resource.prlimit(gateway.process.pid, resource.RLIMIT_NOFILE)
            assert soft == min(hard, MOST_FILES)
            assert gateway.get("/metrics", headers={"X-API-Key": KEY}).ok
            assert gateway.get("/metrics").status_code == 401
            assert KEY not in gateway.log
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


@pytest.mark.parametrize("has_key", [True, False])
def test_an_open_address_without_a_key_is_warned_of(
    tmp_path: Path, has_key: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "key.txt").write_text(f"{KEY}\n")
    options = ["--triton-api-key-file", str(tmp_path / "key.txt")]
    options += ["--api-key-file", str(tmp_path / "key.txt")] * has_key
    port = free_port()
    monkeypatch.setattr(uvicorn, "run", lambda *_arguments, **_options: None)
    with caplog.at_level(logging.INFO, "rfm_gateway"):
        rfm("gateway", "--triton", NO_TRITON, "--host", "0.0.0.0", "--port", str(port), *options)
    warning = "0.0.0.0 is no loopback address, and no key is required: every host that reaches it can use it"
    shown = "sends Triton's key on behalf of every caller, because it asks for no key itself: set --api-key-file"
    assert {warning, shown} & {*caplog.messages} == (set() if has_key else {warning, shown})
    assert f"look at rewards in the browser: http://127.0.0.1:{port}/" in caplog.messages
    assert KEY not in caplog.text


NO_KEY = "'--api-key-file': expected a key, here or in RFM_GATEWAY_API_KEY, got no character"
BAD_OPTIONS = {
    "--triton localhost:8001": "'--triton': expected grpc://host:port or http://host:port, or grpcs:// or https:// (brackets around an IPv6 address), got",
    "--api-key-file nowhere": "'--api-key-file': expected a text file, got",
    f"--api-key-file {os.devnull}": NO_KEY,
    "--host 192.0.2.1": "Cannot assign requested address; --host names another",
}


@pytest.mark.parametrize(("options", "message"), BAD_OPTIONS.items())
def test_wrong_options_are_refused(options: str, message: str) -> None:
    given = ["gateway", "--triton", "grpc://localhost:1", *options.split()]
    result = rfm(*given, env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert message in result.output


WITHOUT_GATEWAY = "import sys; sys.modules['rfm_gateway'] = None; sys.argv = {words}; from {module} import main; main()"
COMMANDS = {
    "rfm_client.cli": ("rfm-client gateway --triton grpc://localhost:1", "pip install ./client ./apps/gateway"),
    "rfm_commands.cli": ("rfm serve --gateway-port 8100", "pip install ./client ./apps/gateway ."),
}


@pytest.mark.parametrize(("module", "command"), COMMANDS.items())
def test_without_the_gateway_s_packages_the_command_that_installs_it_is_printed(
    module: str, command: tuple[str, str]
) -> None:
    program = WITHOUT_GATEWAY.format(words=command[0].split(), module=module)
    done = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.endswith(f"{command[1]}\n")
    assert len(done.stderr.splitlines()) == 1


LINKS = {
    "http://127.0.0.1:8000/": GatewayConfig(host="0.0.0.0"),
    "http://[::1]:8100/": GatewayConfig(8100, host="::1"),
    "https://robot:8443/": GatewayConfig(8443, host="robot", certificate=Path("a.pem"), key=Path("a.key")),
}


@pytest.mark.parametrize(("link", "config"), LINKS.items())
def test_a_browser_can_open_the_link(link: str, config: GatewayConfig) -> None:
    assert page_link(config) == link


OF_TRITON = {
    "no connection": (unreachable("grpc://gpu:1", "refused"), "whoever runs the gateway starts Triton"),
    "no access": (denied("grpc://gpu:1", "401", "a key is missing"), "the gateway sets --triton-ca-file"),
    "another model": (not_served("rfm", "rfm is unknown", ["toy"]), "retry if the server restarts; else whoever runs"),
}


@pytest.mark.parametrize(("error", "remedy"), OF_TRITON.values(), ids=OF_TRITON)
def test_a_fault_of_triton_is_answered_with_who_can_mend_it_and_no_option_of_the_client(
    monkeypatch: pytest.MonkeyPatch, error: ServerError, remedy: str
) -> None:
    async def failing(_: TritonState) -> None:
        raise error

    monkeypatch.setattr(TritonState, "model_info", failing)
    with inside() as client:
        detail = client.get("/model_info").json()["detail"]
    assert detail.startswith(f"{error.fault}: ")
    assert remedy in detail
    assert error.remedy not in detail


def test_every_line_about_a_failed_request_names_it(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async def broken(_: TritonState) -> None:
        raise RuntimeError("made up")

    caplog.handler.setFormatter(LogLines("rfm-gateway"))
    monkeypatch.setattr(TritonState, "model_info", broken)
    with inside() as client:
        assert client.get("/model_info", headers={"X-Request-ID": "a/caller-s"}).status_code == 500
    lines = [line for line in caplog.text.splitlines() if line and " INFO " not in line]
    assert len(lines) > 3
    assert lines[-1].endswith(": RuntimeError: made up")
    assert all(re.search(r" ERROR rfm-gateway\[\d+\] request=a/caller-s: ", line) for line in lines), lines


GATEWAY, INSTALL = ("gateway", "--triton", NO_TRITON), "pip install ./client ./apps/gateway ./apps/page"


def test_without_rfm_page_the_log_says_so_if_a_page_is_wanted(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(mounting, "entry_points", lambda group: ())
    monkeypatch.setattr(uvicorn, "run", lambda *_arguments, **_options: None)
    message = f"no page in the browser, since the package rfm-page is not installed: {INSTALL}"
    with caplog.at_level(logging.INFO, "rfm_gateway"):
        assert rfm(*GATEWAY, "--port", str(free_port()), "--no-viewer").exit_code == 0
        assert message not in caplog.messages
        assert rfm(*GATEWAY, "--port", str(free_port())).exit_code == 0
        assert message in caplog.messages
    result = rfm(*GATEWAY, "--dataset", "demonstrations", env={"COLUMNS": "300"})
    assert result.exit_code == 2
    assert f"'--dataset': expected the package rfm-page, which shows it, got none: {INSTALL}" in result.output
