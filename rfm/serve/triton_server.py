# SPDX-License-Identifier: MIT
"""Run a tritonserver process: start it, wait until it is ready, and stop it without a trace."""

from __future__ import annotations

import errno
import mmap
import os
import re
import signal
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from types import FrameType
from typing import IO, NoReturn

from rfm.parameters import DEFAULT_HANG_S, HANG_VARIABLE
from rfm.serve.access import Endpoints, check_version, http_headers, new_key, restrictions
from rfm.serve.installation import WHEEL_VERSION, Installation, ServerStartError, find_installation
from rfm.serve.probe import NO_ANSWER, Http
from rfm.serve.processes import (
    NEEDS_ROOM,
    SHARED_MEMORY,
    UNKNOWN,
    Claim,
    ModelProcesses,
    ProcessGroup,
    how_it_ended,
    stop_signals_to,
)
from rfm.serve.repository import Config, check_models, models_in, no_models, stage
from rfm.serve.repository_api import INDEX_PATH, versions_of
from rfm_client.contract.triton import bearer_headers, over_http

MAX_HTTP_BYTES = 256 * 2**20  # for a request body; gRPC accepts 2 GiB
# Refused besides the options that rfm serve sets: their aliases, and options that break a start.
_KEPT = {
    "--model-store",
    "--backend-directory",
    "--http-thread-count",
    "--allow-http",
    "--allow-grpc",
    "--allow-metrics",
    "--reuse-http-port",
    "--reuse-grpc-port",
    "--grpc-use-ssl",
    "--grpc-use-ssl-mutual",
    "--grpc-server-cert",
    "--grpc-server-key",
    "--grpc-root-cert",
}
# Users may repeat these for other APIs. Triton refuses to start with two keys for the same API.
_REPEATED = {"--http-restricted-api", "--grpc-restricted-protocol"}
_SIZE_OPTION = "http-max-input-size"
_ARGUMENT = re.compile(r"(--[a-z][a-z0-9-]+)=.*")


def check_arguments(more: Sequence[str], own: Sequence[str]) -> None:
    """Raise ServerStartError for anything but ``--option=value``, and for options in ``own``, even abbreviated."""
    kept = {argument.partition("=")[0] for argument in own} - _REPEATED | _KEPT
    for argument in more:
        match = _ARGUMENT.fullmatch(argument)
        if match is None:
            raise ServerStartError.at("tritonserver", "--option=value", argument.partition("=")[0])
        if match[1] not in _REPEATED and any(option.startswith(match[1]) for option in kept):
            raise ServerStartError.at("tritonserver", "an option that rfm serve leaves open", match[1])


def size_limits(installation: Installation, given: Sequence[str]) -> list[str]:
    """Return the option that limits request size; empty if ``given`` has it, or tritonserver (2.51) lacks it."""
    if any(argument.startswith(f"--{_SIZE_OPTION}=") for argument in given):
        return []
    return [f"--{_SIZE_OPTION}={MAX_HTTP_BYTES}"] if _knows(installation.executable, _SIZE_OPTION) else []


def _knows(program: Path, option: str) -> bool:
    """True if the program file contains the option's name. Running ``--help`` would start Triton."""
    try:
        with program.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            return content.find(option.encode()) >= 0
    except (OSError, ValueError):  # unreadable or empty: the start reports the reason
        return False


POLL_S = 0.1
LOAD_S = 1800.0
STOP_S = 10.0  # for requests in flight; Triton also waits for open HTTP connections and dead model processes
_NEVER_S = 3600  # Triton's own limit for a stop, which must not expire: it ends without regard to its requests
ANSWER_TIMEOUT_S = 10.0  # while the server starts
SECRET = re.compile("RFM_.*_KEY")  # variables withheld from Triton and the model processes
_REMEDIES = {  # by pattern in the reason why a model is not loaded
    "unsupported gpu id|KIND_GPU|compiled with CUDA|no NVIDIA driver": (
        "the models were exported for GPUs that this machine lacks: rfm export again here (--num-gpus 0: for the CPU)"
    ),
    "No space left on device": NEEDS_ROOM,
}
_DIED = "Stub process .* is not healthy"  # Triton's words for a process that died during a load
_REPOSITORY = "--model-repository="
_REGIONS = "--backend-config=python,shm-region-prefix-name="


