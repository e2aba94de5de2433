# SPDX-License-Identifier: MIT
"""The servers that tests start: Triton, ``rfm serve``, and stand-ins for web servers."""

from __future__ import annotations

import re
import signal
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import psutil
from prometheus_client.parser import text_string_to_metric_families

import goldens
import rfm_export
from commands import RFM, own_regions, running
from engines import serve_config
from rfm.serve.access import Endpoints
from rfm.serve.access import GrpcTls as GrpcTls
from rfm.serve.installation import Installation, find_installation
from rfm.serve.processes import children_of
from rfm.serve.repository_api import RepositoryApi
from rfm.serve.triton_server import TritonServer
from rfm_client import RewardClient

CRASHES: list[Path] = []  # repositories whose Triton aborted, or started twice
MODEL = "rfm"
KEY = "a-key-that-only-tests-know"  # an admin key
PATIENCE_S = 60.0
START_S = 240.0  # generous, for slow machines
TRUTH_S = 5.0  # until readiness shows a change


class BriefServer(TritonServer):
    """A server that is killed after the test: Triton takes a second to end each model process in order."""

    _num_stops = 0

    def start_ready(self, served: Mapping[str, Mapping[str, Any]] | None = None) -> None:
        before = self._num_stops
        try:
            super().start_ready(served)
        finally:
            if self._num_stops > before:  # Triton spoilt a start, perhaps both, or hung for a minute
                CRASHES.append(self.repository)

    def stop(self) -> None:
        self._num_stops += 1
        super().stop()

    def __exit__(self, *raised: Any) -> None:
        if self.exit_status == -signal.SIGABRT:
            CRASHES.append(self.repository)
        if self.exit_status is None:
            self.kill()
        super().__exit__(*raised)


@contextmanager
def start_triton(
    repository: Path, installation: Installation | None = None, endpoints: Endpoints | None = None
) -> Iterator[BriefServer]:
    """Serve the repository with a Triton that is ready. The log is a file beside the repository."""
    program, ports = installation or find_installation(), endpoints or Endpoints.free()
    with (
        (repository.parent / "tritonserver.log").open("wb") as log,
        BriefServer(repository, ports, program, log=log) as server,
    ):
        yield server


@dataclass(frozen=True)
class Served:
    """A running server with every reference checkpoint by name."""

    server: TritonServer

    @property
    def repository(self) -> Path:
        return self.server.repository

    @property
    def endpoints(self) -> Endpoints:
        return self.server.endpoints

    def url(self, protocol: str) -> str:
        return self.endpoints.grpc_url if protocol == "grpc" else self.endpoints.http_url

    def api(self) -> RepositoryApi:
        return RepositoryApi(self.endpoints.grpc_url, self.server.admin_key)

    def client(self, protocol: str, model: str = "c1_t1_disc10") -> RewardClient:
        self.has(model)
        return RewardClient(self.url(protocol), model=model)

    def has(self, name: str) -> None:
        """Have the server serve a reference checkpoint, too."""
        if name in {config.name for config in goldens.ON_DEMAND} and not (self.repository / name).exists():
            before = set(self.repository.iterdir())
            rfm_export.export(
                goldens.config(name).checkpoint, self.repository, serve_config(goldens.config(name), name)
            )
            with self.api() as api:
                for model in sorted(set(self.repository.iterdir()) - before):
                    api.load(model.name)

    def revive(self) -> None:
        """Starts the server again if it has crashed, as ``rfm serve`` would: Triton 2.51 does, once in thousands of
        calls that are cancelled over gRPC (triton-inference-server/server, issue 7368), and takes no other test along.
        """
        if self.server.exit_status is not None:
            self.server.stop()
            self.server.start_ready()


def wait_for(is_so: Callable[[], Any], within_s: float = PATIENCE_S, told: object = None) -> float:
    """Seconds until it was so. told: shown in the failure"""
    started_s = time.monotonic()
    while not is_so():
        assert time.monotonic() - started_s < within_s, told
        time.sleep(0.02)
    return time.monotonic() - started_s


def children(pid: int, program: str = "") -> list[int]:
    """Return the children of a process. program: part of the name"""
    found = []
    for child in children_of(pid):
        with suppress(psutil.NoSuchProcess):  # it has ended
            found += [child] if program in psutil.Process(child).name() else []
    return found


def model_processes(triton: int, model: str = MODEL) -> list[int]:
    """Return the live processes of a model below the tritonserver ``triton``; a zombie has no arguments."""
    return sorted(running(f"/{model}/", 2) & set(children(triton, "triton_python")))


