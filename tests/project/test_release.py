# SPDX-License-Identifier: MIT
"""A release: the same version everywhere, and wheels that serve without the source tree."""

from __future__ import annotations

import re
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

from paths import ROOT
from servers import Endpoints

GATEWAY, PAGE = (ROOT / "apps" / name / f"rfm_{name}" for name in ("gateway", "page"))
DISTRIBUTIONS = (ROOT / "client", *(file.parent for file in ROOT.glob("apps/*/pyproject.toml")), ROOT)


def version() -> str:
    found = re.search(r'^version = "(.*)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert found
    return found[1]


def test_every_file_names_the_version() -> None:
    listed = subprocess.run(
        ["make", "--just-print", "version", "VERSION=9.9.9"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.split()
    files = [word for word in listed if (ROOT / word).is_file()]
    assert len(files) >= 10
    for file in dict.fromkeys(files):
        assert version() in (ROOT / file).read_text(), file
    released = re.search(r"^## \[(\d.*)\] - \d{4}-\d\d-\d\d$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert released
    assert released[1] == version()


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A virtual environment with wheels of all distributions, made from a clone. The wheels lie beside it."""
    place = tmp_path_factory.mktemp("release")
    copy, wheels, environment = place / "source", place / "wheels", place / "environment"
    subprocess.run(["git", "clone", "--quiet", ROOT, copy], check=True)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    sources = [copy / folder.relative_to(ROOT) for folder in DISTRIBUTIONS]
    words = ["wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", wheels, *sources]
    subprocess.run([*pip, *words], check=True, timeout=300)
    venv.create(environment, with_pip=False, symlinks=True)
    python = environment / "bin" / "python"
    install = ["--python", python, "install", "--no-deps", "--no-index", *wheels.glob("*.whl")]
    subprocess.run([*pip, *install], check=True, timeout=300)
    # the dependencies are this environment's, whose own editable packages a .pth file does not bring along
    (packages_in(environment) / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    return environment


def packages_in(environment: Path) -> Path:
    return environment / "lib" / f"python{sysconfig.get_python_version()}" / "site-packages"


@pytest.mark.nightly  # half a minute for the wheels
def test_wheels_have_their_packages_programs_and_the_files_of_the_page(environment: Path, tmp_path: Path) -> None:
    packages = packages_in(environment)
    where = "import rfm, rfm_gateway as g; print(rfm.__file__, g.__file__)"
    told = subprocess.check_output([environment / "bin" / "python", "-c", where], cwd=tmp_path, text=True)
    assert all(path.startswith(str(packages)) for path in told.split())
    for package in ("rfm", "rfm_client", "rfm_commands", "rfm_export", "rfm_gateway"):
        assert (packages / package / "py.typed").is_file()
    for package in (GATEWAY, PAGE):
        kinds = ("docs/*", "static/*", "examples/*", "vendored/*/*")
        expected = [file.relative_to(package.parent) for kind in kinds for file in package.glob(kind)]
        assert expected
        assert [file for file in expected if not (packages / file).is_file()] == []
    for program in ("rfm", "rfm-client"):
        shown = subprocess.check_output([environment / "bin" / program, "--version"], text=True)
        assert shown == f"{program} {version()}\n"


@pytest.mark.nightly  # the image of docker/ serves then, too
def test_wheels_serve_and_score_without_the_source_tree(environment: Path, tmp_path: Path) -> None:
    ports = Endpoints.free()
    serve = [environment / "bin" / "rfm", "serve", ROOT / "model_repository", "--grpc-port", str(ports.grpc_port)]
    serve += ["--http-port", str(ports.http_port), "--metrics-port", str(ports.metrics_port)]
    client = [environment / "bin" / "rfm-client"]
    url = ["--url", f"grpc://127.0.0.1:{ports.grpc_port}"]
    with (tmp_path / "serve.log").open("wb") as log, subprocess.Popen(serve, cwd=tmp_path, stderr=log) as server:
        try:
            subprocess.run([*client, "wait", *url, "--timeout", "100"], check=True)
            sample = [*client, "sample", *url, "--json", tmp_path / "answer.json"]
            subprocess.run(sample, check=True, capture_output=True)
        finally:
            server.terminate()
    assert "progress" in (tmp_path / "answer.json").read_text()
