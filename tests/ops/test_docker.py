# SPDX-License-Identifier: MIT
"""The Dockerfile, the lock of the image's packages, and the compose file. Needs no container engine."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from in_process import rfm_parsed
from paths import ROOT

DOCKER = ROOT / "docker"
DOCKERFILE = (DOCKER / "Dockerfile").read_text()
SERVICES: dict[str, dict[str, Any]] = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]
OURS = [name for name, service in SERVICES.items() if service["image"].startswith("rfm-triton:")]
ENTRYPOINT: list[str] = json.loads(re.findall(r"^ENTRYPOINT (\[.*\])$", DOCKERFILE, re.MULTILINE)[0])
BIN = Path(sys.executable).parent
COPIED = re.compile(r"^COPY (?:--chmod=\d+ )?([^-].*) (/\S+)$", re.MULTILINE)
MOUNTED = re.compile(r"--mount=type=bind,source=([^,\s]+),target=(/source[^,\s]+)")
PIN = re.compile(r"^([\w.-]+)==([^\s;]+)", re.MULTILINE)
NEED = re.compile(r"([\w.-]+)(?:.*extra == [\"'](\w+))?")
DISTRIBUTIONS = {"rfm-client", "rfm-gateway", "rfm-page", "rfm-triton"}
EXTRAS = {"", "encoders", "vlm", "quantized"}


def words_of(command: str | list[str]) -> list[str]:
    """Return a command as Compose splits it, without the variables that are unset."""
    return shlex.split(re.sub(r"\$\{\w+:-\}", "", command)) if isinstance(command, str) else command


def pins(file: Path) -> set[tuple[str, str]]:
    return {(re.sub(r"[-_.]+", "-", name).lower(), version) for name, version in PIN.findall(file.read_text())}


def test_the_dockerfile_is_clean() -> None:
    done = subprocess.run([BIN / "hadolint", DOCKER / "Dockerfile"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "")


def test_the_build_context_is_exactly_the_files_that_the_dockerfile_uses() -> None:
    used = {source for sources, _ in COPIED.findall(DOCKERFILE) for source in sources.split()}
    used |= {source for source, _ in MOUNTED.findall(DOCKERFILE)}
    assert sorted(used) == sorted(re.findall(r"^!(.+)$", (ROOT / ".dockerignore").read_text(), re.MULTILINE))


def test_the_lock_has_all_needed_packages_in_the_versions_of_the_constraints_with_hashes() -> None:
    text = (DOCKER / "requirements.txt").read_text()
    locked = pins(DOCKER / "requirements.txt")
    assert locked
    assert locked <= pins(ROOT / "constraints.txt"), "make lock"
    needs = [NEED.match(need) for name in DISTRIBUTIONS for need in importlib.metadata.requires(name) or []]
    needed = {re.sub(r"[-_.]+", "-", need[1]).lower() for need in needs if need and (need[2] or "") in EXTRAS}
    assert needed - DISTRIBUTIONS - {"torch"} <= {name for name, _ in locked}, "make .venv/installed lock"
    entries = re.sub(r" *\\\n *", " ", text).splitlines()
    assert [entry for entry in entries if not re.search(r"^#|( --hash=sha256:[0-9a-f]{64})+$", entry)] == []
    assert "://" not in text


@pytest.mark.parametrize("name", OURS)
def test_the_compose_file_s_commands_are_those_of_the_program(name: str) -> None:
    program, command, *words = [*SERVICES[name].get("entrypoint", ENTRYPOINT), *words_of(SERVICES[name]["command"])]
    assert program in ("rfm", "rfm-client")  # whose gateway is the same
    assert rfm_parsed(command, *words)["host"] == "0.0.0.0"


@pytest.mark.parametrize(("profile", "server"), [("gpu", "server"), ("cpu", "server-cpu")])
def test_docker_compose_runs_the_services_that_prometheus_scrapes(
    docker_compose: str, profile: str, server: str
) -> None:
    words = [docker_compose, "--file", str(DOCKER / "compose.yaml"), "--profile", profile, "config"]
    done = subprocess.run(
        words, env={**os.environ, "RFM_GATEWAY_OPTIONS": "--refuse-blank --timeout 600"}, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    asked_for = yaml.safe_load(done.stdout)["services"].items()  # docker-compose 1 has those of other profiles, too
    services = {name: service for name, service in asked_for if profile in service.get("profiles", [profile])}
    names = {*services}
    for service in services.values():
        assert set(service.get("depends_on", {})) <= set(services)
        names |= {*((service.get("networks") or {}).get("default") or {}).get("aliases", [])}
    assert {"server", "gateway", "prometheus", "grafana"} <= names
    (gateway,) = (service for name, service in services.items() if name.startswith("gateway"))
    assert words_of(gateway["command"])[-3:] == ["--refuse-blank", "--timeout", "600"]
    scraped = yaml.safe_load((DOCKER / "prometheus" / "prometheus.yml").read_text())["scrape_configs"]
    hosts = {
        target.partition(":")[0] for job in scraped for each in job["static_configs"] for target in each["targets"]
    }
    assert hosts <= names
    (volume,) = services[server]["volumes"]
    bound = volume.split(":")[:2] if isinstance(volume, str) else [volume["source"], volume["target"]]
    assert bound == ["/srv/rfm/my_models", "/models"]
