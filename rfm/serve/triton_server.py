# SPDX-License-Identifier: MIT
"""Run a tritonserver process: start it, wait until it is ready, and stop it without a trace."""

from __future__ import annotations

import json
import mmap
import os
import re
import signal
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass, field
from http import HTTPStatus
from pathlib import Path
from types import FrameType
from typing import IO, Any, NoReturn
from urllib.parse import quote

from google.protobuf import text_format
from tritonclient.grpc.model_config_pb2 import ModelConfig

from rfm.parameters import DEFAULT_HANG_S, HANG_VARIABLE
from rfm.serve.access import Endpoints, check_version, http_headers, new_key, restrictions
from rfm.serve.installation import WHEEL_VERSION, Installation, ServerStartError, find_installation
from rfm.serve.probe import NO_ANSWER, Http
from rfm.serve.processes import (
    EXIT_TIMEOUT_S,
    NEEDS_ROOM,
    UNKNOWN,
    Claim,
    ModelProcesses,
    ProcessGroup,
    how_it_ended,
    stop_signals_to,
)
from rfm.serve.repository import CONFIG_FILE, check_models, models_in, no_models
from rfm.serve.repository_api import INDEX_PATH, versions_of

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
ANSWER_TIMEOUT_S = 10.0  # while the server starts
NO_BYTECODE = {"PYTHONDONTWRITEBYTECODE": "1"}  # else a version's folder changes, and a `load` reloads all versions
SECRET = re.compile("RFM_.*_KEY")  # variables withheld from Triton and the model processes
_REMEDIES = {  # by pattern in the reason why a model is not loaded
    "unsupported gpu id|KIND_GPU|compiled with CUDA|no NVIDIA driver": (
        "the models were exported for GPUs that this machine lacks: rfm export again here (--num-gpus 0: for the CPU)"
    ),
    "No space left on device": NEEDS_ROOM,
}
_DIED = "Stub process .* is not healthy"  # Triton's words for a process that died during a load
_REGIONS = "--backend-config=python,shm-region-prefix-name="
Config = Mapping[str, Any]  # a model's configuration in Triton's JSON


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
    accepts_known_vulnerabilities: bool = False
    more_arguments: Sequence[str] = ()

    def __post_init__(self) -> None:
        self.http = Http(self.endpoints.http_host, self.endpoints.http_port, http_headers(self.admin_key))
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
            raise ServerStartError.at(error.filename, "to be readable", error.strerror) from error

    def stop(self) -> None:
        """End the server gracefully, by force after KILL_AFTER_S."""
        if self._group is not None:
            self._group.end()
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
        """Start Triton with ``served``, or with all models if None, and wait until they are ready.

        If every model's file names the versions in ``served``, Triton starts with the models. Otherwise Triton starts
        without models, and then loads each with its configuration in ``served``.
        """
        there = self.models
        if not there:
            raise ServerStartError(no_models(self.repository))
        if len(str(self.repository).split()) > 1:  # Triton's Python backend passes the path to a shell unquoted
            expected = "a path without spaces, such as a link (ln -s)"
            raise ServerStartError.at("repository", expected, self.repository)
        as_in_file = there
        if served is not None:
            as_in_file = [name for name in served if _names_the_same_versions(self.repository, name, served[name])]
            if len(as_in_file) < len(served):  # an ensemble would load its parts from their files
                as_in_file = []
        if served is None:  # later, a file that cannot be read for a moment must not cost a model
            check_models(self.repository, there)
        self._start(sorted(as_in_file))
        self._wait_ready(as_in_file)
        others = {name: served[name] for name in served.keys() - set(as_in_file)} if served else {}
        for name in sorted(others, key=lambda name: "ensemble_scheduling" in others[name]):
            self._load(name, others[name])

    def _start(self, models: Sequence[str]) -> None:
        """Start the process with ``models``. Raises ServerStartError for wrong arguments, addresses or files."""
        own = self._arguments(models)
        check_arguments(self.more_arguments, [*own, _REGIONS])
        if self.installation.wheel is not None:
            check_version(self.endpoints.host, WHEEL_VERSION, accepted=self.accepts_known_vulnerabilities)
        self.endpoints.check()
        self._claim = Claim()
        arguments = [*own, f"{_REGIONS}{self._claim.region_prefix}"]
        arguments += self.installation.lay_out_backends(self._claim.backends)
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
        processes, ends_s = ModelProcesses(self.pid), time.monotonic() + LOAD_S
        while (status := self.exit_status) is None:
            try:
                version = self.http.json("/v2", ANSWER_TIMEOUT_S).get("version", "")
                index = self.http.json(INDEX_PATH, ANSWER_TIMEOUT_S, "POST")
            except NO_ANSWER:  # usual while Triton loads
                self._pause(processes, ends_s)
                continue
            failed = [entry for entry in versions_of(index) if not entry.is_ready and entry.name in models]
            if failed:
                reasons = "; ".join(f"{entry.name}: {entry.reason or 'not loaded'}" for entry in failed)
                raise _failed(f"expected all to be ready, got {reasons}{_remedy(reasons)}", failed[0].name)
            check_version(self.endpoints.host, version, accepted=self.accepts_known_vulnerabilities)
            return
        kind = SpoiltStartError if status == -signal.SIGABRT else ServerStartError
        raise kind(f"tritonserver: expected to run, got {how_it_ended(status)}")

    def _load(self, name: str, config: Config) -> None:
        """Load a model with this configuration, over HTTP: the gRPC port may require a certificate."""
        body = json.dumps({"parameters": {"config": json.dumps(config)}}).encode()
        path = f"/v2/repository/models/{quote(name, safe='')}/load"
        processes, ends_s = ModelProcesses(self.pid), time.monotonic() + LOAD_S
        with ThreadPoolExecutor(1, "rfm-load") as thread:
            answer = thread.submit(self.http.request, "POST", path, LOAD_S, body)
            while not answer.done():
                self._pause(processes, ends_s)
        try:
            status, text = answer.result()
        except NO_ANSWER as error:
            model = name if self.exit_status is None else None  # else Triton itself has ended
            raise ServerStartError(f"expected {name} to load, got: {error}", "models", model) from error
        if status != HTTPStatus.OK:
            raise _failed(f"expected {name} to load, got: {text}", name)

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
            f"--model-repository={self.repository}",
            "--model-control-mode=explicit",
            *(f"--load-model={model}" for model in models),
            "--disable-auto-complete-config",
            "--strict-readiness=false",  # else a failed version makes the whole server not ready
            "--exit-on-error=false",  # keeps the reason for each failed model readable
            f"--exit-timeout-secs={EXIT_TIMEOUT_S}",
            *self.endpoints.arguments(),
            *([f"--http-thread-count={self.http_threads}"] if self.http_threads else []),
            *restrictions(self.admin_key),
        ]

    def _environment(self) -> dict[str, str]:
        own = {name: value for name, value in os.environ.items() if not SECRET.fullmatch(name)}
        of_models = {HANG_VARIABLE: str(self.hang_s)}
        return {**short_spin(own), **own, **self.installation.environment, **NO_BYTECODE, **of_models}


def _failed(problem: str, model: str) -> ServerStartError:
    return (SpoiltStartError if re.search(_DIED, problem) else ServerStartError)(problem, "models", model)


def _remedy(reasons: str) -> str:
    return next((f"; {remedy}" for pattern, remedy in _REMEDIES.items() if re.search(pattern, reasons)), "")


def _names_the_same_versions(repository: Path, model: str, config: Config) -> bool:
    """True if the model's file names the same versions as ``config``, or no versions."""
    try:
        file = text_format.Parse((repository / model / CONFIG_FILE).read_text(), ModelConfig())
    except (OSError, UnicodeDecodeError, text_format.ParseError):
        return False
    if not file.version_policy.HasField("specific"):  # another program's model
        return True
    return bool(list(file.version_policy.specific.versions) == config["version_policy"]["specific"]["versions"])


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
