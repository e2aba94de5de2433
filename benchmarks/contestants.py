# SPDX-License-Identifier: MIT
"""The measured servers, each with separate caller processes, and the bare engine."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import psutil
import torch
from load import Calls, Load, Measured, samples

import rfm_export
from rfm import published
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm.families.rewind.checkpoint import RewindCheckpoint
from rfm.families.rewind.network import RewindConfig, RewindTransformer
from rfm.serve.triton_server import Endpoints
from rfm_commands.config import Config

HERE = Path(__file__).parent
DEMO = HERE.parent / "model_repository"
DEMO_ENCODERS = {f"{kind}_encoder": str(DEMO / "rfm_encoder" / "1" / f"{kind}_encoder") for kind in ("image", "text")}
VLM = HERE.parent / "tests" / "golden" / "vlm"
VLM_CHECKPOINT, VLM_BASE = VLM / "q3_tok_disc10" / "checkpoint", VLM / "bases" / "q3"
PEERS = {"FastAPI": "fastapi_server.py", "mosec": "mosec_server.py"}
START_S = 120
CORES_OF_A_PROCESS = 4  # one for a Python caller process, the others for the server
US_PER_S = 1e6
DEFAULT_SIZE = RewindConfig(  # upstream's defaults
    video_feature_dim=768,
    text_feature_dim=384,
    hidden_dim=512,
    num_layers=4,
    num_attention_heads=8,
    max_len=16,
    causal_mask=True,
    use_per_frame_progress_token=True,
    progress_bins=10,
    has_similarity=True,
)


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint and its export.

    threads: torch threads in every server
    widths: frame and text embedding width; 0: the checkpoint takes frames
    """

    folder: Path
    repository: Path
    threads: int
    widths: tuple[int, int]


def checkpoint(size: str, folder: Path) -> Checkpoint:
    """Export and return a checkpoint.

    size: ``small``: the demo's checkpoint and settings; ``default``: upstream's default size, random weights;
        ``vlm``: a tiny checkpoint on Qwen3-VL
    """
    repository, threads = folder / f"repository_{size}", torch.get_num_threads()
    settings = ExportConfig(num_gpus=0, torch_threads=threads)
    if size == "small":
        source, widths = DEMO / "rfm" / "1" / "checkpoint", (64, 32)
        settings = replace(Config.from_yaml(DEMO / "serve.yaml").export, **DEMO_ENCODERS)
    elif size == "vlm":
        source, widths, settings = VLM_CHECKPOINT, (0, 0), replace(settings, base_model=str(VLM_BASE))
    else:
        torch.manual_seed(0)
        source, widths = folder / size, (DEFAULT_SIZE.video_feature_dim, DEFAULT_SIZE.text_feature_dim)
        RewindCheckpoint(DEFAULT_SIZE, RewindTransformer(DEFAULT_SIZE).state_dict()).save(source)
    rfm_export.export(source, repository, settings)
    return Checkpoint(source, repository, settings.torch_threads or threads, widths)


