# SPDX-License-Identifier: MIT
"""What stands between a server and those who can reach it: TLS, a limit of size, and which Triton may be reached."""

from __future__ import annotations

import mmap
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rfm.config import ServeConfig
from rfm.supervise.installation import WHEEL_VERSION, Installation, ServerStartError
from rfm_client.contract.addresses import check_authorities, check_certificate, is_loopback

# NVIDIA's container 26.07. Earlier ones can be crashed, or taken over, by whoever reaches them: docs/security.md
SECURITY_FLOOR = (2, 71)
MAX_HTTP_BYTES = 256 * 2**20  # of a request's body, as in the gateway; over gRPC Triton takes 2 GiB

_SIZE_OPTION = "http-max-input-size"
_VERSION = re.compile(r"(\d+)\.(\d+)")


@dataclass(frozen=True)
class GrpcTls:
    """Files (PEM) that Triton serves gRPC with. client_ca: who may vouch for clients, which then need a certificate"""

    certificate: Path
    key: Path
    client_ca: Path | None = None

    @classmethod
    def of(cls, config: ServeConfig) -> GrpcTls | None:
        """As the configuration names them; None: gRPC is served without TLS."""
        if config.grpc_certificate is None or config.grpc_key is None:
            return None
        client_ca = None if config.grpc_client_ca is None else Path(config.grpc_client_ca)
        return cls(Path(config.grpc_certificate), Path(config.grpc_key), client_ca)

    def check(self) -> None:
        """Raises ServerStartError for files that Triton could not serve with."""
        try:
            check_certificate(self.certificate, self.key, "grpc_certificate, grpc_key")
            if self.client_ca is not None:
                check_authorities(self.client_ca, "grpc_client_ca")
        except ValueError as error:
            raise ServerStartError(str(error)) from None

    def arguments(self) -> list[str]:
        """Of tritonserver."""
        files = [f"--grpc-server-cert={self.certificate}", f"--grpc-server-key={self.key}"]
        if self.client_ca is None:
            return ["--grpc-use-ssl=true", *files]
        return ["--grpc-use-ssl-mutual=true", *files, f"--grpc-root-cert={self.client_ca}"]


def size_limits(installation: Installation, given: Sequence[str]) -> list[str]:
    """Arguments of tritonserver, as far as it has such options (2.51 has none) and they are not ``given``."""
    if any(argument.startswith(f"--{_SIZE_OPTION}=") for argument in given):
        return []
    return [f"--{_SIZE_OPTION}={MAX_HTTP_BYTES}"] if _knows(installation.executable, _SIZE_OPTION) else []


def check_before_start(host: str, installation: Installation, *, accepted: bool) -> None:
    """As check_version, where the version can be known before anything listens."""
    if installation.wheel is not None:
        check_version(host, WHEEL_VERSION, accepted=accepted)


def check_version(host: str, version: str, *, accepted: bool) -> None:
    """Raises ServerStartError if others can reach a Triton with known vulnerabilities, unless that is ``accepted``."""
    match = _VERSION.match(version)
    is_safe = match is not None and (int(match[1]), int(match[2])) >= SECURITY_FLOOR
    if is_safe or accepted or is_loopback(host):
        return
    floor = ".".join(map(str, SECURITY_FLOOR))
    raise ServerStartError(
        f"host: expected a loopback address for Triton {version or 'of no version'}, which has known remote "
        f"vulnerabilities (Triton {floor}, in NVIDIA's container 26.07, has not), got {host}; "
        "--accept-known-vulnerabilities serves there all the same"
    )


def _knows(program: Path, option: str) -> bool:
    """Whether the option's name stands in the program: asking by --help would start it."""
    try:
        with program.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            return content.find(option.encode()) >= 0
    except (OSError, ValueError):  # it cannot be read, or is empty: starting it tells why
        return False