@dataclass
class Serving:
    """An ``rfm serve`` that runs."""

    process: subprocess.Popen[bytes]
    endpoints: Endpoints
    status_url: str
    log: Path

    def ready(self) -> httpx.Response | None:
        try:
            return httpx.get(f"{self.status_url}/ready")
        except httpx.TransportError:
            return None

    def is_ready(self) -> bool:
        answer = self.ready()
        return answer is not None and answer.status_code == 200

    def wait_ready(self, is_so: bool = True, within_s: float = PATIENCE_S) -> float:
        return wait_for(lambda: self.is_ready() is is_so or self.process.poll() is not None, within_s)

    @property
    def triton(self) -> int:
        (pid,) = children(self.process.pid, "tritonserver")
        return pid

    def model_processes(self, model: str = MODEL) -> list[int]:
        return model_processes(self.triton, model)

    def reasons(self) -> dict[str, str]:
        """Return the reasons by model; empty: the model is ready."""
        answer = self.ready()
        return {} if answer is None else {name: told["reason"] for name, told in answer.json()["models"].items()}

    def client(self, **options: Any) -> RewardClient:
        return RewardClient(self.endpoints.grpc_url, **options)

    def metric(self, name: str, **labels: str) -> float:
        text = httpx.get(f"{self.status_url}/metrics").text
        samples = [sample for family in text_string_to_metric_families(text) for sample in family.samples]
        return sum(
            sample.value for sample in samples if sample.name == name and labels.items() <= sample.labels.items()
        )

    def restarts(self, *what: str) -> float:
        return sum(self.metric("rfm_serve_restarts_total", what=name) for name in what)

    def api(self) -> RepositoryApi:
        """Return the repository API of an ``administered`` server."""
        return RepositoryApi(self.endpoints.grpc_url, KEY)

    @property
    def said(self) -> list[str]:
        """Messages of ``rfm serve`` without the heads of log lines, except those about requests and readiness."""
        log = re.sub(
            r"^\S+Z [A-Z]+ rfm-serve\[\d+\]: ", "rfm: ", self.log.read_text(errors="replace"), flags=re.MULTILINE
        )
        return [line for line in log.splitlines() if re.match("rfm: (?!ready)", line)]


@contextmanager
def serving(repository: Path, *more: str) -> Iterator[Serving]:
    """Run ``rfm serve``, which may leave nothing behind."""
    endpoints, status_port = Endpoints.free(), Endpoints.free().http_port
    ports = {"http": endpoints.http_port, "grpc": endpoints.grpc_port, "metrics": endpoints.metrics_port}
    options = [f"--{name}-port={port}" for name, port in (ports | {"status": status_port}).items()]
    log = repository.parent / "rfm.log"
    with log.open("wb") as lines:
        process = subprocess.Popen(
            [RFM, "serve", "--repository", repository, *options, *more], stdout=lines, stderr=lines
        )
    served = Serving(process, endpoints, f"http://127.0.0.1:{status_port}", log)
    try:
        yield served
    except BaseException:
        print("\n".join(served.said), file=sys.stderr)  # shown with the failed test
        if any("SIGABRT" in line for line in served.said):
            CRASHES.append(repository)
        raise
    finally:
        if process.poll() is None:
            process.terminate()
        process.wait(PATIENCE_S)
    assert not own_regions(process.pid)


@contextmanager
def administered(repository: Path, *more: str, **settings: int) -> Iterator[Serving]:
    """Run ``rfm serve`` with these settings and an admin key until ready."""
    key_file, config = repository.parent / "key", repository.parent / "serve.yaml"
    key_file.touch(0o600)
    key_file.write_text(KEY)
    config.write_text("serve:\n" + "".join(f"  {name}: {value}\n" for name, value in settings.items()))
    with serving(repository, f"--admin-key-file={key_file}", f"--config={config}", *more) as served:
        served.wait_ready(within_s=START_S)
        yield served
    assert KEY not in served.log.read_text(errors="replace")


class Quiet:
    """A part of handlers that log no requests."""

    def log_message(self, format: str, *args: object) -> None:
        pass


class FolderRequest(Quiet, SimpleHTTPRequestHandler):
    """Answers with a file of the folder ``directory``."""


@contextmanager
def web_server(handler: Callable[..., BaseHTTPRequestHandler], context: ssl.SSLContext | None = None) -> Iterator[str]:
    """Answer HTTP requests by ``handler``, over TLS with ``context``. Yields the URL."""
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        if context is not None:
            server.socket = context.wrap_socket(server.socket, server_side=True)
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield f"{'http' if context is None else 'https'}://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


def folder_server(folder: Path) -> AbstractContextManager[str]:
    """Serve the files of a folder. Yields the URL."""
    return web_server(partial(FolderRequest, directory=str(folder)))
