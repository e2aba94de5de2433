# SPDX-License-Identifier: MIT
"""The number of files and connections that a process may have open."""

from __future__ import annotations

import sys
from contextlib import suppress

MOST = 2**16  # some container runtimes allow 2**30, and programs that walk through all descriptors then stand still


def raise_limit() -> int:
    """Raise this process's limit to what its user may have, at most MOST; return the limit. Children inherit it."""
    if sys.platform == "win32":
        return MOST
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = MOST if hard == resource.RLIM_INFINITY else min(hard, MOST)
    if soft != resource.RLIM_INFINITY and soft < allowed:
        with suppress(OSError, ValueError):  # macOS allows less than it says
            resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return MOST if soft == resource.RLIM_INFINITY else soft
