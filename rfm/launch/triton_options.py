# SPDX-License-Identifier: MIT
"""Options of tritonserver that users may add behind ``--``, and the largest HTTP request."""

from __future__ import annotations

import mmap
import re
from collections.abc import Sequence
from pathlib import Path

from rfm.launch.installation import Installation, ServerStartError

MAX_HTTP_BYTES = 256 * 2**20  # of a request's body; gRPC takes 2 GiB

# Also refused, besides the options that rfm serve sets: their aliases, and options that break a start.
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
    """Raise ServerStartError for an option of ``own``, also abbreviated, and for anything but ``--option=value``."""
    kept = {argument.partition("=")[0] for argument in own} - _REPEATED | _KEPT
    for argument in more:
        match = _ARGUMENT.fullmatch(argument)
        if match is None:
            raise ServerStartError.at("tritonserver", "--option=value", argument.partition("=")[0])
        if match[1] not in _REPEATED and any(option.startswith(match[1]) for option in kept):
            raise ServerStartError.at("tritonserver", "an option that rfm serve leaves open", match[1])


def size_limits(installation: Installation, given: Sequence[str]) -> list[str]:
    """Return the option that limits a request's size; empty if ``given`` has it, or tritonserver (2.51) lacks it."""
    if any(argument.startswith(f"--{_SIZE_OPTION}=") for argument in given):
        return []
    return [f"--{_SIZE_OPTION}={MAX_HTTP_BYTES}"] if _knows(installation.executable, _SIZE_OPTION) else []


def _knows(program: Path, option: str) -> bool:
    """True if the program file contains the option's name. ``--help`` would start Triton."""
    try:
        with program.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            return content.find(option.encode()) >= 0
    except (OSError, ValueError):  # unreadable or empty: the start gives the reason
        return False
