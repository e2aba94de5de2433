# SPDX-License-Identifier: MIT
"""The image's steps, followed in a folder instead of a container, and the compose file. Needs no container engine."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

import goldens
import rfm_export
from engines import serve_config
from paths import ROOT
from servers import Endpoints, find_installation

pytestmark = [pytest.mark.triton, pytest.mark.slow]

DOCKER = ROOT / "docker"
REPOSITORY = ROOT / "model_repository"
DOCKERFILE = (DOCKER / "Dockerfile").read_text()
COMPOSE = yaml.safe_load((DOCKER / "compose.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
OURS = [name for name, service in SERVICES.items() if service["image"].startswith("rfm-triton:")]
ENTRYPOINT: list[str] = json.loads(re.findall(r"^ENTRYPOINT (\[.*\])$", DOCKERFILE, re.MULTILINE)[0])
BIN = Path(sys.executable).parent
LOCK = DOCKER / "requirements.txt"
COPIED = re.compile(r"^COPY ([^-].*) (/source\S*)$", re.MULTILINE)
MOUNTED = re.compile(r"--mount=type=bind,source=([^,\s]+),target=(/source[^,\s]+)")
HASHES = re.compile(r"( --hash=sha256:[0-9a-f]{64})+")
STEP = re.compile(r"/source/docker/install\.sh ([a-z]+ /.*)$", re.MULTILINE)
VARIABLE = re.compile(r"\$\{(\w+):-(.*?)\}")
DISTRIBUTIONS = {"rfm-client", "rfm-gateway", "rfm-page", "rfm-triton"}
NOT_FOR_SERVING = {"pip", "pytest", "ruff", "mypy", "nvidia-pytriton", "matplotlib", "gymnasium", "hypothesis"}
UNAVAILABLE = 3
SYSTEM_PATH = "/usr/local/bin:/usr/bin:/bin"


@dataclass(frozen=True)
class Image:
    """The Dockerfile's /opt/rfm below ``root``, with a Triton in PATH as in NVIDIA's image."""

    root: Path
    environment: dict[str, str]

    def program(self, words: tuple[object, ...]) -> list[str]:
        program = shutil.which(str(words[0]), path=self.environment["PATH"])
        assert program is not None, words[0]
        return [program, *map(str, words[1:])]

    def run(self, *words: object, **variables: str) -> subprocess.CompletedProcess[str]:
        environment = {**self.environment, **variables}
        return subprocess.run(self.program(words), env=environment, capture_output=True, text=True, timeout=120)

    def said(self, *words: object, **variables: str) -> str:
        done = self.run(*words, **variables)
        assert done.returncode == 0, done.stderr
        return done.stdout

    @contextmanager
    def started(self, *words: object) -> Iterator[subprocess.Popen[bytes]]:
        """A program that runs until a signal and then exits with 0."""
        log = self.root / f"{words[0]}.log"
        with log.open("ab") as lines:
            process = subprocess.Popen(self.program(words), env=self.environment, stdout=lines, stderr=lines)
            try:
                yield process
            finally:
                process.terminate()
                status = process.wait(60)
        assert status in (0, -signal.SIGTERM), log.read_text()[-2000:]


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Image:
    root = tmp_path_factory.mktemp("image")
    for sources, target in COPIED.findall(DOCKERFILE):
        for source in sources.split():
            copy(ROOT / source, root / target.lstrip("/"))
    for source, target in MOUNTED.findall(DOCKERFILE):
        copy(ROOT / source, (root / target.lstrip("/")).parent)
    steps = [step.split() for step in STEP.findall(DOCKERFILE)]
    assert [step[0] for step in steps] == ["wheels", "torch", "packages"]
    of_pip = {name: value for name, value in os.environ.items() if name.startswith(("HOME", "PIP_", "SSL_", "XDG_"))}
    for step in steps:
        subprocess.run(
            ["sh", root / "source/docker/install.sh", step[0], *(root / folder.lstrip("/") for folder in step[1:])],
            env={**of_pip, "PATH": f"{BIN}:{SYSTEM_PATH}"},
            check=True,
        )
    path = f"{root / 'opt/rfm/bin'}:{triton_in(root)}:{SYSTEM_PATH}"
    return Image(root, {"PATH": path, "HOME": str(root), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"})


def copy(source: Path, target: Path) -> None:
    """Copy as COPY does, without the files of .dockerignore."""
    if source.is_dir():
        shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info", "build"))
    else:
        target.mkdir(parents=True, exist_ok=True)
        shutil.copy(source, target)


def triton_in(root: Path) -> Path:
    """Return a folder with the wheel's tritonserver, libraries and backends, laid out like NVIDIA's."""
    triton = find_installation()
    folder = root / "opt" / "tritonserver"
    arguments = triton.lay_out_backends(folder / "backends")
    program = folder / "bin" / "tritonserver"
    program.parent.mkdir()
    libraries = triton.environment["LD_LIBRARY_PATH"]
    words = ["exec", "env", f"LD_LIBRARY_PATH={libraries}", str(triton.executable), *arguments]
    program.write_text(f'#!/bin/sh\n{shlex.join(words)} "$@"\n')
    program.chmod(0o755)
    return program.parent


def entries(file: Path) -> dict[str, str]:
    """Return each requirement of a file with the options on the following lines."""
    lines = re.sub(r" *\\\n *", " ", file.read_text()).splitlines()
    parts = [line.partition(" --") for line in lines if not line.startswith("#")]
    return {requirement: space + options for requirement, space, options in parts}


def pins(file: Path, python: str | None = None) -> dict[str, SpecifierSet]:
    """The versions in a file, for a Python as 3.12, or for this one."""
    environment = {"python_version": python, "python_full_version": f"{python}.0"} if python else None
    requirements = [Requirement(entry) for entry in entries(file)]
    return {
        canonicalize_name(pin.name): pin.specifier
        for pin in requirements
        if pin.marker is None or pin.marker.evaluate(environment)
    }


def composed(profile: str, **variables: str) -> dict[str, Any]:
    """Return the file as either generation of docker compose reads it."""
    program = ["docker", "compose"]
    if not shutil.which("docker") or subprocess.run([*program, "version"], capture_output=True).returncode:
        assert shutil.which("docker-compose"), "docker-compose: expected in PATH, got nothing (make ops-tools)"
        program = ["docker-compose"]
    command = [*program, "--file", str(DOCKER / "compose.yaml"), "--profile", profile, "config"]
    done = subprocess.run(command, env={**os.environ, **variables}, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    config: dict[str, Any] = yaml.safe_load(done.stdout)
    return config


def test_the_example_configuration_lets_more_wait_than_a_batch() -> None:
    export = yaml.safe_load((DOCKER / "serve.yaml").read_text())["export"]
    assert export["max_queue_size"] > 2 * 64  # the most samples of a batch by default


def test_the_dockerfile_is_clean() -> None:
    done = subprocess.run([BIN / "hadolint", DOCKER / "Dockerfile"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "")


def test_the_context_is_what_the_dockerfile_copies() -> None:
    copied = re.findall(r"^COPY (?:--chmod=\d+ )?([^-].*) /\S+$", DOCKERFILE, re.MULTILINE)
    used = {source for sources in copied for source in sources.split()}
    used |= {source for source, _ in MOUNTED.findall(DOCKERFILE)}
    allowed = re.findall(r"^!(.+)$", (ROOT / ".dockerignore").read_text(), re.MULTILINE)
    assert sorted(used) == sorted(allowed)


@pytest.mark.parametrize("python", ["3.10", "3.11", "3.12"])
def test_the_lock_has_the_versions_of_the_constraints(python: str) -> None:
    locked, constrained = pins(LOCK, python), pins(ROOT / "constraints.txt", python)
    assert locked == {name: constrained.get(name) for name in locked}, "make lock"


def test_the_lock_names_what_the_packages_ask_for_with_hashes_and_without_addresses() -> None:
    """``pip check`` finds missing dependencies in the build of the image."""
    asked = [Requirement(text) for name in DISTRIBUTIONS for text in importlib.metadata.requires(name) or []]
    extras = ("", "encoders", "vlm", "quantized")
    needed = {
        canonicalize_name(need.name)
        for need in asked
        if need.marker is None or any(need.marker.evaluate({"extra": extra}) for extra in extras)
    }
    assert needed - DISTRIBUTIONS - {"torch"} <= set(pins(LOCK)), "make .venv/installed lock"
    assert [entry for entry, options in entries(LOCK).items() if not HASHES.fullmatch(options)] == []
    assert "://" not in LOCK.read_text()


@pytest.mark.nightly
def test_the_image_holds_what_serving_needs_in_locked_versions_and_nothing_else(image: Image) -> None:
    code = "import importlib.metadata as m, json; print(json.dumps({d.name: d.version for d in m.distributions()}))"
    installed = {
        canonicalize_name(name): version for name, version in json.loads(image.said("python", "-c", code)).items()
    }
    versions = pins(ROOT / "constraints.txt")
    assert set(installed) >= DISTRIBUTIONS
    assert not NOT_FOR_SERVING & set(installed)
    for name, version in installed.items():
        assert name in DISTRIBUTIONS or versions[name].contains(version), (name, version)


@pytest.mark.nightly
@pytest.mark.parametrize(
    "words",
    [
        ["python", "-c", "import rfm_export, rfm.vlm, rfm.rewind, rfm_gateway.app"],
        ["rfm-client", "--help"],
        *([*SERVICES[name].get("entrypoint", ENTRYPOINT), *SERVICES[name]["command"], "--help"] for name in OURS),
    ],
    ids=" ".join,
)
def test_the_image_has_the_packages_and_the_commands_and_options_of_the_compose_file(
    image: Image, words: list[str]
) -> None:
    image.said(*words)


@pytest.mark.nightly
@pytest.mark.parametrize(
    "config", [None, next(config for config in goldens.VLM if not config.is_bfloat16)], ids=["rewind", "vlm"]
)
def test_the_image_serves_and_its_health_check_tells(
    image: Image, tmp_path: Path, config: goldens.Config | None
) -> None:
    repository = ROOT / "model_repository"
    if config is not None:
        repository = tmp_path / "model_repository"
        rfm_export.export(config.checkpoint, repository, serve_config(config))
    endpoints = Endpoints.free()
    ports = {"http": endpoints.http_port, "grpc": endpoints.grpc_port, "metrics": endpoints.metrics_port}
    options = [f"--{name}-port={port}" for name, port in ports.items()]
    with image.started(*ENTRYPOINT, *options, "--repository", repository):
        image.said("rfm-client", "wait", "--url", endpoints.grpc_url, "--timeout", "100")
        health = image.said("sh", DOCKER / "health.sh", RFM_URL=endpoints.grpc_url)
        (sample,) = json.loads(health)["samples"]
        assert np.isfinite(sample["progress"]).all()
        if config is None:
            check_gateway(image, endpoints)
    gone = image.run("sh", DOCKER / "health.sh", RFM_URL=endpoints.grpc_url)
    assert gone.returncode == UNAVAILABLE, gone.stderr


@pytest.mark.nightly
def test_the_image_alone_exports_and_serves_what_it_exported(image: Image, tmp_path: Path) -> None:
    """With `serve.yaml`, as the guide exports with it."""
    config = next(config for config in goldens.VLM if not config.is_bfloat16)
    sources = [f"--{name.replace('_', '-')}={source}" for name, source in config.sources.items()]
    words = ["--checkpoint", config.checkpoint, *sources, "--config", DOCKER / "serve.yaml", "--num-gpus", "0"]
    repository, endpoints = tmp_path / "my_models", Endpoints.free()
    told = image.said("rfm", "export", *words, "--repository", repository)
    assert told == f"{repository}: rfm version 1, scores equal to the checkpoint's\n"
    ports = {"http": endpoints.http_port, "grpc": endpoints.grpc_port, "metrics": endpoints.metrics_port}
    options = [f"--{name}-port={port}" for name, port in ports.items()]
    with image.started(*ENTRYPOINT, *options, "--repository", repository):
        image.said("rfm-client", "wait", "--url", endpoints.grpc_url, "--timeout", "100")
        image.said("sh", DOCKER / "health.sh", RFM_URL=endpoints.grpc_url)


def check_gateway(image: Image, endpoints: Endpoints) -> None:
    """The compose file's gateway on local addresses passes the health check."""
    gateway, port = SERVICES["gateway"], str(Endpoints.free().http_port)
    here = {"grpc://server:8001": endpoints.grpc_url, "http://server:8002/metrics": endpoints.metrics_url}
    here |= {"0.0.0.0": endpoints.host, "8100": port}
    words = [here.get(word, word) for word in (*gateway["entrypoint"], *gateway["command"])]
    assert len(here) == len(set(words) & set(here.values()))
    check = [word.replace("localhost:8100", f"localhost:{port}") for word in gateway["healthcheck"]["test"][1:]]
    with image.started(*words) as process:
        while image.run(*check).returncode:
            assert process.poll() is None
        assert httpx.get(f"http://127.0.0.1:{port}/gpu_status").status_code == 200


