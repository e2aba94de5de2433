# SPDX-License-Identifier: MIT
"""Where Triton listens, with or without TLS, and the key for its restricted APIs."""

from __future__ import annotations

import random
import re
import secrets
import shlex
import socket
import stat
from collections import deque
from collections.abc import Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from itertools import count, islice
from pathlib import Path

from rfm.config import DEFAULT_HOST, ServeConfig
from rfm.serve.installation import ServerStartError
from rfm_client.contract.addresses import ListenAddress, check_authorities, check_certificate, in_url, is_loopback
from rfm_client.contract.checks import require
from rfm_client.contract.errors import InvalidValueError
from rfm_client.contract.triton import AUTHORIZATION, METADATA_PREFIX
from rfm_client.contract.wire import ADMIN_KEY_VARIABLE

VARIABLE = ADMIN_KEY_VARIABLE
HEADER = "rfm-admin-key"
MIN_CHARACTERS = 16
_RESTRICTED = "model-repository,logging,trace"
_RESTRICTIONS = {"HTTP": "http-restricted-api", "gRPC": "grpc-restricted-protocol"}  # tritonserver's options
_SCORING = "inference"  # the restricted API
_OF_CALLERS = _SCORING, "shared-memory"  # the APIs that callers use with the API key; health and names need none
NO_KEY, KEY, CERTIFICATE = "no key needed", "needs a key", "needs a client certificate"  # what a port's callers need
_RANDOM_BYTES = 32
_VISIBLE = re.compile("[!-~]*")  # characters that a header can carry unchanged


def new_key() -> str:
    """Return a new random key, as URL-safe text."""
    return secrets.token_urlsafe(_RANDOM_BYTES)


def take_key(file: Path | None, environment: MutableMapping[str, str]) -> str | None:
    """Return the admin key in ``file``, else the one in ``environment``, else None. Raises InvalidValueError.

    Removes the key from ``environment``, so that no child process inherits it.
    """
    given = environment.pop(VARIABLE, None)
    if file is not None:
        return read_key(file, "--admin-key-file")
    return None if given is None else _checked(given, VARIABLE)


def restrictions(key: str) -> list[str]:
    """Return tritonserver arguments that refuse administrative requests without ``key``."""
    return [f"--{option}={_RESTRICTED}:{HEADER}={key}" for option in _RESTRICTIONS.values()]


def callers_restrictions(key: str | None, given: Sequence[str]) -> list[str]:
    """Return tritonserver arguments that refuse callers without ``Authorization: Bearer KEY``. None: no key

    Raises InvalidValueError if ``given``, other arguments, restrict the same APIs: Triton takes one key for each.
    """
    if key is None:
        return []
    for option in _RESTRICTIONS.values():
        expected = f"no --{option} for {' or '.join(_OF_CALLERS)} beside it"
        require("--api-key-file", not _restricted(option, given) & {*_OF_CALLERS}, expected, "both: leave out one")
    return [f"--{option}={','.join(_OF_CALLERS)}:{AUTHORIZATION}=Bearer {key}" for option in _RESTRICTIONS.values()]


def _restricted(option: str, arguments: Sequence[str]) -> set[str]:
    """Return the APIs that the arguments restrict with this option, which Triton also takes abbreviated."""
    given = (each.partition("=") for each in arguments)
    apis = (value.partition(":")[0].split(",") for name, _, value in given if f"--{option}".startswith(name))
    return {api.strip() for each in apis for api in each}


def http_headers(key: str | None) -> Mapping[str, str]:
    """Return the HTTP headers for a restricted API."""
    return {} if key is None else {HEADER: key}


def grpc_metadata(key: str | None) -> Mapping[str, str]:
    """Return the gRPC metadata for a restricted API."""
    return {} if key is None else {f"{METADATA_PREFIX}{HEADER}": key}


