# SPDX-License-Identifier: MIT
"""What the documentation shows is run as it stands there, but for the server's address."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from typer.main import get_command

import clip
from paths import ROOT
from rfm.supervise.installation import find_installation
from rfm.supervise.process import Endpoints, TritonServer
from rfm_client import PreferenceSample, ProgressSample, Trajectory
from rfm_client.cli.commands import app

pytestmark = pytest.mark.triton

CLIENT_README = ROOT / "client" / "README.md"
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(r"^    (rfm-client [^#\n]*)", re.MULTILINE)


def found(pattern: re.Pattern[str]) -> list[Any]:
    """Each match in each README, named by file and number."""
    matches = [
        pytest.param(match, id=f"{file.relative_to(ROOT)} {number}")
        for file in (ROOT / "README.md", CLIENT_README)
        for number, match in enumerate(pattern.findall(file.read_text()))
    ]
    assert matches
    return matches


@pytest.fixture(scope="module")
def demo_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Endpoints]:
    """The demo's repository, whose checkpoint has the default name."""
    folder = tmp_path_factory.mktemp("demo")
    repository = shutil.copytree(ROOT / "model_repository", folder / "model_repository")
    with (
        (folder / "tritonserver.log").open("wb") as log,
        TritonServer(repository, Endpoints.free(), find_installation(), log=log) as server,
    ):
        yield server.endpoints


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The files that the documentation speaks of."""
    for name in ("film.mp4", "a.mp4", "b.mp4"):
        clip.write(tmp_path / name)
    np.savez(tmp_path / "episode.npz", frames=pictures(0), task="stack the cups")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def pictures(seed: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.random.default_rng(seed).integers(0, 256, (8, 64, 64, 3), np.uint8)


def names() -> dict[str, Any]:
    """What the examples take as given: the demo checkpoint reads embeddings of 64 and 32."""
    random = np.random.default_rng(0)
    embeddings, text = random.standard_normal((8, 64), np.float32), random.standard_normal(32, np.float32)
    filmed = Trajectory(frames=pictures(1), task="stack the cups")
    rewound = Trajectory(video_embeddings=embeddings[::-1], text_embedding=text)
    steps = [{"observation.images.top": image, "task": "stack the cups"} for image in pictures(2)]
    return {
        "frames": pictures(3),
        "other": filmed,
        "rewound": rewound,
        "embeddings": embeddings,
        "text": text,
        "samples": [ProgressSample(filmed), PreferenceSample(rewound, rewound)],
        "trajectories": [filmed, rewound],
        "dataset": steps,
        "images": pictures(4),
    }


@pytest.mark.parametrize("code", found(BLOCK))
def test_every_example_runs(demo_server: Endpoints, folder: Path, code: str) -> None:
    code = code.replace("grpc://localhost:8001", demo_server.grpc_url)
    shown: dict[str, Any] = names()
    exec(compile(code, "README", "exec"), shown)
    if "envs" in shown:
        for environment in (shown["env"], shown["envs"]):
            _, info = environment.reset(seed=0)
            assert "reward_model" in info
            environment.close()


@pytest.mark.parametrize("command", found(COMMAND))
def test_every_command_line_runs(demo_server: Endpoints, folder: Path, command: str) -> None:
    if command.startswith("rfm-client gateway"):
        check_gateway(demo_server, command)
        return
    environment = {
        **os.environ,
        "RFM_URL": demo_server.grpc_url,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    }
    done = subprocess.run(command, shell=True, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def check_gateway(endpoints: Endpoints, command: str) -> None:
    """It runs until it is told to stop."""
    port = Endpoints.free().http_port
    words = [*shlex.split(command), "--triton", endpoints.grpc_url, "--metrics-url", endpoints.metrics_url]
    program = Path(sys.executable).parent / words[0]
    gateway = subprocess.Popen([program, *words[1:], "--port", str(port)], stderr=subprocess.PIPE)
    try:
        while True:
            assert gateway.poll() is None, gateway.communicate()
            try:
                assert httpx.get(f"http://127.0.0.1:{port}/health").json()["status"] == "healthy"
                break
            except httpx.TransportError:  # it does not listen yet
                time.sleep(0.1)
    finally:
        gateway.terminate()
        gateway.communicate(timeout=60)


def test_every_command_of_the_client_is_shown() -> None:
    readme = CLIENT_README.read_text()
    for name in get_command(app).commands:  # type: ignore[attr-defined]
        assert f"rfm-client {name}" in readme


def test_every_exit_code_is_shown() -> None:
    from rfm_client.cli.options import ExitCode

    readme = CLIENT_README.read_text()
    for code in ExitCode:
        assert f"| {code.value} |" in readme


def test_every_option_of_the_client_is_shown() -> None:
    from rfm_client.async_client import CallOptions, ClientOptions

    _, of_clients, of_calls = re.split(
        r"^\| option of a (?:client|call) ", CLIENT_README.read_text(), flags=re.MULTILINE
    )
    for options, table in ((ClientOptions, of_clients), (CallOptions, of_calls)):
        for name in options.__annotations__:
            assert f"`{name}" in table.split("\n\n")[0], name
