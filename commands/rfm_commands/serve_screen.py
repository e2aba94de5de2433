# SPDX-License-Identifier: MIT
"""What ``rfm serve`` shows in a terminal: where it listens, what it serves, what to try next. Triton logs to a file.

Without a terminal, as under systemd or in a container, all lines go to standard error.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import IO

from google.protobuf.text_format import ParseError

from rfm.serve.access import KEY, NO_KEY, Endpoints
from rfm.serve.repository import models_in
from rfm_client.cli.show import PAGE_PORT, PAGE_URL, command, next_steps, score_step
from rfm_client.contract.addresses import from_here, in_url
from rfm_client.contract.wire import frames_name
from rfm_commands.rollout import names_of
from rfm_export.publish import read_config
from rfm_gateway import GatewayConfig

LOG_FOLDER = Path(".local", "state", "rfm")  # in the home folder, as the XDG base directory specification says


def log_file(named: Path | None, http_port: int, environment: Mapping[str, str]) -> Path | None:
    """Return the file for Triton's lines; None: standard error, which is not a terminal.

    named: the user's choice; None: no choice
    """
    if named is not None or not sys.stderr.isatty():
        return named
    folder = environment.get("XDG_STATE_HOME")
    return (Path(folder, "rfm") if folder else Path.home() / LOG_FOLDER) / f"triton-{http_port}.log"


def opened(log: Path | None) -> AbstractContextManager[IO[bytes] | None]:
    """Return a context with the file, opened for appending. Raises OSError."""
    if log is None:
        return nullcontext()
    log.parent.mkdir(parents=True, exist_ok=True)
    return log.open("ab")


def doors(
    endpoints: Endpoints,
    more_arguments: Sequence[str],
    status_port: int | None,
    gateway: GatewayConfig | None,
    environment: Mapping[str, str],
) -> dict[str, tuple[str, str]]:
    """Return the URL of each port, and what callers need, by the port's name.

    more_arguments: further tritonserver arguments
    gateway: the gateway beside the server; None: no gateway
    """
    found = endpoints.doors(more_arguments)
    if status_port is not None:
        found["status"] = f"http://{in_url(endpoints.host)}:{status_port}/ready", NO_KEY
    if gateway is not None:
        url = gateway.address.url("http" if gateway.certificate is None else "https")
        name = "page" if gateway.viewer and find_spec("rfm_page") is not None else "gateway"
        found[name] = f"{url}/", NO_KEY if gateway.api_key(environment) is None else KEY
    return found


@dataclass
class ServeScreen:
    """The screen for one server.

    doors: as ``doors`` returns them
    log: file with Triton's lines
    key_file: file with the key that all ports ask for; None: none
    """

    repository: Path
    endpoints: Endpoints
    doors: Mapping[str, tuple[str, str]]
    log: Path
    key_file: Path | None = None
    _began_s: float = field(default_factory=time.monotonic)

    def show_start(self) -> None:
        """Say what is loading; nothing if there is no model, which the server reports."""
        if models := models_in(self.repository):
            self._show(f"loading {', '.join(models)} from {self.repository} ...")

    def show_ready(self) -> None:
        """Show the addresses, models and device, and what to try next."""
        rows = {
            "models": self._models(),
            **{name: f"{url} ({needs})" for name, (url, needs) in self.doors.items()},
            "log": f"{self.log} (lines of Triton and the models)",
        }
        lines = [f"  {name:9}{value}" for name, value in rows.items()]
        seconds = time.monotonic() - self._began_s
        self._show(f"ready after {seconds:.0f} s; Ctrl-C stops it", "", *lines, "", next_steps(*self._steps()), "")

    def _show(self, *lines: str) -> None:
        print("\n".join(["rfm serve: " + lines[0], *lines[1:]]), file=sys.stderr, flush=True)

    def _models(self) -> str:
        """Return each model with the versions that its file names, and the GPUs that all use, or the CPU."""
        shown, gpus = [], set[int]()
        for model in models_in(self.repository):
            words = [model]
            with suppress(OSError, ParseError):  # another program's; Triton has read it
                config = read_config(self.repository, model)
                words += map(str, config.version_policy.specific.versions)
                gpus.update(gpu for group in config.instance_group for gpu in group.gpus)
            shown.append(" ".join(words))
        device = f"GPU {', '.join(map(str, sorted(gpus)))}" if gpus else "the CPU"
        return f"{', '.join(shown)}, on {device}"

    def _steps(self) -> list[tuple[str, str]]:
        here, tls = replace(self.endpoints, host=from_here(self.endpoints.host)), self.endpoints.grpc_tls
        shown = [] if tls is None else ["--ca-file", "AUTHORITY.pem"]
        if tls is not None and tls.client_ca is not None:
            shown += ["--client-certificate", "CERTIFICATE.pem", "--client-key", "KEY.pem"]
        shown += [] if self.key_file is None else ["--api-key-file", str(self.key_file)]
        models = models_in(self.repository)
        scorers = [name for name in names_of(self.repository) if frames_name(name) in models]
        purpose, score = score_step(here.grpc_url, scorers, *shown)
        steps = [(f"in another terminal, {purpose}", score)]
        if not {"page", "gateway"} & self.doors.keys():
            again = command("rfm", "serve", self.repository, "--gateway-port", PAGE_PORT)
            steps.append((f"or serve it with the page at {PAGE_URL}", again))
        return steps
