# SPDX-License-Identifier: MIT
"""What ``make chaos`` breaks: the demo's checkpoint behind ``rfm serve`` and its gateway; and what it reports."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx

import rfm_export
from callers import Callers, Connect, Exam, Tally, direct, mixed_samples, progress_samples
from paths import ROOT
from rfm.config import ExportConfig
from rfm.launch.process import Endpoints
from rfm_serve import Serving, serving, wait_for

CHECKPOINT = ROOT / "model_repository" / "rfm" / "1" / "checkpoint"
BACK_S = 10.0  # from a fault to readiness, beside what a start takes
CALLERS = 16
KEY = "the-key-of-this-run"


@dataclass
class Row:
    """What became of the calls of one scenario.

    broken_off: calls whose connection ended; recovery_s: to readiness; told: what else there is to say
    """

    name: str
    asked: int = 0
    answered: int = 0
    refused: int = 0
    broken_off: int = 0
    lost: int = 0
    wrong: int = 0
    recovery_s: float | None = None
    told: str = ""
    broken: list[str] = field(default_factory=list)

    @classmethod
    def of(
        cls, name: str, tally: Tally, recovery_s: float | None = None, told: str = "", *, breaks_off: bool = False
    ) -> Row:
        """From what was counted. Every call must be accounted for, none lost or (unless told so) broken off or wrong."""
        counts = tally.asked, tally.answered, tally.refused, tally.broken_off, len(tally.lost), tally.wrong
        row = cls(name, *counts, recovery_s, told)
        row.expect(tally.lost == [], f"{row.lost} calls were lost, such as {tally.lost[:1]}")
        row.expect(breaks_off or tally.broken_off == 0, f"{tally.broken_off} calls were broken off")
        row.expect(tally.wrong == 0, f"{tally.wrong} answers were wrong")
        row.expect(tally.asked == sum(counts[1:-1]), "calls are not accounted for")
        return row

    def expect(self, is_so: bool, otherwise: str) -> None:
        """Notes a bound that was broken."""
        if not is_so:
            self.broken.append(otherwise)

    @property
    def cells(self) -> list[str]:
        """Of the table."""
        recovery = "-" if self.recovery_s is None else f"{self.recovery_s:.1f}"
        return [
            self.name,
            *map(str, (self.asked, self.answered, self.refused, self.broken_off, self.lost, self.wrong)),
            recovery,
            self.told,
        ]


@dataclass(frozen=True)
class Site:
    """What is served, and to whom. start_s: what ``rfm serve`` took to be ready, most of which is loading the model"""

    served: Serving
    gateway_url: str
    checkpoint: Path
    repository: Path
    key_file: Path
    start_s: float
    mixed: Exam
    progress: Exam

    @property
    def direct(self) -> Connect:
        """The client as it is by default."""
        return direct(self.served.endpoints.grpc_url)

    def callers(self, count: int = CALLERS) -> Callers:
        """With the client as it is by default, about samples of all types."""
        return Callers(self.direct, self.mixed, count)


def wait_healthy(gateway_url: str, within_s: float = 60.0) -> float:
    """Seconds until the gateway says that it is healthy."""

    def is_healthy() -> bool:
        try:
            return httpx.get(f"{gateway_url}/health").status_code == 200
        except httpx.TransportError:
            return False

    return wait_for(is_healthy, within_s)


@contextmanager
def site(folder: Path, checkpoint: Path = CHECKPOINT, **settings: int) -> Iterator[Site]:
    """``rfm serve`` with a gateway, on a checkpoint exported with these settings."""
    repository, key_file = folder / "model_repository", folder / "key"
    rfm_export.export(checkpoint, repository, ExportConfig(num_gpus=0, torch_threads=1, **settings))
    key_file.touch(0o600)
    key_file.write_text(KEY)
    port = Endpoints.free().http_port
    started_s = time.monotonic()
    with serving(repository, f"--gateway-port={port}", f"--admin-key-file={key_file}") as served:
        served.wait_ready()
        start_s = time.monotonic() - started_s
        mixed, progress = (Exam.of(checkpoint, samples) for samples in (mixed_samples(), progress_samples()))
        url = f"http://127.0.0.1:{port}"
        found = Site(served, url, checkpoint, repository, key_file, start_s, mixed, progress)
        wait_healthy(url)
        yield found