def short_spin(environment: Mapping[str, str]) -> dict[str, str]:
    """Return variables that limit OpenMP spinning to 0.1 ms; empty if the environment sets a limit.

    On a busy machine, libgomp's default of 3 ms makes a forward pass several times slower. On a quiet machine, no
    spinning makes it 1.5 times slower.
    """
    return {} if {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"} & environment.keys() else {"GOMP_SPINCOUNT": "10000"}


class SpoiltStartError(ServerStartError):
    """A model process died while it loaded. Triton reports it, ends, or hangs.

    Triton 2.51 also kills a model process when the machine stands still for a second.
    """


@dataclass(eq=False)
class TritonServer:
    """A tritonserver with all models in ``repository``. The context manager starts and stops it.

    The server ends with this process, however this process ends.

    http_threads: threads that read HTTP requests; None: Triton's choice
    hang_s: a model without progress for this long counts as hung; in a batch, its process ends itself
    log: file for Triton's log; None: warnings and errors go to this process's standard error
    admin_key: key for the restricted APIs; default: a new random key
    api_key: key that ``more_arguments`` ask of callers; None: none
    accepts_known_vulnerabilities: True: listen on any address, even with a vulnerable Triton
    more_arguments: further tritonserver arguments, such as ``--trace-config=...``
    """

    repository: Path
    endpoints: Endpoints
    installation: Installation
    _: KW_ONLY
    http_threads: int | None = None
    hang_s: int = DEFAULT_HANG_S
    log: IO[bytes] | None = None
    admin_key: str = field(default_factory=new_key, repr=False)
    api_key: str | None = field(default=None, repr=False)
    accepts_known_vulnerabilities: bool = False
    more_arguments: Sequence[str] = field(default=(), repr=False)  # may contain keys

    def __post_init__(self) -> None:
        headers = {**http_headers(self.admin_key), **(bearer_headers(self.api_key) if self.api_key else {})}
        self.http = Http(self.endpoints.http_host, self.endpoints.http_port, over_http(headers))
        self._claim: Claim | None = None
        self._signal: int | None = None  # the last signal sent
        self._group: ProcessGroup | None = None  # the newest

    @property
    def models(self) -> list[str]:
        """Model names in the repository."""
        return models_in(self.repository)

    @property
    def pid(self) -> int:
        """Process id of the newest tritonserver."""
        assert self._group is not None  # started
        return self._group.process.pid

    @property
    def exit_status(self) -> int | None:
        """Exit status of the process; None while it runs."""
        assert self._group is not None  # started
        return self._group.process.poll()

    def signal(self, number: int) -> None:
        """Send a signal to the process, now or as soon as it starts."""
        self._signal = number
        if self._group is not None:
            self._group.process.send_signal(number)

    def kill(self) -> None:
        """Kill the process and its children."""
        assert self._group is not None  # started
        self._group.kill()

    def start_ready(self, served: Mapping[str, Config] | None = None) -> None:
        """Start the process and wait until every model is ready. Repeat a spoilt start once, unless it is a restart.

        served: for a restart, configurations of the models to serve, which may name other versions than the model files
            do; None: all models, as in their files

        Raises ServerStartError.
        """
        try:
            try:
                self._start_ready(served)
            except SpoiltStartError:
                if self._signal is not None or served is not None:  # it is to end, or its caller repeats it
                    raise
                self.stop()
                self._start_ready(served)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise ServerStartError.at(
                    SHARED_MEMORY, "room for a server's files", error.strerror, NEEDS_ROOM
                ) from error
            raise ServerStartError.at(error.filename, "to be readable", error.strerror) from error

    def stop(self) -> None:
        """End the server gracefully, by force after STOP_S."""
        if self._group is not None:
            self._group.end(STOP_S)
        if self._claim is not None:
            self._claim.release()
            self._claim = None

    def __enter__(self) -> TritonServer:
        try:
            self.start_ready()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _start_ready(self, served: Mapping[str, Config] | None) -> None:
        """Start Triton with ``served``, or with all models if None, and wait until they are ready."""
        there = self.models
        if not there:
            raise ServerStartError(no_models(self.repository))
        if served is None:  # later, a file that cannot be read for a moment must not cost a model
            check_models(self.repository, there)
        models = sorted(there if served is None else served)
        self._start(models, served)
        self._wait_ready(models)

    def _start(self, models: Sequence[str], served: Mapping[str, Config] | None) -> None:
        """Start the process with ``models``. Raises ServerStartError for wrong arguments, addresses or files."""
        own = self._arguments(models)
        check_arguments(self.more_arguments, [*own, _REPOSITORY, _REGIONS])
        if self.installation.wheel is not None:
            check_version(self.endpoints.host, WHEEL_VERSION, accepted=self.accepts_known_vulnerabilities)
        self.endpoints.check()
        self._claim = Claim()
        staged = self.repository if served is None else stage(self.repository, served, self._claim.folder / "staged")
        self._claim.show(staged)
        arguments = [*own, f"{_REPOSITORY}{self._claim.models}", f"{_REGIONS}{self._claim.region_prefix}"]
        arguments += self.installation.lay_out_backends(self._claim.folder / "backends")
        arguments += self.endpoints.grpc_tls.arguments() if self.endpoints.grpc_tls else []
        if self.log is None and not any(each.startswith("--log-") for each in self.more_arguments):
            arguments += ["--log-info=false"]
        arguments += [*size_limits(self.installation, self.more_arguments), *self.more_arguments]
        program = self.installation.executable
        try:
            self._group = ProcessGroup(
                [program, *arguments],
                env=self._environment(),
                stdout=self.log,
                stderr=self.log,
                pass_fds=[self._claim.lock_file],
            )
        except OSError as error:
            self._claim.release()
            self._claim = None
            raise ServerStartError.at("tritonserver", f"a program at {program}", error.strerror) from error
        if self._signal is not None:
            self._group.process.send_signal(self._signal)

    def _wait_ready(self, models: Collection[str]) -> None:
        """Wait until ``models`` are ready. Raises ServerStartError with the reason for each failed model."""
        assert self._claim is not None  # started
        processes, ends_s = ModelProcesses(self.pid), time.monotonic() + LOAD_S
        while (status := self.exit_status) is None:
            if processes.has_found_any:  # Triton has read all configurations; from now on it reads those in the files
                self._claim.show(self.repository)
            try:
                version = self.http.json("/v2", ANSWER_TIMEOUT_S).get("version", "")
                index = versions_of(self.http.json(INDEX_PATH, ANSWER_TIMEOUT_S, "POST"))
            except NO_ANSWER:  # usual while Triton loads
                self._pause(processes, ends_s)
                continue
            failed = [entry for entry in index if entry.has_failed and entry.name in models]
            if failed:
                reasons = "; ".join(f"{entry.name}: {entry.reason or 'not loaded'}" for entry in failed)
                reasons = reasons.replace(str(self._claim.models), str(self.repository))
                raise _failed(f"expected all to be ready, got {reasons}{_remedy(reasons)}", failed[0].name)
            check_version(self.endpoints.host, version, accepted=self.accepts_known_vulnerabilities)
            self._claim.show(self.repository)
            return
        kind = SpoiltStartError if status == -signal.SIGABRT else ServerStartError
        raise kind(f"tritonserver: expected to run, got {how_it_ended(status)}")

    def _pause(self, processes: ModelProcesses, ends_s: float) -> None:
        """Wait for POLL_S. Kill Triton and raise SpoiltStartError if a model process is dead, or after ``ends_s``."""
        found = processes.fault()
        if found is None and time.monotonic() < ends_s:
            time.sleep(POLL_S)
            return
        self.kill()
        model, why = found or (UNKNOWN, f"no answer in {LOAD_S:g} s")
        raise SpoiltStartError(f"expected {model or 'each'} to load, got: {why}", "models", model or None)

    def _arguments(self, models: Sequence[str]) -> list[str]:
        return [
            "--model-control-mode=explicit",
            *(f"--load-model={model}" for model in models),
            "--disable-auto-complete-config",
            "--strict-readiness=false",  # else a failed version makes the whole server not ready
            "--exit-on-error=false",  # keeps the reason for each failed model readable
            f"--exit-timeout-secs={_NEVER_S}",
            *self.endpoints.arguments(),
            *([f"--http-thread-count={self.http_threads}"] if self.http_threads else []),
            *restrictions(self.admin_key),
        ]

    def _environment(self) -> dict[str, str]:
        own = {name: value for name, value in os.environ.items() if not SECRET.fullmatch(name)}
        # No bytecode, even if a copy of the repository has lost NO_BYTECODE. Triton's stubs for some Pythons ignore it.
        of_models = {HANG_VARIABLE: str(self.hang_s), "PYTHONDONTWRITEBYTECODE": "1"}
        return {**short_spin(own), **own, **self.installation.environment, **of_models}


def _failed(problem: str, model: str) -> ServerStartError:
    return (SpoiltStartError if re.search(_DIED, problem) else ServerStartError)(problem, "models", model)


def _remedy(reasons: str) -> str:
    return next((f"; {remedy}" for pattern, remedy in _REMEDIES.items() if re.search(pattern, reasons)), "")


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Context manager in which a stop signal raises SystemExit, so that inner contexts clean up."""

    def leave(number: int, _frame: FrameType | None) -> NoReturn:
        raise SystemExit(128 + number)

    with stop_signals_to(leave):
        yield


@contextmanager
def temporary_server(repository: Path, log: Path, tritonserver: Path | None = None) -> Iterator[Endpoints]:
    """Context manager with a server on free ports that logs to a file. Raises ServerStartError."""
    log.parent.mkdir(parents=True, exist_ok=True)
    installation = find_installation(tritonserver)
    with (
        log.open("wb") as lines,
        TritonServer(repository, Endpoints.free(), installation, log=lines) as server,
    ):
        yield server.endpoints
