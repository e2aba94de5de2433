# SPDX-License-Identifier: MIT
"""``rfm serve`` with the committed repository as a process, and its remains."""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from paths import ROOT
from rfm.serve.access import Endpoints
from rfm.serve.processes import REGION_PREFIX, SHARED_MEMORY

REPOSITORY = ROOT / "model_repository"
RFM = Path(sys.executable).parent / "rfm"
EXIT_S = 60
RUN = "RFM_TEST_RUN"
OWNER = re.compile(rf"{REGION_PREFIX}_(\d+)_")


def is_alive(pid: int) -> bool:
    """Return False for a zombie or an unknown id."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def command(repository: Path, endpoints: Endpoints) -> list[str]:
    ports = [f"--{name}-port={getattr(endpoints, f'{name}_port')}" for name in ("http", "grpc", "metrics")]
    return [str(RFM), "serve", "--repository", str(repository), *ports]


def in_shared_memory() -> set[str]:
    """Names in shared memory."""
    return {path.name for path in SHARED_MEMORY.iterdir()}


def regions() -> set[str]:
    """Return the names in shared memory, except those of other users' servers."""
    names = in_shared_memory()
    owners = {name: int(match[1]) for name in names if (match := OWNER.search(name))}
    return names - {name for name, pid in owners.items() if is_alive(pid) and not is_ours(pid)}


def own_regions(pid: int) -> set[Path]:
    """Return files in shared memory of servers that a process has started."""
    return set(SHARED_MEMORY.glob(f"{REGION_PREFIX}_{pid}_*"))


def running(words: str, most: int | None = None) -> set[int]:
    """Return ids of processes with these words in the command line, or in the first ``most`` words."""
    each = psutil.process_iter(["cmdline"])
    return {process.pid for process in each if words in " ".join((process.info["cmdline"] or [])[:most])}


def running_models(repository: Path, model: str) -> set[int]:
    """Return the ids of a model's processes below all servers of ``repository``."""
    links = SHARED_MEMORY.glob(f"{REGION_PREFIX}_*_links/models")
    served = [link for link in links if link.resolve() == repository.resolve()]
    return {pid for link in served for pid in running(f"{link}/{model}/", 2)}


def tritons() -> set[int]:
    """Return the ids of all tritonservers of this test run."""
    return {pid for pid in running("tritonserver", 1) if is_ours(pid)}


def is_ours(pid: int) -> bool:
    """True for this process and those that inherited the mark of conftest.py."""
    if pid == os.getpid():
        return True
    try:
        return f"{RUN}={os.environ[RUN]}" in Path("/proc", str(pid), "environ").read_text().split("\0")
    except (FileNotFoundError, PermissionError, ProcessLookupError):  # it has ended, or is another user's
        return False


@contextmanager
def nothing_left_behind() -> Iterator[None]:
    """Allow servers to start, and check that no process and no shared memory of this run is left."""
    tritons_before, left = tritons(), regions()
    yield
    left = regions() - left
    ends_s = time.monotonic() + EXIT_S
    while tritons() - tritons_before or left:  # a process that was killed, and other tests' regions, take a moment
        assert time.monotonic() < ends_s, (tritons() - tritons_before, left)
        time.sleep(0.02)
        left &= in_shared_memory()
