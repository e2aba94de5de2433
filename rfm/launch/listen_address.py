# SPDX-License-Identifier: MIT
"""Which Triton may listen where others can reach it."""

from __future__ import annotations

import re

from rfm.launch.installation import WHEEL_VERSION, Installation, ServerStartError
from rfm_client.contract.addresses import is_loopback

# NVIDIA's container 26.07. Earlier ones can be crashed, or taken over, by whoever reaches them: docs/security.md
SECURITY_FLOOR = (2, 71)

_VERSION = re.compile(r"(\d+)\.(\d+)")


def check_before_start(host: str, installation: Installation, *, accepted: bool) -> None:
    """Checks the version as check_version does, where it is known before the server starts."""
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
