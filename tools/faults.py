# SPDX-License-Identifier: MIT
"""Faults that ``rfm serve`` must survive under load, with one ``make chaos`` row for each."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np
import psutil

import rfm_export
from callers import Callers, Exam, direct, through_gateway
from client_commands import RFM_CLIENT
from commands import is_alive
from paths import ROOT
from repositories import answering
from rfm.config import ExportConfig
from rfm.serve.repository import MODEL_FILE
from rfm.serve.supervisor import GATEWAY
from rfm_client import RewardClient
from rfm_client.contract.process import raise_limit
from servers import MODEL, RFM, START_S, Endpoints, Serving, children, serving, wait_for

CHECKPOINT = ROOT / "model_repository" / "rfm" / "1" / "checkpoint"
TRITON, OTHER = "triton", f"{MODEL}_b"
HEALED_S = 10.0  # from fault to readiness, without start time and fault detection time
CALLERS = 16
HANG_S = 10
SILENT_S = 10.0  # rfm serve's default
GONE_S = 5.0  # until all processes of a killed rfm serve have ended
IDLE = 1300  # connections; more than the usual descriptor limit, 1024
DIES = "import os\n\nos._exit(1)\n"
STILL_S = 20.0
SMALL, SMALL_PAUSE_S, FAIR_S = 10, 0.1, 8.0
LOOP_S = 120.0  # six or more Triton starts
MODEL_FAULTS = answering("""
    for fault in ("hang", "break"):  # once, by the instance that takes the file
        try:
            os.unlink(f"{folder}/{fault}.{name}")
        except FileNotFoundError:
            continue
        self.fault = fault
    if getattr(self, "fault", None) == "hang":
        time.sleep(3600)
    if getattr(self, "fault", None) == "break":
        raise RuntimeError("CUDA error: an illegal memory access was encountered")
    if os.path.exists(f"{folder}/die.{name}"):
        os._exit(1)
