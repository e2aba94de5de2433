# SPDX-License-Identifier: MIT
"""The servers that are measured side by side, each with callers in a process of their own, and the bare engine."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from load import SHARED_MEMORY, Load, Measured, samples

from rfm.engine import Engine
from rfm.launch.process import Endpoints
from rfm.launch.temporary import temporary_server
from rfm.rewind.encoders import Encoders
from rfm_gateway.command import gateway_command
from rfm_gateway.config import GatewayConfig

PEER_SCRIPTS = {"FastAPI": "fastapi_server.py", "LitServe": "litserve_server.py", "mosec": "mosec_server.py"}
START_S = 120
WARM_UPS = 3  # as callers of a server ask three times before the clock starts
HERE = Path(__file__).parent


@dataclass(frozen=True)
class Checkpoint:
    """name: of its size; folder: the checkpoint; repository: it, exported; encoders: folders of its two, if any

    instances: model processes of every server but FastAPI's; threads: of torch, of each
    """

    name: str
    folder: Path
    repository: Path
    instances: int
    threads: int
    encoders: tuple[Path, Path] | None = None


class Callers:
    """A process of callers of one server."""

    def __init__(self, way: str, url: str, widths: tuple[int, int]) -> None:
        words = [sys.executable, str(HERE / "load.py"), way, url, *map(str, widths)]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

    def measure(self, load: Load) -> Measured:
        """Raises RuntimeError if the process ends."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(asdict(load)) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"callers: expected an answer, got exit status {self._process.wait()}")
        return Measured(**json.loads(line))

    def close(self) -> None:
        """Ends the process."""
        self._process.communicate()


class BareEngine:
    """``Engine.evaluate`` in this process: what no server around it can beat."""

    def __init__(self, checkpoint: Checkpoint) -> None:
        encoders = Encoders.from_pretrained(*checkpoint.encoders) if checkpoint.encoders else None
        self.engine = Engine.from_checkpoint(checkpoint.folder, encoders=encoders)
        config = self.engine.predictor.network.config
        self.widths = config.video_feature_dim, config.text_feature_dim

    def measure(self, load: Load, batch_size: int, pause_s: float = 0.0) -> Measured:
        """One batch after the other, of the load's samples.

        pause_s: between two batches, as a server has them while a lone caller's requests and answers are on their way
        """
        asked = samples(load, *self.widths)
        for _ in range(WARM_UPS):
            self.engine.evaluate([asked[i % len(asked)] for i in range(batch_size)])
        latencies_s = []
        start, started_s = 0, time.perf_counter()
        while time.perf_counter() - started_s < load.seconds:
            batch = [asked[(start + i) % len(asked)] for i in range(batch_size)]
            start += batch_size
            before_s = time.perf_counter()
            self.engine.evaluate(batch)
            latencies_s.append(time.perf_counter() - before_s)
            time.sleep(pause_s)
        took_s = time.perf_counter() - started_s
        rate = len(latencies_s) * batch_size / took_s
        in_order = sorted(latencies_s)
        p50_s, p99_s = in_order[len(in_order) // 2], in_order[int(len(in_order) * 0.99)]
        return Measured(rate, 0, p50_s * 1e3, p99_s * 1e3, took_s)


@contextmanager
def contestants(
    checkpoint: Checkpoint, widths: tuple[int, int], peers: Sequence[str], log_folder: Path
) -> Iterator[Mapping[str, Callers]]:
    """Callers by name, of this server over each of its ways and of the peers, all of the same checkpoint."""
    log_folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        endpoints = stack.enter_context(
            temporary_server(checkpoint.repository, log_folder / f"triton_{checkpoint.name}.log")
        )
        gateway_port = Endpoints.free().http_port
        config = GatewayConfig(gateway_port, triton=endpoints.grpc_url, metrics_url=endpoints.metrics_url)
        gateway = gateway_command(config)
        stack.enter_context(_running(gateway, gateway_port, log_folder / f"gateway_{checkpoint.name}.log"))
        urls = {
            "gRPC": endpoints.grpc_url,
            "HTTP": endpoints.http_url,
            SHARED_MEMORY: endpoints.grpc_url,
            "gateway": f"http://127.0.0.1:{gateway_port}",
        }
        for peer in peers:
            options = {"checkpoint": checkpoint.folder, **_processes(peer, checkpoint)}
            log = log_folder / f"{peer}_{checkpoint.name}.log"
            port = stack.enter_context(running_peer(PEER_SCRIPTS[peer], options, log))
            ways = ["FastAPI, JSON", "FastAPI, npy"] if peer == "FastAPI" else [peer]
            urls |= dict.fromkeys(ways, f"http://127.0.0.1:{port}")
        callers = {}
        for way, url in urls.items():
            callers[way] = Callers(way, url, widths)
            stack.callback(callers[way].close)
        yield callers


def _processes(peer: str, checkpoint: Checkpoint) -> Mapping[str, int]:
    """As many as this server has; the FastAPI design has one replica a device, which takes all threads."""
    if peer == "FastAPI":
        return {"threads": checkpoint.threads * checkpoint.instances}
    return {"threads": checkpoint.threads, "workers": checkpoint.instances}


@contextmanager
def running_peer(script: str, options: Mapping[str, object], log: Path) -> Iterator[int]:
    """A peer with these options, from when it answers, and its port."""
    port = Endpoints.free().http_port
    words = [f"--{name}={value}" for name, value in {**options, "port": port}.items()]
    with _running([sys.executable, str(HERE / "peers" / script), *words], port, log):
        yield port


@contextmanager
def _running(command: Sequence[str], port: int, log: Path) -> Iterator[None]:
    """A server, from when it answers."""
    with log.open("wb") as lines:
        process = subprocess.Popen(command, stdout=lines, stderr=lines, env={**os.environ})
        try:
            deadline_s = time.monotonic() + START_S
            while not _answers(port):
                if process.poll() is not None or time.monotonic() > deadline_s:
                    raise RuntimeError(f"{' '.join(command)}: expected to listen, got: see {log}")
                time.sleep(0.2)
            yield
        finally:
            process.terminate()
            process.wait(START_S)


def _answers(port: int) -> bool:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=1):
            return True
    except urllib.error.HTTPError:  # it does, if not this
        return True
    except OSError:
        return False
