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
from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints
from rfm_commands.config import Config

pytestmark = [pytest.mark.triton, pytest.mark.slow]

DOCKER = ROOT / "docker"
DOCKERFILE = (DOCKER / "Dockerfile").read_text()
COMPOSE = yaml.safe_load((DOCKER / "compose.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
BIN = Path(sys.executable).parent
LOCK = DOCKER / "requirements.txt"
COPIED = re.compile(r"^COPY ([^-].*) (/source\S*)$", re.MULTILINE)
MOUNTED = re.compile(r"--mount=type=bind,source=([^,\s]+),target=(/source[^,\s]+)")
HASHES = re.compile(r"( --hash=sha256:[0-9a-f]{64})+")
STEP = re.compile(r"/source/docker/install\.sh ([a-z]+ /.*)$", re.MULTILINE)
VARIABLE = re.compile(r"\$\{(\w+):-(.*?)\}")
OURS = {"rfm-client", "rfm-gateway", "rfm-triton"}
NOT_FOR_SERVING = {"pip", "pytest", "ruff", "mypy", "nvidia-pytriton", "matplotlib", "gymnasium", "hypothesis"}
UNAVAILABLE = 3
SYSTEM_PATH = "/usr/local/bin:/usr/bin:/bin"


@dataclass(frozen=True)
class Image:
    """What the Dockerfile puts into /opt/rfm, under ``root``, with a Triton in PATH as in NVIDIA's image."""

    root: Path
    environment: dict[str, str]

    def run(self, *words: object, **variables: str) -> subprocess.CompletedProcess[str]:
        program = shutil.which(str(words[0]), path=self.environment["PATH"])
        assert program is not None, words[0]
        return subprocess.run(
            [program, *map(str, words[1:])],
            env={**self.environment, **variables},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )

    @contextmanager
    def started(self, *words: object) -> Iterator[subprocess.Popen[bytes]]:
        """A program that runs until it is told to stop, and then ends well."""
        program = shutil.which(str(words[0]), path=self.environment["PATH"])
        assert program is not None, words[0]
        with (self.root / f"{words[0]}.log").open("ab") as log:
            process = subprocess.Popen([program, *map(str, words[1:])], env=self.environment, stdout=log, stderr=log)
            try:
                yield process
            finally:
                process.terminate()
                status = process.wait(60)
        assert status in (0, -signal.SIGTERM), (self.root / f"{words[0]}.log").read_text()[-2000:]


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Image:
    root = tmp_path_factory.mktemp("image")
    for sources, target in COPIED.findall(DOCKERFILE):
        for source in sources.split():
            copy(ROOT / source, root / target.lstrip("/"))
    for source, target in MOUNTED.findall(DOCKERFILE):
        copy(ROOT / source, (root / target.lstrip("/")).parent)
    steps = STEP.findall(DOCKERFILE)
    assert [step.split()[0] for step in steps] == ["wheels", "torch", "packages"]
    for step in steps:
        words = [root / word.lstrip("/") if word.startswith("/") else word for word in step.split()]
        done = install(root / "source", *words)
        assert done.returncode == 0, done.stderr
    path = f"{root / 'opt/rfm/bin'}:{triton_in(root)}:{SYSTEM_PATH}"
    return Image(root, {"PATH": path, "HOME": str(root), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"})


def install(source: Path, *words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["sh", source / "docker" / "install.sh", *words],
        env={**environment_of_pip(), "PATH": f"{BIN}:{SYSTEM_PATH}"},
        capture_output=True,
        text=True,
        check=False,
    )


def copy(source: Path, target: Path) -> None:
    """As COPY does it, without what .dockerignore leaves out; files are copied into a folder."""
    if source.is_dir():
        shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info", "build"))
    else:
        target.mkdir(parents=True, exist_ok=True)
        shutil.copy(source, target)


def environment_of_pip() -> dict[str, str]:
    """What tells pip where its cache and its packages are."""
    return {name: value for name, value in os.environ.items() if name.startswith(("HOME", "PIP_", "SSL_", "XDG_"))}


def triton_in(root: Path) -> Path:
    """A folder with the wheel's tritonserver, which brings along its libraries and backends like NVIDIA's."""
    triton = find_installation()
    folder = root / "opt" / "tritonserver"
    arguments = triton.lay_out_backends(folder / "backends")
    libraries = triton.environment["LD_LIBRARY_PATH"]
    program = folder / "bin" / "tritonserver"
    program.parent.mkdir()
    words = ["exec", "env", f"LD_LIBRARY_PATH={libraries}", str(triton.executable), *arguments]
    program.write_text(f'#!/bin/sh\n{shlex.join(words)} "$@"\n')
    program.chmod(0o755)
    return program.parent


def entries(file: Path) -> dict[str, str]:
    """Each requirement in a file, with the options after it, which pip lets stand on lines of their own."""
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


def needed(*roots: str, without: str) -> set[str]:
    """The packages that what is installed here says it needs, their extras too, but what only ``without`` needs."""
    found: set[tuple[str, str]] = set()
    waiting = [Requirement(root) for root in roots]
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        new = {(name, extra) for extra in {"", *requirement.extras}} - found
        if name == without or not new:
            continue
        found |= new
        further = [Requirement(text) for text in importlib.metadata.requires(name) or []]
        waiting += [
            need
            for need in further
            if need.marker is None or any(need.marker.evaluate({"extra": extra}) for _, extra in new)
        ]
    return {name for name, _ in found}


def compose_words(profile: str) -> list[str]:
    """A docker compose of either generation."""
    docker = shutil.which("docker")
    if docker and subprocess.run([docker, "compose", "version"], capture_output=True, check=False).returncode == 0:
        program = [docker, "compose"]
    else:
        assert shutil.which("docker-compose"), "docker-compose: expected in PATH, got nothing (make ops-tools)"
        program = ["docker-compose"]
    return [*program, "--file", str(DOCKER / "compose.yaml"), "--profile", profile]


def active(profile: str) -> dict[str, dict[str, Any]]:
    """The services that run with a profile."""
    return {name: service for name, service in SERVICES.items() if profile in service.get("profiles", [profile])}


def names_of(services: dict[str, dict[str, Any]]) -> list[str]:
    """Under which the services find each other."""
    aliases = (alias for service in services.values() for alias in aliases_of(service))
    return sorted([*services, *aliases])


def aliases_of(service: dict[str, Any]) -> list[str]:
    return list(service.get("networks", {}).get("default", {}).get("aliases", []))


def is_ours(service: dict[str, Any]) -> bool:
    return str(service["image"]).startswith("rfm-triton:")


def test_the_example_configuration_lets_more_wait_than_a_batch() -> None:
    export = Config.from_yaml(DOCKER / "serve.yaml").export
    assert export.max_queue_size is not None
    assert export.max_queue_size > 2 * export.max_batch_size


def test_the_dockerfile_is_clean() -> None:
    done = subprocess.run([BIN / "hadolint", DOCKER / "Dockerfile"], capture_output=True, text=True, check=False)
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


def test_the_lock_names_all_that_the_image_needs_beside_torch() -> None:
    roots = ("rfm-triton[encoders,vlm]",)
    assert set(pins(LOCK)) == needed(*roots, without="torch") - OURS, "make .venv/installed lock"


def test_the_lock_has_hashes_of_all_and_no_address() -> None:
    assert [entry for entry, options in entries(LOCK).items() if not HASHES.fullmatch(options)] == []
    assert "://" not in LOCK.read_text()


@pytest.mark.nightly
def test_the_image_holds_what_serving_needs_in_locked_versions_and_nothing_else(image: Image) -> None:
    listed = image.run(
        "python",
        "-c",
        "import importlib.metadata as m, json; print(json.dumps({d.name: d.version for d in m.distributions()}))",
    )
    installed = {canonicalize_name(name): version for name, version in json.loads(listed.stdout).items()}
    versions = pins(ROOT / "constraints.txt")
    assert set(installed) >= OURS
    assert not NOT_FOR_SERVING & set(installed)
    for name, version in installed.items():
        assert name in OURS or versions[name].contains(version), (name, version)


@pytest.mark.nightly
@pytest.mark.parametrize(
    "words",
    [
        ["python", "-c", "import rfm_export, rfm.vlm, rfm.rewind"],
        ["python", "-c", "import rfm_gateway.app"],
        ["rfm", "--help"],
        ["rfm-client", "--help"],
    ],
    ids=" ".join,
)
def test_the_image_has_the_packages_and_commands(image: Image, words: list[str]) -> None:
    done = image.run(*words)
    assert done.returncode == 0, done.stderr


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
    with image.started(*entrypoint(), *ports_of(endpoints), "--repository", repository):
        ready = image.run("rfm-client", "wait", "--url", endpoints.grpc_url, "--timeout", "100")
        assert ready.returncode == 0, ready.stderr
        health = image.run("sh", DOCKER / "health.sh", RFM_URL=endpoints.grpc_url)
        assert health.returncode == 0, health.stderr
        (sample,) = json.loads(health.stdout)["samples"]
        assert np.isfinite(sample["progress"]).all()
        if config is None:
            check_gateway(image, endpoints)
    gone = image.run("sh", DOCKER / "health.sh", RFM_URL=endpoints.grpc_url)
    assert gone.returncode == UNAVAILABLE, gone.stderr


def entrypoint() -> list[str]:
    (words,) = re.findall(r"^ENTRYPOINT (\[.*\])$", DOCKERFILE, re.MULTILINE)
    return list(json.loads(words))


def ports_of(endpoints: Endpoints) -> list[object]:
    ports = {"http": endpoints.http_port, "grpc": endpoints.grpc_port, "metrics": endpoints.metrics_port}
    return [word for name, port in ports.items() for word in (f"--{name}-port", port)]


def check_gateway(image: Image, endpoints: Endpoints) -> None:
    """The compose file's gateway, on this machine's addresses: its health check waits for it, and is true."""
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
def test_the_compose_file_is_valid(profile: str) -> None:
    done = subprocess.run([*compose_words(profile), "config", "--quiet"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("profile", ["gpu", "cpu"])
def test_every_service_that_is_asked_for_runs(profile: str) -> None:
    services = active(profile)
    assert {"server", "gateway", "prometheus", "grafana"} <= set(names_of(services))
    assert sum(name in ("server", "gateway") for name in names_of(services)) == 2
    for service in services.values():
        assert set(service.get("depends_on", {})) <= set(services)
    scraped = yaml.safe_load((DOCKER / "prometheus" / "prometheus.yml").read_text())["scrape_configs"]
    for target in (target for job in scraped for static in job["static_configs"] for target in static["targets"]):
        assert target.partition(":")[0] in names_of(services)


@pytest.mark.parametrize("name", SERVICES)
def test_every_service_is_confined(name: str) -> None:
    service = SERVICES[name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["pids_limit"] > 0
    assert service["deploy"]["resources"]["limits"]["memory"]
    assert all(port.startswith("${RFM_BIND:-127.0.0.1}:") for port in service["ports"])
    assert re.fullmatch(r"[\w/-]+:v?\d+\.\d+\.\d+(-cpu)?", VARIABLE.sub(r"\2", service["image"]))
    assert "healthcheck" in service or is_ours(service)  # the image has its own
    assert "HEALTHCHECK" in DOCKERFILE


def test_what_is_mounted_is_there() -> None:
    for service in SERVICES.values():
        for volume in service.get("volumes", []):
            source = VARIABLE.sub(r"\2", volume).partition(":")[0]
            assert source in COMPOSE["volumes"] or (DOCKER / source).exists(), source
        assert set(service.get("secrets", [])) <= set(COMPOSE["secrets"])


def test_prometheus_has_the_secrets_that_its_configuration_names() -> None:
    """Also in what is commented out, which its reader is told to use."""
    text = (DOCKER / "prometheus" / "prometheus.yml").read_text()
    named = re.findall(r"/run/secrets/(\w+)", text)
    assert named == ["gateway_api_key"]
    assert SERVICES["prometheus"]["secrets"] == named
    with_key = yaml.safe_load(re.sub(r"# (authorization:)", r"\1", text))["scrape_configs"]
    (gateway,) = (job for job in with_key if job["job_name"] == "gateway")
    assert gateway["authorization"] == {"credentials_file": "/run/secrets/gateway_api_key"}


@pytest.mark.parametrize(("options", "source"), [({}, "/dev/null"), ({"RFM_GATEWAY_KEY_FILE": "./key"}, "docker/key")])
def test_the_gateway_s_key_is_mounted_where_there_is_one(options: dict[str, str], source: str) -> None:
    command = [*compose_words("cpu"), "config"]
    done = subprocess.run(command, env={**os.environ, **options}, check=True, capture_output=True, text=True)
    assert yaml.safe_load(done.stdout)["secrets"]["gateway_api_key"]["file"].endswith(source)


@pytest.mark.nightly
@pytest.mark.parametrize("name", [name for name, service in SERVICES.items() if is_ours(service)])
def test_the_image_knows_the_options_that_the_compose_file_gives_it(image: Image, name: str) -> None:
    words = [*SERVICES[name].get("entrypoint", entrypoint()), *SERVICES[name]["command"]]
    done = image.run(*words, "--help")
    assert done.returncode == 0, done.stderr


def test_every_variable_is_explained_with_its_default() -> None:
    used = dict(VARIABLE.findall((DOCKER / "compose.yaml").read_text()))
    example = (DOCKER / ".env.example").read_text()
    told = dict(re.findall(r"^#([A-Z_]+)=(.*)$", example, re.MULTILINE))
    assert told == {**used, "RFM_GATEWAY_API_KEY": ""}


def test_no_secret_has_a_default() -> None:
    environment = SERVICES["grafana"]["environment"]
    assert not [name for name in environment if "PASSWORD" in name and not name.endswith("__FILE")]
    assert environment["GF_AUTH_ANONYMOUS_ENABLED"] == "false"
