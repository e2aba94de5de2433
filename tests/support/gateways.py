# SPDX-License-Identifier: MIT
"""Gateways, as processes and inside the test."""

from __future__ import annotations

import http.client
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import requests
from prometheus_client.parser import text_string_to_metric_families

from rfm.launch.endpoints import free_ports
from rfm_client import RewardClient
from rfm_gateway import GatewayConfig
from rfm_gateway.app import create_app
from servers import Endpoints

with warnings.catch_warnings():  # it would rather have httpx2
    warnings.simplefilter("ignore")
    from starlette.testclient import TestClient as TestClient

WITHIN_S = 60


@dataclass(frozen=True)
class Gateway:
    """A running gateway, and the Triton behind it."""

    url: str
    model: str
    triton_url: str
    process: subprocess.Popen[bytes]
    log_file: Path

    @property
    def log(self) -> str:
        return self.log_file.read_text()

    def client(self) -> RewardClient:
        """Asks the same model without the gateway."""
        return RewardClient(self.triton_url, model=self.model)

    def connect(self) -> http.client.HTTPConnection:
        return http.client.HTTPConnection(self.url.removeprefix("http://"), timeout=WITHIN_S)

    def get(self, path: str, **options: Any) -> requests.Response:
        return requests.get(f"{self.url}{path}", timeout=WITHIN_S, **options)

    def metric(self, name: str, **labels: str) -> float:
        """Return the value of a metric of the gateway."""
        return metric_at(f"{self.url}/metrics", f"rfm_gateway_{name}", **labels)


def free_port() -> int:
    return free_ports(1)[0]


def metric_at(url: str, name: str, **labels: str) -> float:
    """A sum over the labels that are not given; 0 before the first is counted."""
    families = text_string_to_metric_families(requests.get(url).text)
    samples = (sample for family in families for sample in family.samples)
    return sum(each.value for each in samples if each.name == name and labels.items() <= each.labels.items())


def poll(is_so: Callable[[], bool]) -> None:
    ends_s = time.monotonic() + WITHIN_S
    while not is_so():
        assert time.monotonic() < ends_s
        time.sleep(0.02)


def answers(url: str) -> bool:
    try:
        return requests.get(f"{url}/openapi.json").ok
    except requests.ConnectionError:
        return False


@contextmanager
def running(
    endpoints: Endpoints, folder: Path, model: str = "rfm", *options: str, port: int | None = None, **environment: str
) -> Iterator[Gateway]:
    port = port or free_port()
    command = [sys.executable, "-m", "rfm_gateway", "--triton", endpoints.grpc_url, "--port", str(port)]
    command += ["--metrics-url", endpoints.metrics_url, "--model", model, *options]
    log_file = folder / f"gateway_{port}.log"
    with log_file.open("wb") as log:
        process = subprocess.Popen(command, env={**os.environ, **environment}, stdout=log, stderr=log)
    gateway = Gateway(f"http://127.0.0.1:{port}", model, endpoints.grpc_url, process, log_file)
    try:
        poll(lambda: process.poll() is not None or answers(gateway.url))
        assert process.poll() is None, gateway.log
        yield gateway
        assert "Traceback" not in gateway.log
    finally:
        process.terminate()
        process.wait(WITHIN_S)


@contextmanager
def inside(api_key: str | None = None, **settings: Any) -> Iterator[TestClient]:
    """A gateway inside this process, before no Triton unless ``settings`` name one."""
    app = create_app(GatewayConfig(**{"triton": "grpc://127.0.0.1:1", **settings}), api_key)
    with TestClient(app, "http://127.0.0.1", raise_server_exceptions=False) as client:
        yield client
