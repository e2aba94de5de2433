# SPDX-License-Identifier: MIT
"""Which of tritonserver's options may be given to ``rfm serve`` behind ``--``: those that it does not depend on."""

from __future__ import annotations

import re
from collections.abc import Sequence

from rfm.supervise.installation import ServerStartError

# Beside those that are set: other names of them, and what would take away what a start waits for.
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
# May be given again, for other APIs: Triton refuses to start with two keys for one.
_REPEATED = {"--http-restricted-api", "--grpc-restricted-protocol"}
_ARGUMENT = re.compile(r"(--[a-z][a-z0-9-]+)=.*")


def check_arguments(more: Sequence[str], own: Sequence[str]) -> None:
    """Raises ServerStartError for one that ``own`` has, also if it is abbreviated, or that is no ``--option=value``."""
    kept = {argument.partition("=")[0] for argument in own} - _REPEATED | _KEPT
    for argument in more:
        match = _ARGUMENT.fullmatch(argument)
        if match is None:
            raise ServerStartError(f"tritonserver: expected --option=value, got {argument.partition('=')[0]}")
        if match[1] not in _REPEATED and any(option.startswith(match[1]) for option in kept):
            raise ServerStartError(f"tritonserver: expected an option that rfm serve leaves open, got {match[1]}")