""")


@dataclass
class Row:
    """Call outcomes under one fault.

    healed_s: seconds from the fault to readiness
    may_lose: how many calls may fail
    may_break_off: True: calls may be refused, or lose their connection
    broken: messages about broken bounds
    """

    name: str
    calls: Callers | None = None
    healed_s: float | None = None
    told: str = ""
    may_lose: int = 0
    may_break_off: bool = False
    broken: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.calls is not None:
            lost, untold = self.calls.lost, self.calls.refused + self.calls.broken_off
            self.expect(len(lost) <= self.may_lose, f"{len(lost)} calls were lost, such as {lost[:1]}")
            self.expect(not self.calls.wrong, f"{self.calls.wrong} answers were wrong")
            self.expect(self.may_break_off or not untold, f"{untold} calls were refused or broken off")

    def expect(self, is_so: bool, otherwise: str) -> None:
        """Record a broken bound, with the message ``otherwise``, unless ``is_so``."""
        if not is_so:
            self.broken.append(otherwise)

    @property
    def cells(self) -> list[str]:
        counts = ["-"] * 6
        if (calls := self.calls) is not None:
            each = calls.asked, calls.answered, calls.refused, calls.broken_off, len(calls.lost), calls.wrong
            counts = list(map(str, each))
        return [self.name, *counts, "-" if self.healed_s is None else f"{self.healed_s:.1f}", self.told]


@dataclass(frozen=True)
class Site:
    """``rfm serve`` with a gateway, and the expected scores. start_s: seconds from start to readiness."""

    served: Serving
    gateway_url: str
    folder: Path
    start_s: float
    mixed: Exam
    progress: Exam

    @contextmanager
    def callers(self, count: int = CALLERS, *, url: str = "", pause_s: float = 0.0) -> Iterator[Callers]:
        """Call with the client's default settings and all sample types."""
        with (
            RewardClient(url or self.served.endpoints.grpc_url) as client,
            Callers(direct(client), self.mixed, count, pause_s) as callers,
        ):
            yield callers

    @contextmanager
    def gateway_callers(self, count: int = CALLERS // 2, *, pause_s: float = 0.0) -> Iterator[Callers]:
        """Call the gateway with progress samples in JSON."""
        with (
            httpx.Client(base_url=self.gateway_url, timeout=60) as session,
            Callers(through_gateway(session), self.progress, count, pause_s) as callers,
        ):
            yield callers

    def trigger(self, fault: str, model: str = MODEL) -> Path:
        """Create and return the file that makes ``model`` ``hang``, ``break`` or ``die``."""
        file = self.folder / f"{fault}.{model}"
        file.touch()
        return file

    def restarts(self, what: str) -> float:
        return self.served.metric("rfm_serve_restarts_total", what=what)

    def models(self, command: str, *words: str) -> None:
        """Run ``rfm models COMMAND``. Raises RuntimeError if it fails."""
        options = [f"--url={self.served.endpoints.grpc_url}", f"--admin-key-file={self.folder / 'key'}"]
        options += [] if command == "list" else [f"--repository={self.folder / 'model_repository'}"]
        line = [str(RFM), "models", command, *words, *options]
        done = subprocess.run(line, capture_output=True, text=True, timeout=180, check=False)
        if done.returncode:
            raise RuntimeError(f"rfm models {command}: {done.stderr}")

    @property
    def gateway(self) -> psutil.Process:
        (pid,) = children(self.served.process.pid, "python")
        return psutil.Process(pid)

    def wait_healthy(self) -> float:
        """Wait until the gateway is healthy; return the elapsed seconds."""

        def is_healthy() -> bool:
            with suppress(httpx.TransportError):
                return httpx.get(f"{self.gateway_url}/health").status_code == 200
            return False

        return wait_for(is_healthy)


@contextmanager
def site(folder: Path, export: Callable[[Path], object] | None = None) -> Iterator[Site]:
    """Start a server for one fault. A shared server would restart six times in a row, which counts as a crash loop."""
    folder.mkdir()
    repository, key_file, config = folder / "model_repository", folder / "key", folder / "serve.yaml"
    (export or (lambda repository: export_faulty(repository, folder)))(repository)
    key_file.touch(0o600)
    key_file.write_text("the-key-of-this-run")
    config.write_text(f"serve: {{hang_s: {HANG_S}}}\n")
    port = Endpoints.free().http_port
    options = f"--gateway-port={port}", f"--admin-key-file={key_file}", f"--config={config}"
    with serving(repository, *options) as served:
        start_s = served.wait_ready()
        exams = [Exam.of(CHECKPOINT, mixed=mixed) for mixed in (True, False)]
        made = Site(served, f"http://127.0.0.1:{port}", folder, start_s, *exams)
        made.wait_healthy()
        yield made


def export_faulty(repository: Path, folder: Path) -> None:
    """Export the demo's checkpoint as two models, with faults that files in ``folder`` trigger."""
    for name in (MODEL, OTHER):
        settings = ExportConfig(name=name, num_gpus=0, torch_threads=1, instances=2 - (name == OTHER))
        rfm_export.export(CHECKPOINT, repository, settings)
        with (repository / name / "1" / "model.py").open("a") as code:
            code.write(MODEL_FAULTS.replace("{folder}", str(folder)).replace("{name}", name))


def healed(
    name: str, fault: Callable[[Site], object], what: str, noticed_s: float = 0.0, may_lose: int = 0
) -> Callable[[Site], list[Row]]:
    """Return a test for a fault that must cause exactly one restart.

    what: the process or model that the supervisor blames
    noticed_s: seconds until the fault can be detected
    may_lose: how many calls may fail
    """

    def cause(site: Site) -> list[Row]:
        before = site.restarts(what)
        with site.callers() as callers:
            fault(site)
            healed_s = wait_for(lambda: site.restarts(what) > before) + site.served.wait_ready()
            callers.wait_for_all()
        row = Row(name, callers, healed_s, may_lose=may_lose)
        most_s = noticed_s + HEALED_S + site.start_s
        row.expect(healed_s <= most_s, f"healed after {healed_s:.1f} s; allowed: {most_s:.0f} s")
        row.expect(site.restarts(what) == before + 1, f"{site.restarts(what) - before:.0f} restarts")
        return [row]

    cause.__name__ = name
    return cause


def crash_loop(site: Site) -> list[Row]:
    """Let one of two models kill Triton repeatedly, until ``rfm serve`` ends. The next start serves both again."""
    trigger = site.trigger("die", OTHER)
    took_s = wait_for(lambda: site.served.process.poll() is not None, LOOP_S)
    trigger.unlink()
    with serving(site.folder / "model_repository") as again:
        start_s = again.wait_ready(within_s=START_S)
    row = Row("crash loop of one model of two", None, took_s, f"rfm serve ended; started again in {start_s:.1f} s")
    row.expect(site.served.process.returncode == 1, f"exit status {site.served.process.returncode}")
    return [row]


def healed_gateway(name: str, number: signal.Signals, noticed_s: float = 0.0) -> Callable[[Site], list[Row]]:
    """Return a test that sends the gateway a signal. Its callers lose their connection; Triton's are not affected.

    noticed_s: as in ``healed``
    """

    def cause(site: Site) -> list[Row]:
        process = site.gateway
        with site.callers(CALLERS // 2) as beside, site.gateway_callers() as callers:
            process.send_signal(number)
            healed_s = wait_for(lambda: not process.is_running()) + site.wait_healthy()
            callers.wait_for_all()
            beside.wait_for_all()
        row = Row(name, callers, healed_s, may_break_off=True)
        most_s = noticed_s + HEALED_S
        row.expect(healed_s <= most_s, f"healed after {healed_s:.1f} s; allowed: {most_s:g} s")
        return [row, Row("  callers beside it, over gRPC", beside)]

    cause.__name__ = name
    return cause


def stand_still(site: Site) -> list[Row]:
    """Stop all processes for a while, as a machine that stands still does."""
    serve = psutil.Process(site.served.process.pid)
    processes = [serve, *serve.children(recursive=True)]
    with site.callers() as callers, site.gateway_callers() as beside:
        for process in processes:
            process.suspend()
        time.sleep(STILL_S)
        for process in processes:
            process.resume()
        healed_s = site.served.wait_ready() + site.wait_healthy()
        callers.wait_for_all()
        beside.wait_for_all()
    restarts = {what: site.restarts(what) for what in (TRITON, MODEL, OTHER, GATEWAY)}
    told = ", ".join(f"{count:.0f} of {what}" for what, count in restarts.items() if count)
    row = Row(f"SIGSTOP of all processes for {STILL_S:g} s", callers, healed_s, f"restarts: {told or 'none'}")
    return [row, Row("  callers through the gateway", beside, may_break_off=True)]


def killed_in_rollout(what: str) -> Callable[[Site], list[Row]]:
    """Return a test that kills Triton, or a process of the served version, while a rollout loads the next version."""
    name = f"kill -9 of {'Triton' if what == TRITON else 'a model process'} in a rollout"

    def cause(site: Site) -> list[Row]:
        repository, before = site.folder / "model_repository", site.restarts(what)
        version = str(rfm_export.export(CHECKPOINT, repository, ExportConfig(num_gpus=0, torch_threads=1)))
        served = set(site.served.model_processes())
        with site.callers() as callers, ThreadPoolExecutor(1) as thread:
            rollout = thread.submit(site.models, "rollout", MODEL, version)
            wait_for(lambda: set(site.served.model_processes()) - served)
            os.kill(site.served.triton if what == TRITON else min(served), signal.SIGKILL)
            began_s = time.monotonic()
            told = "the rollout went back" if rollout.exception() else "the rollout went on"
            site.served.wait_ready()
            healed_s = time.monotonic() - began_s
            callers.wait_for_all()
        return [Row(name, callers, healed_s, f"{site.restarts(what) - before:.0f} restarts; {told}")]

    cause.__name__ = name
    return cause


def greedy(site: Site) -> list[Row]:
    """Let one client send thousands of samples at once beside callers that each send one sample ten times a second."""
    with site.callers(SMALL, pause_s=SMALL_PAUSE_S) as alone:
        time.sleep(FAIR_S)
    words = ["sample", "--num-samples", "10000", "--num-frames", "16", "--url", site.served.endpoints.grpc_url]
    with site.callers(SMALL, pause_s=SMALL_PAUSE_S) as beside:
        began_s = time.monotonic()
        done = subprocess.run([RFM_CLIENT, *words, "--json", site.folder / "greedy.json"], capture_output=True)
        took_s = time.monotonic() - began_s
    p99s = [1e3 * float(np.percentile(each.latencies_s, 99)) for each in (beside, alone)]
    row = Row(f"{SMALL} small callers beside a greedy one", beside)
    row.told = f"p99 {p99s[0]:.0f} ms, alone {p99s[1]:.0f} ms; 10,000 samples at once took {took_s:.1f} s"
    row.expect(done.returncode == 0, f"the greedy one: {done.stderr.decode()[-300:]}")
    return [row]


def kill_serve(site: Site) -> list[Row]:
    """Kill ``rfm serve`` itself. All processes it started end at once, and the next start removes leftovers."""
    processes = psutil.Process(site.served.process.pid).children(recursive=True)
    site.served.process.kill()
    healed_s = wait_for(lambda: not any(is_alive(process.pid) for process in processes))
    with serving(site.folder / "model_repository") as again:
        start_s = again.wait_ready()
    row = Row("kill -9 of rfm serve", None, healed_s, f"{len(processes)} processes ended; started in {start_s:.1f} s")
    row.expect(healed_s <= GONE_S, f"processes stayed for {healed_s:.1f} s; allowed: {GONE_S:g} s")
    return [row]


def dead_load(site: Site) -> list[Row]:
    """Roll out a version whose process dies before the handshake with Triton. Half-copied ones are not loaded."""
    repository = site.folder / "model_repository"
    version = str(rfm_export.export(CHECKPOINT, repository, ExportConfig(num_gpus=0, torch_threads=1)))
    (repository / MODEL / version / MODEL_FILE).write_text(DIES)
    before, began_s = site.restarts(MODEL), time.monotonic()
    with site.callers() as callers:
        with suppress(RuntimeError):
            site.models("rollout", MODEL, version)
            raise AssertionError("expected the rollout to fail")
        took_s = time.monotonic() - began_s
        site.served.wait_ready()
        callers.wait_for_all()
    told = f"the rollout failed after {took_s:.1f} s; {site.restarts(MODEL) - before:.0f} restarts"
    row = Row("rollout of a process that dies as it loads", callers, took_s, told)
    row.expect(took_s <= HEALED_S + 2 * site.start_s, f"the rollout took {took_s:.1f} s")
    return [row]


def idle_connections(site: Site) -> list[Row]:
    """Open IDLE connections to the gateway and to each Triton port, and leave them idle."""
    raise_limit()
    ends, gateway = site.served.endpoints, httpx.URL(site.gateway_url)
    ports = [gateway.port, ends.http_port, ends.grpc_port, ends.metrics_port]
    with ExitStack() as idle, site.callers(CALLERS // 2) as callers, site.gateway_callers() as beside:
        for port in ports:
            for _ in range(IDLE):
                idle.enter_context(socket.create_connection((gateway.host, port)))
        time.sleep(2 * SILENT_S)  # long enough for a restart
        callers.wait_for_all()
        beside.wait_for_all()
    row = Row(f"{IDLE} idle connections to each of {len(ports)} ports", callers)
    restarts = sum(map(site.restarts, (TRITON, MODEL, OTHER, GATEWAY)))
    row.expect(not restarts, f"{restarts:.0f} restarts")
    return [row, Row("  callers through the gateway", beside)]


def signalled(what: str, number: signal.Signals) -> Callable[[Site], None]:
    def send(site: Site) -> None:
        os.kill(site.served.triton if what == TRITON else site.served.model_processes()[0], number)

    return send


FAULTS: tuple[Callable[[Site], list[Row]], ...] = (
    healed("kill -9 of a model process", signalled(MODEL, signal.SIGKILL), MODEL),
    healed("SIGSTOP of a model process", signalled(MODEL, signal.SIGSTOP), MODEL),
    healed("kill -9 of Triton", signalled(TRITON, signal.SIGKILL), TRITON),
    healed("SIGSTOP of Triton", signalled(TRITON, signal.SIGSTOP), TRITON, noticed_s=SILENT_S),
    healed(f"a batch hangs (hang_s: {HANG_S})", lambda site: site.trigger("hang"), MODEL, noticed_s=1.1 * HANG_S),
    # Three failed batches in a row end the model process; callers in the first two get errors.
    healed("a broken context (simulated)", lambda site: site.trigger("break"), MODEL, may_lose=2 * CALLERS),
    healed_gateway("kill -9 of the gateway", signal.SIGKILL),
    healed_gateway("SIGSTOP of the gateway", signal.SIGSTOP, noticed_s=SILENT_S),
    stand_still,
    kill_serve,
    dead_load,
    killed_in_rollout(TRITON),
    killed_in_rollout(MODEL),
    greedy,
    idle_connections,
    crash_loop,
)
