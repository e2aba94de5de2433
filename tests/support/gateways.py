# SPDX-License-Identifier: MIT
"""Gateways, as processes and inside the test."""

from __future__ import annotations

import asyncio
import http.client
import os
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import requests
import uvicorn
from fastapi import FastAPI
from prometheus_client.parser import text_string_to_metric_families

from rfm.serve.access import free_ports
from rfm_client import AsyncRewardClient, DeadlineExceededError, ModelInfo, ModelNotFoundError, RewardClient
from rfm_gateway import GatewayConfig
from rfm_gateway.app import create_app
from rfm_gateway.command import server_options
from servers import PATIENCE_S, Endpoints, wait_for
from shelves import Shelf
from transports import Answer, Tensors

with warnings.catch_warnings():  # it would rather have httpx2
    warnings.simplefilter("ignore")
    from starlette.testclient import TestClient as TestClient

NO_TRITON = "grpc://127.0.0.1:1"


@dataclass(frozen=True)
class Address:
    """Where a gateway answers."""

    url: str

    def connect(self) -> http.client.HTTPConnection:
        return http.client.HTTPConnection(self.url.removeprefix("http://"), timeout=PATIENCE_S)

    def dial(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", int(self.url.rpartition(":")[2])), PATIENCE_S)

    def get(self, path: str, **options: Any) -> requests.Response:
        return requests.get(f"{self.url}{path}", timeout=PATIENCE_S, **options)

    def metric(self, name: str, **labels: str) -> float:
        """Return the value of a metric of the gateway."""
        return metric_at(f"{self.url}/metrics", f"rfm_gateway_{name}", **labels)


@dataclass(frozen=True)
class Gateway(Address):
    """A running gateway, and the Triton behind it."""

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


def free_port() -> int:
    return free_ports(1)[0]


def metric_at(url: str, name: str, **labels: str) -> float:
    """A sum over the labels that are not given; 0 before the first is counted."""
    families = text_string_to_metric_families(requests.get(url).text)
    samples = (sample for family in families for sample in family.samples)
    return sum(each.value for each in samples if each.name == name and labels.items() <= each.labels.items())


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
        wait_for(lambda: process.poll() is not None or answers(gateway.url))
        assert process.poll() is None, gateway.log
        yield gateway
        assert "Traceback" not in gateway.log
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


@dataclass
class StandIn(Shelf):
    """Stands in for Triton: describes the models of ``served``, and answers samples when ``is_open`` is set."""

    served: Collection[str] = ("rfm", "rfm_encoder", "rfm_frames")
    dims: tuple[int, int] = (2, 2)  # widths D and Dt
    is_open: threading.Event = field(default_factory=threading.Event)
    num_cancelled: int = 0

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        if model not in self.served:
            raise ModelNotFoundError(model)
        info = await super().model_info(model, timeout_s)
        return info if info.video_dim is None else replace(info, video_dim=self.dims[0], text_dim=self.dims[1])

    async def infer(
        self, model: str, inputs: Tensors, outputs: Collection[str], timeout_s: float, *, request_id: str = ""
    ) -> Answer:
        if model not in self.served:
            raise ModelNotFoundError(model)
        ends_s = time.monotonic() + timeout_s
        try:
            while not self.is_open.is_set():
                await asyncio.sleep(0.01)
                if time.monotonic() > ends_s:
                    raise DeadlineExceededError("no answer in time")
        except asyncio.CancelledError:
            self.num_cancelled += 1
            raise
        return await super().infer(model, inputs, outputs, timeout_s, request_id=request_id)


def _app(triton: StandIn | str, api_key: str | None, settings: Mapping[str, Any]) -> tuple[FastAPI, GatewayConfig]:
    if isinstance(triton, str):
        config = GatewayConfig(triton=triton, **settings)
        return create_app(config, api_key), config
    config = GatewayConfig(triton=NO_TRITON, **settings)
    limits = {"timeout_s": config.timeout_s, "max_in_flight": config.max_in_flight}
    return create_app(config, api_key, client=AsyncRewardClient("", transports=[triton], retry=False, **limits)), config


@contextmanager
def inside(api_key: str | None = None, triton: StandIn | str = NO_TRITON, **settings: Any) -> Iterator[TestClient]:
    """A gateway inside this process, before a stand-in or the Triton of a URL."""
    app, _ = _app(triton, api_key, settings)
    with TestClient(app, "http://127.0.0.1", raise_server_exceptions=False) as client:
        yield client


@contextmanager
def listening(triton: StandIn, api_key: str | None = None, **settings: Any) -> Iterator[Address]:
    """A gateway in a thread, with the sockets and limits of a real one, before a stand-in."""
    app, config = _app(triton, api_key, settings)
    server = uvicorn.Server(uvicorn.Config(app, **server_options(config)))
    with socket.create_server(("127.0.0.1", 0), backlog=1024) as listener:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            wait_for(lambda: server.started)
            yield Address(f"http://127.0.0.1:{listener.getsockname()[1]}")
        finally:
            triton.is_open.set()
            server.should_exit = True
            thread.join(PATIENCE_S)