@pytest.mark.parametrize("profile", ["gpu", "cpu"])
def test_every_service_that_is_asked_for_runs(profile: str) -> None:
    asked_for = composed(profile)["services"].items()  # docker-compose 1 has those of other profiles too
    services = {name: service for name, service in asked_for if profile in service.get("profiles", [profile])}
    names = [*services]
    for service in services.values():
        assert set(service.get("depends_on", {})) <= set(services)
        names += ((service.get("networks") or {}).get("default") or {}).get("aliases", [])
    assert {"server", "gateway", "prometheus", "grafana"} <= set(names)
    assert sum(name in ("server", "gateway") for name in names) == 2
    scraped = yaml.safe_load((DOCKER / "prometheus" / "prometheus.yml").read_text())["scrape_configs"]
    for target in (target for job in scraped for static in job["static_configs"] for target in static["targets"]):
        assert target.partition(":")[0] in names


@pytest.mark.parametrize("name", SERVICES)
def test_every_service_is_confined(name: str) -> None:
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["ulimits"]["nofile"] == {"soft": 65536, "hard": 65536}
    assert service["pids_limit"] > 0
    assert service["deploy"]["resources"]["limits"]["memory"]
    assert all(port.startswith("${RFM_BIND:-127.0.0.1}:") for port in service["ports"])
    assert re.fullmatch(r"[\w/-]+:v?\d+\.\d+\.\d+(-cpu)?", VARIABLE.sub(r"\2", service["image"]))
    assert "healthcheck" in service or name in OURS  # the image has another
    assert "HEALTHCHECK" in DOCKERFILE
    for volume in service.get("volumes", []):
        source, target, *_ = VARIABLE.sub(r"\2", volume).split(":")
        is_the_users = target == "/models"
        assert is_the_users or source in COMPOSE["volumes"] or (DOCKER / source).exists(), source


