# SPDX-License-Identifier: MIT
"""A gateway beside which no page is installed. No Triton is needed."""

from __future__ import annotations

import logging

import pytest
import uvicorn
from typer.testing import CliRunner

from gateways import free_port, inside
from rfm_commands.cli import app
from rfm_gateway import mounting

GATEWAY = ("gateway", "--triton", "grpc://localhost:1")
INSTALL = "pip install ./client ./apps/gateway ./apps/page"


@pytest.fixture(autouse=True)
def _no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mounting, "entry_points", lambda group: ())


def test_it_serves_its_endpoints_and_no_page() -> None:
    with inside() as gateway:
        assert gateway.post("/evaluate_batch", json=[]).status_code == 422
        for path in ("/metrics", "/docs", "/openapi.json"):
            assert gateway.get(path).status_code == 200
        for path in ("/", "/viewer/main.js", "/viewer/served", "/viewer/datasets"):
            assert gateway.get(path).status_code == 404


@pytest.mark.parametrize("option", [[], ["--no-viewer"]], ids=["a page is wanted", "no page is wanted"])
def test_its_log_says_that_there_is_no_page_if_one_is_wanted(
    option: list[str], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(uvicorn, "run", lambda *_arguments, **_options: None)
    with caplog.at_level(logging.INFO, "rfm_gateway"):
        result = CliRunner().invoke(app, [*GATEWAY, "--port", str(free_port()), *option])
    assert result.exit_code == 0, result.output
    told = f"no page in the browser, since the package rfm-page is not installed: {INSTALL}"
    assert (told in caplog.messages) == (not option)


def test_a_dataset_to_show_is_refused_with_the_command_that_installs_the_page() -> None:
    result = CliRunner().invoke(app, [*GATEWAY, "--dataset", "demonstrations"], env={"COLUMNS": "300"})
    assert result.exit_code == 2
    assert f"'--dataset': expected the package rfm-page, which shows it, got none: {INSTALL}" in result.output
