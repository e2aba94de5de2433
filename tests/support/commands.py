# SPDX-License-Identifier: MIT
"""``rfm serve`` of the committed repository as a process."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from paths import ROOT
from rfm.supervise.process import Endpoints
from rfm.supervise.stubs import SHARED_MEMORY
from rfm_client import RewardClient

REPOSITORY = ROOT / "model_repository"


RFM = Path(sys.executable).parent / "rfm"


EXIT_S = 60


def command(repository: Path, endpoints: Endpoints) -> list[str]:
    ports = {
        "--http-port": endpoints.http_port,
        "--grpc-port": endpoints.grpc_port,
        "--metrics-port": endpoints.metrics_port,
    }
    return [str(RFM), "serve", "--repository", str(repository), *(str(word) for pair in ports.items() for word in pair)]


def regions() -> set[str]:
    return {path.name for path in SHARED_MEMORY.iterdir()}


def tritons() -> set[int]:
    """Process ids of every tritonserver on this machine."""
    found = set()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if "tritonserver" in (folder / "cmdline").read_text().split("\0")[0]:
                found.add(int(folder.name))
        except (FileNotFoundError, ProcessLookupError):  # it ended meanwhile
            continue
    return found


@contextmanager
def nothing_left_behind() -> Iterator[None]:
    regions_before, tritons_before = regions(), tritons()
    yield
    assert regions() <= regions_before
    assert tritons() <= tritons_before


def wait_for_http(process: subprocess.Popen[Any], endpoints: Endpoints) -> None:
    with RewardClient(endpoints.http_url) as client:
        while not client.is_ready():
            assert process.poll() is None, process.communicate()
