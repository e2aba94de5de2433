# SPDX-License-Identifier: MIT
"""One tritonserver process: started, ready, stopped, and nothing of it left behind."""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from types import FrameType, TracebackType
from typing import IO

import tritonclient.http
from tritonclient.utils import InferenceServerException

from rfm.config import DEFAULT_HOST, ServeConfig
from rfm.server.installation import Installation, ServerStartError

POLL_S = 0.1
EXIT_TIMEOUT_S = 10  # Triton waits this long for requests in flight, and for a stub that is dead
KILL_AFTER_S = 2 * EXIT_TIMEOUT_S
SHARED_MEMORY = Path("/dev/shm")
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(frozen=True)
class Endpoints:
    """Addresses of one server."""

    host: str = DEFAULT_HOST
    http_port: int = 8000
    grpc_port: int = 8001
    metrics_port: int = 8002

    @classmethod
    def of(cls, config: ServeConfig) -> Endpoints:
        """The endpoints that a configuration names."""
        return cls(config.host, config.server_port, config.grpc_port, config.metrics_port)

    @classmethod
    def free(cls) -> Endpoints:
        """Loopback endpoints on ports that are free now."""
        sockets = [socket.create_server((DEFAULT_HOST, 0)) for _ in range(3)]
        ports = [bound.getsockname()[1] for bound in sockets]
        for bound in sockets:
            bound.close()
        return cls(DEFAULT_HOST, *ports)

    @property
    def http_url(self) -> str:
        """For RewardClient, over HTTP."""
        return f"http://{self.host}:{self.http_port}"

    @property
    def grpc_url(self) -> str:
        """For RewardClient, over gRPC."""
        return f"grpc://{self.host}:{self.grpc_port}"

    @property
    def metrics_url(self) -> str:
        """What Prometheus scrapes."""
        return f"http://{self.host}:{self.metrics_port}/metrics"

    def check_free(self) -> None:
        """Raises ServerStartError for a port that is taken or an address that is not this machine's."""
        for name, port in (("HTTP", self.http_port), ("gRPC", self.grpc_port), ("metrics", self.metrics_port)):
            try:
                socket.create_server((self.host, port)).close()
            except (OSError, OverflowError) as error:
                expected = f"a free port of this machine at {self.host}:{port}"
                number = getattr(error, "errno", None)
                reason = os.strerror(number) if number and number > 0 else str(error)
                raise ServerStartError(f"{name}: expected {expected}, got: {reason}") from error