class Contestant:
    """A context with a running server and separate caller processes, one for every four cores.

    way: how callers reach the server, see load.py
    server: context that yields the server's address
    widths: frame and text embedding width
    """

    def __init__(self, way: str, server: AbstractContextManager[str], widths: tuple[int, int]) -> None:
        self._way, self._server, self._widths = way, server, widths

    def __enter__(self) -> Contestant:
        before = set(psutil.Process().children(recursive=True))
        url = self._server.__enter__()
        self._processes = set(psutil.Process().children(recursive=True)) - before
        words = [sys.executable, str(HERE / "load.py"), self._way, url, *map(str, self._widths)]
        self._callers = [
            subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            for _ in range(max(len(os.sched_getaffinity(0)) // CORES_OF_A_PROCESS, 1))
        ]
        return self

    def __exit__(self, *raised: object) -> None:
        for process in self._callers:
            process.communicate()
        self._server.__exit__(None, None, None)

    def measure(self, load: Load) -> dict[str, float]:
        """Return rates, latencies, and CPU microseconds per sample. Raises RuntimeError if a caller process ends."""
        callers = self._callers[: load.callers or 1]
        asking = [psutil.Process(process.pid) for process in callers]
        before_s = _cpu_s(self._processes), _cpu_s(asking)
        for process, share in zip(callers, shares(load, len(callers)), strict=True):
            assert process.stdin is not None
            process.stdin.write(json.dumps(asdict(share)) + "\n")
            process.stdin.flush()
        measured = Measured.of([_calls(process) for process in callers], load.together)
        after_s = _cpu_s(self._processes), _cpu_s(asking)
        count = max(measured.samples_per_s * measured.took_s, 1)
        server_us, client_us = ((after - b) / count * US_PER_S for after, b in zip(after_s, before_s, strict=True))
        return {**asdict(measured), "server_us": server_us, "client_us": client_us}


def shares(load: Load, count: int) -> list[Load]:
    """Split a load among ``count`` processes, at most one per caller."""
    each, more = divmod(load.callers, count)
    rate_per_s = load.rate_per_s / count
    return [replace(load, callers=each + (number < more), rate_per_s=rate_per_s) for number in range(count)]


def _calls(process: subprocess.Popen[str]) -> Calls:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise RuntimeError(f"callers: expected an answer, got exit status {process.wait()}")
    return Calls(**json.loads(line))


def _cpu_s(processes: Sequence[psutil.Process] | set[psutil.Process]) -> float:
    return sum(sum(process.cpu_times()[:2]) for process in processes if process.is_running())


class BareEngine:
    """Runs ``Engine.evaluate`` in this process, batch after batch: the upper bound for a server around it."""

    def __init__(self, measured: Checkpoint) -> None:
        self._engine, self._widths = Engine.of(published.load(measured.folder)), measured.widths

    def measure(self, load: Load, batch_size: int) -> dict[str, float]:
        """Return rates and latencies for the load's samples. Two batches warm up."""
        asked, latencies_s, started_s = samples(load, *self._widths), [], 0.0
        for number in range(1_000_000):
            if number == 2:
                latencies_s, started_s = [], time.perf_counter()
            if started_s and time.perf_counter() - started_s > load.seconds:
                break
            before_s = time.perf_counter()
            self._engine.evaluate([asked(number * batch_size + i) for i in range(batch_size)])
            latencies_s.append(time.perf_counter() - before_s)
        took_s = time.perf_counter() - started_s
        measured = Measured.of([Calls(latencies_s, 0, took_s)], batch_size)
        return {**asdict(measured), "server_us": 0.0, "client_us": 0.0}


@contextmanager
def serving(checkpoint: Path, folder: Path, settings: Mapping[str, Any], python: str) -> Iterator[dict[str, str]]:
    """Serve a checkpoint with another Python's packages, ignoring PYTHONPATH; yield the addresses by name.

    folder: for the repository and the log
    settings: the configuration's ``export`` section
    """
    program = str(Path(shutil.which(python) or python).absolute())
    words = [program, str(HERE / "serving.py"), str(checkpoint.absolute()), str(folder), json.dumps(settings)]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    # In another folder: Triton's Python backend imports from the working folder first.
    process = subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=folder
    )
    assert process.stdout is not None
    try:
        while not (line := process.stdout.readline()).startswith("{"):
            if not line:
                raise RuntimeError(f"{python}: expected the addresses of a server, got exit status {process.wait()}")
        yield json.loads(line)
    finally:
        process.communicate()


@contextmanager
def peer(name: str, options: Mapping[str, object], log: Path) -> Iterator[str]:
    """Start a peer with these options; yield its address as soon as it answers."""
    port = Endpoints.free().http_port
    words = [f"--{option}={value}" for option, value in {**options, "port": port}.items()]
    with running([sys.executable, str(HERE / "peers" / PEERS[name]), *words], port, log):
        yield f"http://127.0.0.1:{port}"


@contextmanager
def running(command: Sequence[str], port: int, log: Path) -> Iterator[None]:
    """Run a server, and yield as soon as it answers. Raises RuntimeError if it ends or does not answer in START_S."""
    with log.open("wb") as lines:
        process = subprocess.Popen(command, stdout=lines, stderr=lines)
        try:
            deadline_s = time.monotonic() + START_S
            while not _answers(port):
                if process.poll() is not None or time.monotonic() > deadline_s:
                    raise RuntimeError(f"{' '.join(command)}: expected to listen, got:\n{log.read_text()[-2000:]}")
                time.sleep(0.2)
            yield
        finally:
            process.terminate()
            process.wait(START_S)


def _answers(port: int) -> bool:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=1):
            return True
    except urllib.error.HTTPError:  # an error status is an answer, too
        return True
    except OSError:
        return False
