# SPDX-License-Identifier: MIT
"""Keep other users out of the memory that a model process shares with Triton."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

_REGION = re.compile(r"/dev/shm/[^/\s]+$", re.MULTILINE)


def close_to_other_users() -> None:
    """Give the shared memory of this process the mode 0600. Triton creates it with 0644, whatever the umask says."""
    for region in {*_REGION.findall(Path("/proc/self/maps").read_text())}:
        with suppress(OSError):  # of another user
            Path(region).chmod(0o600)