class TritonServer:
    """A tritonserver on ``repository`` with every model of it loaded. A context manager that stops it.

    http_threads: threads that read HTTP requests; None: Triton's choice
    log: where Triton's log goes; None: this process's standard output and error
    """

    def __init__(
        self,
        repository: Path,
        endpoints: Endpoints,
        installation: Installation,
        *,
        http_threads: int | None = None,
        log: IO[bytes] | None = None,
    ) -> None:
        self.endpoints = endpoints
        self._repository = repository
        self._installation = installation
        self._http_threads = http_threads
        self._log = log
        self._region_prefix = f"rfm_{os.getpid()}_{secrets.token_hex(4)}_"
        self._backends: Path | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._companion: subprocess.Popen[bytes] | None = None

    def run(self, companion: Sequence[str] | None = None) -> int:
        """Serves until the server ends or this process is told to (STOP_SIGNALS); gives Triton's exit status.

        companion: command line of a program that runs as long as the server is ready; if it ends, so does the server
        """
        told_to_stop = False

        def stop(number: int, _frame: FrameType | None) -> None:
            nonlocal told_to_stop
            told_to_stop = True
            if self._companion is not None:  # it answers what it has begun, and then the server is stopped
                self._companion.terminate()
            elif self._process is not None:
                self._process.send_signal(signal.SIGTERM if number == signal.SIGHUP else number)

        previous = {number: signal.signal(number, stop) for number in STOP_SIGNALS}
        try:
            self.start()
            if told_to_stop:  # before there was a process to pass it to
                return self.stop()
            self.wait_ready()
            if companion is None or told_to_stop:
                return self._wait()
            self._companion = subprocess.Popen(companion, stdin=subprocess.DEVNULL, start_new_session=True)
            return self._wait_with(self._companion, lambda: told_to_stop)
        except ServerStartError:
            status = self.stop()
            if told_to_stop:  # while it was still loading
                return status
            raise
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)

    def start(self) -> None:
        """Starts the process. Raises ServerStartError for what can be seen to be wrong before."""
        models = sorted(file.parent.name for file in self._repository.glob("*/config.pbtxt"))
        if not models:
            raise ServerStartError(f"repository: expected a folder of models, got {self._repository}")
        self.endpoints.check_free()
        self._backends = Path(tempfile.mkdtemp(prefix="rfm-backends-"))
        arguments = [*self._arguments(models), *self._installation.lay_out_backends(self._backends)]
        try:
            self._process = subprocess.Popen(
                [self._installation.executable, *arguments],
                env={**os.environ, **self._installation.environment},
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
                start_new_session=True,  # a Ctrl-C in the terminal reaches it once, through us
            )
        except OSError as error:
            self._clear()
            program = self._installation.executable
            raise ServerStartError(f"tritonserver: expected a program at {program}, got: {error.strerror}") from error

    def wait_ready(self) -> None:
        """Returns when every model is ready. Raises ServerStartError with the reason of one that is not."""
        assert self._process is not None  # started
        client = tritonclient.http.InferenceServerClient(f"{self.endpoints.host}:{self.endpoints.http_port}")
        try:
            while self._process.poll() is None:
                try:
                    index = client.get_model_repository_index()
                except (OSError, EOFError, HTTPException, InferenceServerException):
                    time.sleep(POLL_S)  # Triton answers nothing while it loads
                    continue
                failed = [model for model in index if model.get("state") != "READY"]
                if not failed:
                    return
                reasons = "; ".join(f"{m['name']}: {_one_line(m.get('reason', 'not loaded'))}" for m in failed)
                raise ServerStartError(f"models: expected all to be ready, got {reasons}")
            raise ServerStartError(f"tritonserver: expected to run, got exit status {self._process.returncode}")
        finally:
            client.close()

    def stop(self) -> int:
        """Ends the server gracefully, by force after KILL_AFTER_S, and gives its exit status (0 if it never ran)."""
        if self._process is None:
            return 0
        if self._process.poll() is None:
            self._process.terminate()
        try:
            self._process.wait(KILL_AFTER_S)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
        return self._wait()

    def __enter__(self) -> TritonServer:
        try:
            self.start()
            self.wait_ready()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stop()

    def _arguments(self, models: Sequence[str]) -> list[str]:
        endpoints = self.endpoints
        return [
            f"--model-repository={self._repository}",
            "--model-control-mode=explicit",
            *(f"--load-model={model}" for model in models),
            "--disable-auto-complete-config",
            "--strict-readiness=true",
            "--exit-on-error=false",  # so that the reason of each model that fails can be asked for
            f"--exit-timeout-secs={EXIT_TIMEOUT_S}",
            f"--http-address={endpoints.host}",
            f"--http-port={endpoints.http_port}",
            f"--grpc-address={endpoints.host}",
            f"--grpc-port={endpoints.grpc_port}",
            f"--metrics-address={endpoints.host}",
            f"--metrics-port={endpoints.metrics_port}",
            f"--backend-config=python,shm-region-prefix-name={self._region_prefix}",
            *([f"--http-thread-count={self._http_threads}"] if self._http_threads else []),
        ]

    def _wait_with(self, companion: subprocess.Popen[bytes], is_told_to_stop: Callable[[], bool]) -> int:
        """Waits for the server and its companion, and ends the one when the other has ended."""
        assert self._process is not None  # started
        try:
            while self._process.poll() is None and companion.poll() is None:
                time.sleep(POLL_S)
        finally:
            _end(companion)
        status = self.stop()
        if not is_told_to_stop() and companion.returncode not in (0, -signal.SIGTERM):
            raise ServerStartError(f"gateway: expected to run, got exit status {companion.returncode}")
        return status

    def _wait(self) -> int:
        """Waits for the server to end and clears away what it leaves; gives its exit status."""
        assert self._process is not None  # started
        status = self._process.wait()
        with suppress(ProcessLookupError):  # a stub that has outlived its server, which ran out of time to end it
            os.killpg(self._process.pid, signal.SIGKILL)
        self._clear()
        return status

    def _clear(self) -> None:
        if self._backends is not None:
            shutil.rmtree(self._backends, ignore_errors=True)
        for region in SHARED_MEMORY.glob(f"{self._region_prefix}*"):
            region.unlink(missing_ok=True)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Gracefully, by force after KILL_AFTER_S."""
    if process.poll() is None:
        process.terminate()
    try:
        process.wait(KILL_AFTER_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _one_line(reason: str) -> str:
    """What happened; the lines behind it are where."""
    lines = reason.strip().splitlines()
    return lines[0].strip() if lines else "unknown"