def read_key(file: Path, option: str) -> str:
    """Return the key from a file with permissions as strict as PostgreSQL requires for a private key.

    Only the owner may read the file. If root owns it, the group may too: containers get secrets that way.
    Raises InvalidValueError, which names the option.
    """
    try:
        status = file.stat()
        require(option, stat.S_ISREG(status.st_mode), "a file", f"{file}, which is none")
        expected = 0o640 if status.st_uid == 0 else 0o600
        mode = stat.S_IMODE(status.st_mode)
        if mode & ~expected:
            where, remedy = f"{option}: {file}", f"chmod {expected:o} {shlex.quote(str(file))}"
            raise InvalidValueError.at(where, f"mode {expected:o} or less", f"{mode:o}", remedy)
        return _checked(file.read_text(), f"{option}: {file}")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "no text"
        raise InvalidValueError.at(option, f"a text file at {file}", reason) from None


def _checked(text: str, where: str) -> str:
    key = text.strip()
    require(where, len(key) >= MIN_CHARACTERS, f"at least {MIN_CHARACTERS} characters", len(key))
    require(where, bool(_VISIBLE.fullmatch(key)), "visible ASCII characters without spaces", "others")  # hides the key
    return key


PORTS = range(20_000, 32_000)  # below the ports that Linux assigns to outgoing connections
PORT_STEP = 20  # keeps the three defaults distinct
# Triton of NVIDIA's container 26.07; earlier versions have remote vulnerabilities: docs/guides/deploy.md, "Ports"
SECURITY_FLOOR = 2, 71
_given: deque[int] = deque(maxlen=256)  # ports handed out, whose servers may not listen yet


@dataclass(frozen=True)
class GrpcTls:
    """PEM files for gRPC with TLS. client_ca: authorities that sign client certificates; None: clients need none"""

    certificate: Path
    key: Path
    client_ca: Path | None = None

    def check(self) -> None:
        """Check the files. Raises ConfigError."""
        check_certificate(self.certificate, self.key, "grpc_certificate")
        if self.client_ca is not None:
            check_authorities(self.client_ca, "grpc_client_ca")

    def arguments(self) -> list[str]:
        """Return tritonserver arguments for gRPC with TLS."""
        files = [f"--grpc-server-cert={self.certificate}", f"--grpc-server-key={self.key}"]
        if self.client_ca is None:
            return ["--grpc-use-ssl=true", *files]
        return ["--grpc-use-ssl-mutual=true", *files, f"--grpc-root-cert={self.client_ca}"]


