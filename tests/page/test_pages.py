# SPDX-License-Identifier: MIT
"""Files of the page and the endpoints' documentation. No Triton is needed."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateways import GatewayConfig, TestClient, create_app, inside
from paths import ROOT
from rfm_gateway import mounting

GATEWAY, PAGE = ROOT / "apps" / "gateway" / "rfm_gateway", ROOT / "apps" / "page" / "rfm_page"
FILES = {
    "": "text/html",
    "viewer/main.js": "javascript",
    "viewer/examples/success.mp4": "video/mp4",
    "docs/swagger-ui/swagger-ui.css": "text/css",
}
NO_FILES = ("viewer/missing.js", "viewer/routes.py", "viewer/..%2fapp.py", "viewer/%2fetc%2fpasswd", "viewer/a%00.css")


@pytest.fixture(scope="module")
def gateway() -> Iterator[TestClient]:
    with inside() as client:
        yield client


@pytest.mark.parametrize(("path", "kind"), FILES.items())
def test_every_file_has_its_type_and_the_policy_of_the_page(gateway: TestClient, path: str, kind: str) -> None:
    response = gateway.get(f"/{path}")
    assert response.status_code == 200
    assert kind in response.headers["content-type"]
    policy = dict(part.split(" ", 1) for part in response.headers["content-security-policy"].split("; "))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == policy["style-src"] == policy["connect-src"] == "'self'"
    assert "unsafe" not in response.headers["content-security-policy"]
    assert response.headers["x-content-type-options"] == "nosniff"
    again = gateway.get(f"/{path}", headers={"If-None-Match": response.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert gateway.head(f"/{path}").status_code == 200


@pytest.mark.parametrize("path", NO_FILES)
def test_no_other_file_is_served(gateway: TestClient, path: str) -> None:
    response = gateway.get(f"/{path}")
    assert (response.status_code, response.json()) == (404, {"detail": "Not Found"})


@pytest.mark.parametrize("is_installed", [True, False])
def test_without_a_page_the_gateway_serves_its_endpoints_alone(
    is_installed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not is_installed:
        monkeypatch.setattr(mounting, "entry_points", lambda group: ())
    with inside(viewer=not is_installed) as gateway:
        for path in ("/", "/viewer/main.js", "/viewer/served", "/viewer/datasets"):
            assert gateway.get(path).status_code == 404
        assert gateway.post("/viewer/score").status_code == 404
        assert gateway.post("/evaluate_batch", json=[]).status_code == 422
        for path in ("/metrics", "/docs", "/openapi.json"):
            assert gateway.get(path).status_code == 200


def test_the_command_that_adds_a_dataset_has_the_options_of_the_one_that_started_the_gateway() -> None:
    app = create_app(GatewayConfig(triton="grpc://127.0.0.1:1", port=8100), started_by="rfm-client gateway")
    with TestClient(app, "http://127.0.0.1") as gateway:
        told = gateway.get("/viewer/server").json()["remedies"]["dataset"]
    assert told == "rfm-client gateway --triton grpc://127.0.0.1:1 --port 8100 --dataset my_dataset"


WITHOUT_LABELS = """
import sys
sys.modules["rfm_labels"] = None
from rfm_gateway import GatewayConfig
from rfm_gateway.app import create_app
for datasets in ((), ("demonstrations",)):
    create_app(GatewayConfig(triton="grpc://127.0.0.1:1", dataset=datasets))
    print("shows", *datasets)
"""


@pytest.mark.slow
def test_without_rfm_labels_the_page_shows_no_datasets_and_names_the_package_to_install() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT_LABELS], capture_output=True, text=True, check=False)
    assert done.stdout == "shows\n"
    assert "dataset: expected packages that read it, got import of rfm_labels halted" in done.stderr
    assert done.stderr.endswith(": pip install ./client ./apps/labels\n")


@pytest.mark.parametrize("folder", [*(ROOT / "apps").glob("*/*/vendored/*"), *Path(__file__).parent.glob("vendored/*")])
def test_vendored_files_are_those_of_the_pinned_packages(folder: Path) -> None:
    told = json.loads((folder / "vendored.json").read_text())
    assert told.keys() == {"package", "version", "licence", "tarball_sha256", "files"}
    there = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.iterdir()}
    del there["vendored.json"]
    assert "LICENSE" in there
    assert there == told["files"]