@pytest.mark.parametrize(("profile", "name"), [("gpu", "server"), ("cpu", "server-cpu")])
def test_the_repository_that_the_guide_exports_is_served_unless_another_is_named(profile: str, name: str) -> None:
    """With the profile gpu, on the GPU."""
    guide = (ROOT / "docs" / "guides" / "deploy.md").read_text()
    for variables, source in (({}, "/srv/rfm/my_models"), ({"RFM_MODELS": "../model_repository"}, REPOSITORY)):
        service = composed(profile, **variables)["services"][name]
        (volume,) = service["volumes"]
        bound = volume.split(":")[:2] if isinstance(volume, str) else [volume["source"], volume["target"]]
        assert bound == [str(source), "/models"]
    assert "--repository /srv/rfm/my_models" in guide
    assert SERVICES[name]["command"][0] == "--repository=/models"
    devices = SERVICES[name]["deploy"]["resources"].get("reservations", {}).get("devices", [])
    assert [device["driver"] for device in devices] == (["nvidia"] if profile == "gpu" else [])


def test_prometheus_has_the_secrets_that_its_configuration_names() -> None:
    """Also in comments, which the file recommends."""
    text = (DOCKER / "prometheus" / "prometheus.yml").read_text()
    named = re.findall(r"/run/secrets/(\w+)", text)
    assert named == ["gateway_api_key"]
    assert SERVICES["prometheus"]["secrets"] == named
    with_key = yaml.safe_load(re.sub(r"# (authorization:)", r"\1", text))["scrape_configs"]
    (gateway,) = (job for job in with_key if job["job_name"] == "gateway")
    assert gateway["authorization"] == {"credentials_file": "/run/secrets/gateway_api_key"}
    for variables, source in (({}, "/dev/null"), ({"RFM_GATEWAY_KEY_FILE": "./key"}, "docker/key")):
        assert composed("cpu", **variables)["secrets"]["gateway_api_key"]["file"].endswith(source)


def test_every_variable_is_explained_with_its_default_and_no_secret_has_one() -> None:
    used = dict(VARIABLE.findall((DOCKER / "compose.yaml").read_text()))
    example = (DOCKER / ".env.example").read_text()
    told = dict(re.findall(r"^#([A-Z_]+)=(.*)$", example, re.MULTILINE))
    assert told == {**used, "RFM_GATEWAY_API_KEY": ""}
    environment = SERVICES["grafana"]["environment"]
    assert not [name for name in environment if "PASSWORD" in name and not name.endswith("__FILE")]
    assert environment["GF_AUTH_ANONYMOUS_ENABLED"] == "false"
