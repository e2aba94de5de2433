# SPDX-License-Identifier: MIT
"""What ``make chaos`` breaks: the demo's checkpoint, twice, behind ``rfm serve`` and its gateway; and what it reports."""

from __future__ import annotations

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
from rfm_serve import MODEL, Serving, serving, wait_for

CHECKPOINT = ROOT / "model_repository" / "rfm" / "1" / "checkpoint"
OTHER = f"{MODEL}_b"
HEALED_S = 10.0  # from a fault to readiness, beside what a start takes, and the time until the fault can be noticed
CALLERS = 16
HANG_S = 10
KEY = "the-key-of-this-run"
_FAULTY = """

_answer = TritonPythonModel.answer


def answer(self, questions, execution):
    import os, time

    for fault in ("hang", "break"):  # once, by the instance that takes the file
        try:
            os.unlink(f"{folder}/{fault}.{name}")
        except FileNotFoundError:
            continue
        self.fault = fault
    fault = getattr(self, "fault", None)
    if fault == "hang":
        time.sleep(3600)
    if fault == "break":
        raise RuntimeError("CUDA error: an illegal memory access was encountered")
    if os.path.exists(f"{folder}/die.{name}"):
        os._exit(1)
    return _answer(self, questions, execution)


TritonPythonModel.answer = answer
"""


@dataclass
class Row:
    """What became of the calls of one scenario.

    broken_off: calls whose connection ended; healed_s: to readiness; told: what else there is to say
    """

    name: str
    asked: int = 0
    answered: int = 0
    refused: int = 0
    broken_off: int = 0
    lost: int = 0
    wrong: int = 0
    healed_s: float | None = None
    told: str = ""
    broken: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, name: str, tally: Tally, healed_s: float | None = None, told: str = "", *, may_lose: int = 0) -> Row:
        """From what was counted. Every call must be accounted for, none wrong, and no more than ``may_lose`` lost."""
        counts = tally.asked, tally.answered, tally.refused, tally.broken_off, len(tally.lost), tally.wrong
        row = cls(name, *counts, healed_s, told)
        row.expect(row.lost <= may_lose, f"{row.lost} calls were lost, such as {tally.lost[:1]}")
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
        healed = "-" if self.healed_s is None else f"{self.healed_s:.1f}"
        return [
            self.name,
            *map(str, (self.asked, self.answered, self.refused, self.broken_off, self.lost, self.wrong)),
            healed,
            self.told,
        ]


@dataclass(frozen=True)
class Site:
    """What is served, and to whom. start_s: what ``rfm serve`` took to be ready"""

    served: Serving
    gateway_url: str
    folder: Path
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

    def trigger(self, fault: str, model: str = MODEL) -> Path:
        """A file with which ``model`` begins to ``hang``, ``break`` or ``die``."""
        file = self.folder / f"{fault}.{model}"
        file.touch()
        return file

    def restarts(self, what: str) -> float:
        """How many there were because of ``what``."""
        return self.served.metric("rfm_serve_restarts_total", what=what)


def wait_healthy(gateway_url: str, within_s: float = 60.0) -> float:
    """Seconds until the gateway says that it is healthy."""

    def is_healthy() -> bool:
        try:
            return httpx.get(f"{gateway_url}/health").status_code == 200
        except httpx.TransportError:
            return False

    return wait_for(is_healthy, within_s)


@contextmanager
def site(folder: Path) -> Iterator[Site]:
    """``rfm serve`` with a gateway and two models."""
    folder.mkdir()
    repository, key_file, config = folder / "model_repository", folder / "key", folder / "serve.yaml"
    for name in (MODEL, OTHER):
        rfm_export.export(
            CHECKPOINT, repository, ExportConfig(name=name, num_gpus=0, torch_threads=1, instances=2 - (name == OTHER))
        )
        with (repository / name / "1" / "model.py").open("a") as code:
            code.write(_FAULTY.replace("{folder}", str(folder)).replace("{name}", name))
    key_file.touch(0o600)
    key_file.write_text(KEY)
    config.write_text(f"hang_s: {HANG_S}\n")
    port = Endpoints.free().http_port
    with serving(repository, f"--gateway-port={port}", f"--admin-key-file={key_file}", f"--config={config}") as served:
        start_s = served.wait_ready()
        mixed, progress = (Exam.of(CHECKPOINT, samples) for samples in (mixed_samples(), progress_samples()))
        url = f"http://127.0.0.1:{port}"
        wait_healthy(url)
        yield Site(served, url, folder, start_s, mixed, progress)