@dataclass(frozen=True)
class Endpoints:
    """Addresses of a server. grpc_tls: for gRPC only; Triton's HTTP has no TLS and then listens on 127.0.0.1"""

    host: str = DEFAULT_HOST
    http_port: int = 8000
    grpc_port: int = 8001
    metrics_port: int = 8002
    grpc_tls: GrpcTls | None = None

    @classmethod
    def of(cls, config: ServeConfig, gateway_port: int | None = None) -> Endpoints:
        """Return the configured endpoints.

        A Triton port that is None becomes Triton's default, plus 20 (repeatedly) if another setting uses that port.
        """
        named = {config.http_port, config.grpc_port, config.metrics_port, config.status_port, gateway_port}
        defaults = {"http_port": cls.http_port, "grpc_port": cls.grpc_port, "metrics_port": cls.metrics_port}
        ports = {
            name: getattr(config, name) or next(port for port in count(default, PORT_STEP) if port not in named)
            for name, default in defaults.items()
        }
        tls = None
        if config.grpc_certificate is not None and config.grpc_key is not None:
            tls = GrpcTls(config.grpc_certificate, config.grpc_key, config.grpc_client_ca)
        return cls(config.host, grpc_tls=tls, **ports)

    @classmethod
    def free(cls) -> Endpoints:
        """Return loopback endpoints on free ports."""
        http_port, grpc_port, metrics_port = free_ports(3)
        return cls(DEFAULT_HOST, http_port, grpc_port, metrics_port)

    @property
    def http_host(self) -> str:
        """Address that the HTTP port listens on."""
        return self.host if self.grpc_tls is None else DEFAULT_HOST

    @property
    def http_url(self) -> str:
        """Server URL for HTTP, for RewardClient."""
        return f"http://{in_url(self.http_host)}:{self.http_port}"

    @property
    def grpc_url(self) -> str:
        """Server URL for gRPC, for RewardClient."""
        return f"{'grpc' if self.grpc_tls is None else 'grpcs'}://{in_url(self.host)}:{self.grpc_port}"

    @property
    def metrics_url(self) -> str:
        """URL where Prometheus reads Triton's metrics."""
        return f"http://{in_url(self.host)}:{self.metrics_port}/metrics"

    def doors(self, more_arguments: Sequence[str] = ()) -> dict[str, tuple[str, str]]:
        """Return the URL of each port, and what callers need, by the port's name.

        more_arguments: further tritonserver arguments, which may restrict scoring
        """
        asks = dict.fromkeys(("gRPC", "HTTP", "metrics"), NO_KEY)
        if self.grpc_tls is not None and self.grpc_tls.client_ca is not None:
            asks["gRPC"] = CERTIFICATE
        for name, option in _RESTRICTIONS.items():
            if _SCORING in _restricted(option, more_arguments):
                asks[name] = KEY if asks[name] == NO_KEY else f"{asks[name]} and a key"
        urls = {"gRPC": self.grpc_url, "HTTP": self.http_url, "metrics": self.metrics_url}
        return {name: (url, asks[name]) for name, url in urls.items()}

    def arguments(self) -> list[str]:
        """Return tritonserver arguments for these addresses."""
        return [
            f"--http-address={_of_http_server(self.http_host)}",
            f"--http-port={self.http_port}",
            f"--grpc-address={in_url(self.host)}",
            f"--grpc-port={self.grpc_port}",
            f"--metrics-address={_of_http_server(self.host)}",
            f"--metrics-port={self.metrics_port}",
        ]

    def check(self) -> None:
        """Check ports, addresses and certificates. Raises ServerStartError."""
        listening = (
            ("HTTP", self.http_host, self.http_port),
            ("gRPC", self.host, self.grpc_port),
            ("metrics", self.host, self.metrics_port),
        )
        try:
            if self.grpc_tls is not None:
                self.grpc_tls.check()
            for name, host, port in listening:
                ListenAddress(host, port).check_free(name, port_option=f"--{name.lower()}-port")
        except InvalidValueError as error:
            raise ServerStartError.like(error) from None


def check_version(host: str, version: str, *, accepted: bool) -> None:
    """Raise ServerStartError for a vulnerable Triton that listens beyond loopback, unless ``accepted``."""
    match = re.match(r"(\d+)\.(\d+)", version)
    is_safe = match is not None and (int(match[1]), int(match[2])) >= SECURITY_FLOOR
    if is_safe or accepted or is_loopback(host):
        return
    floor = ".".join(map(str, SECURITY_FLOOR))
    expected = (
        f"a loopback address for Triton {version or 'of no version'}, which has known remote vulnerabilities (Triton "
        f"{floor}, in NVIDIA's container 26.07, has not)"
    )
    raise ServerStartError.at("host", expected, host, "--accept-known-vulnerabilities serves there all the same")


def free_ports(count: int) -> list[int]:
    """Return free loopback ports. Raises OSError if there are too few."""
    tried = random.SystemRandom().sample(PORTS, len(PORTS))
    ports = list(islice((port for port in tried if port not in _given and _is_free(port)), count))
    if len(ports) < count:
        raise OSError(f"ports: expected {count} free ones in {PORTS.start}..{PORTS.stop - 1}, got {len(ports)}")
    _given.extend(ports)
    return ports


def _is_free(port: int) -> bool:
    try:
        socket.create_server((DEFAULT_HOST, port)).close()
    except OSError:
        return False
    return True


def _of_http_server(host: str) -> str:
    """Return the address as Triton's HTTP servers expect it: IPv6 needs a prefix."""
    return f"ipv6:{host}" if ":" in host else host
