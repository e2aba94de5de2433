# SPDX-License-Identifier: MIT
"""``rfm serve``: the process, its signals, and what it leaves behind."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import sysconfig
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import numpy as np
import pytest
import torch

import clip
import rfm_export
from commands import EXIT_S, REPOSITORY, RFM, command, is_alive, nothing_left_behind, wait_for_http
from gateways import answers, poll
from paths import ROOT
from rfm.config import ExportConfig
from rfm.launch import installation
from rfm.launch.endpoints import free_ports
from rfm.launch.installation import ServerStartError, find_installation
from rfm.launch.process import Endpoints, TritonServer, short_spin
from rfm_client import PreferenceSample, ProgressSample, RewardClient, Trajectory
from rfm_serve import children, serving, wait_for

pytestmark = [pytest.mark.triton, pytest.mark.slow]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=lambda number: number.name)
def test_the_committed_repository_is_served_until_a_signal(number: signal.Signals) -> None:
    endpoints = Endpoints.free()
    with nothing_left_behind():
        process = subprocess.Popen(command(REPOSITORY, endpoints), stderr=subprocess.PIPE, text=True)
        try:
            wait_for_http(process, endpoints)
            film = Trajectory(frames=clip.render()[::4], task=clip.TASK)
            with RewardClient(endpoints.grpc_url) as client:
                first, second = client.evaluate([ProgressSample(film), PreferenceSample(film, film)])
            assert np.isfinite(first.progress).all()  # type: ignore[union-attr]
            assert 0 < second.preference < 1  # type: ignore[union-attr]
        finally:
            process.send_signal(number)
            _, log = process.communicate(timeout=EXIT_S)
        assert process.returncode == 0
        assert "successfully unloaded" in log  # Triton's log is forwarded


@pytest.mark.parametrize(
    "arguments",
    [
        ["serve", str(REPOSITORY)],
        [
            "demo",
            "--repository",
            str(REPOSITORY),
            "--video",
            str(ROOT / "tests/videos/jaco_play_pick_up_green_cup.mp4"),
            "--task",
            clip.TASK,
        ],
    ],
    ids=lambda words: words[0],
)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGKILL], ids=lambda number: number.name)
def test_a_signal_leaves_nothing_running(tmp_path: Path, arguments: list[str], number: signal.Signals) -> None:
    program = tmp_path / "tritonserver"  # a stand-in that never gets ready, so that the moment of the signal is known
    program.write_text(f"#!/bin/sh\necho $$ > {tmp_path}/pid\nmv {tmp_path}/pid {tmp_path}/started\nexec sleep 600\n")
    program.chmod(0o755)
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    free = Endpoints.free()
    ports = [f"--{name.replace('_', '-')}={getattr(free, name)}" for name in ("http_port", "grpc_port", "metrics_port")]
    process = subprocess.Popen(
        [str(RFM), *arguments, *(ports if arguments[0] == "serve" else []), "--tritonserver", str(program)],
        cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(temporary)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while not (tmp_path / "started").exists():
        assert process.poll() is None
    process.send_signal(number)
    process.wait(EXIT_S)
    wait_for(lambda: not is_alive(int((tmp_path / "started").read_text())))
    if number != signal.SIGKILL:  # which leaves folders to the next start
        assert list(temporary.glob("rfm-*")) == []


def test_a_signal_while_it_still_loads_ends_it() -> None:
    with nothing_left_behind():
        process = subprocess.Popen(command(REPOSITORY, Endpoints.free()), stderr=subprocess.PIPE, text=True)
        assert process.stderr is not None
        next(line for line in process.stderr if "server.cc" in line or "model_lifecycle" in line)
        process.terminate()
        _, rest = process.communicate(timeout=EXIT_S)
        assert "rfm: " not in rest


def environment(pid: int) -> set[str]:
    """Names and values of a process."""
    return set(Path("/proc", str(pid), "environ").read_text().split("\0"))


def test_a_gateway_beside_triton_shows_its_page_and_it_alone_has_its_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = {name: f"a-secret-of-{name}" for name in ("RFM_ADMIN_KEY", "RFM_GATEWAY_API_KEY")}
    for name, key in keys.items():
        monkeypatch.setenv(name, key)
    repository = tmp_path / "model_repository"
    shutil.copytree(REPOSITORY, repository)
    link = f"http://127.0.0.1:{Endpoints.free().http_port}/"
    with serving(repository, f"--gateway-port={urlsplit(link).port}") as served:
        served.wait_ready()
        poll(lambda: f"look at rewards in the browser: {link}\n" in served.log.read_text())
        poll(lambda: answers(link.rstrip("/")))
        assert "<title>Rewards of robot videos</title>" in httpx.get(link).text
        (gateway,) = [pid for pid in children(served.process.pid, ".") if pid != served.triton]
        for pid in (served.triton, *served.model_processes()):
            assert not [word for word in environment(pid) if "a-secret-of-" in word]
            assert "GOMP_SPINCOUNT=10000" in environment(pid)
        assert [word for word in environment(gateway) if "a-secret-of-" in word] == [
            f"RFM_GATEWAY_API_KEY={keys['RFM_GATEWAY_API_KEY']}"
        ]


OWN = [({}, {"GOMP_SPINCOUNT": "10000"}), ({"GOMP_SPINCOUNT": "7"}, {}), ({"OMP_WAIT_POLICY": "passive"}, {})]


@pytest.mark.parametrize(("own", "added"), OWN)
def test_threads_spin_shortly_unless_the_environment_says_how_they_wait(
    own: dict[str, str], added: dict[str, str]
) -> None:
    assert short_spin(own) == added


def test_a_model_that_cannot_be_loaded_is_named(tmp_path: Path) -> None:
    repository = tmp_path / "model_repository"
    shutil.copytree(REPOSITORY, repository)
    (repository / "rfm" / "1" / "checkpoint" / "config.json").write_text("{")
    with nothing_left_behind():
        result = subprocess.run(
            command(repository, Endpoints.free()), capture_output=True, text=True, timeout=EXIT_S, check=False
        )
    assert result.returncode == 1
    (line,) = (line for line in result.stderr.splitlines() if line.startswith("rfm: "))
    assert line.startswith("rfm: models: expected all to be ready, got rfm: ")
    assert "config.json: expected JSON" in line


@pytest.mark.parametrize(
    ("option", "what"), [("http", "HTTP"), ("grpc", "gRPC"), ("metrics", "metrics"), ("gateway", "gateway: port")]
)
def test_a_port_that_is_taken_is_named_with_its_option(option: str, what: str) -> None:
    with nothing_left_behind(), socket.create_server(("::1", 0), family=socket.AF_INET6) as taken:
        port = taken.getsockname()[1]
        words = [*command(REPOSITORY, Endpoints.free()), "--host=::1", f"--{option}-port={port}"]
        result = subprocess.run(words, capture_output=True, text=True, timeout=EXIT_S, check=False)
    told = f"rfm: {what}: expected a free port of this machine at [::1]:{port}, got: Address already in use; "
    assert result.returncode == 1
    assert result.stderr.splitlines()[-1] == f"{told}--{option}-port names another port"


WRONG_FOLDERS: dict[str, tuple[str, str]] = {  # below a folder, by what it is
    "missing": ("nothing", "which is not there: rfm export --checkpoint CHECKPOINT --repository {folder} writes one"),
    "empty": ("empty", "which has none: rfm export --checkpoint CHECKPOINT --repository {folder} writes them"),
    "a file": ("models/rfm/config.pbtxt", "a file: --repository names the folder"),
    "a model": ("models/rfm", "a folder inside one: --repository {root}/models"),
    "a version, with its own configuration": ("models/rfm/1", "a folder inside one: --repository {root}/models"),
    "a served checkpoint": ("models/rfm/1/checkpoint", "a folder inside one: --repository {root}/models"),
    "one above": ("", "a folder that has one: --repository {root}/models"),
    "a checkpoint": (
        "checkpoint",
        "a checkpoint: rfm export --checkpoint {folder} --repository model_repository, "
        "then --repository model_repository",
    ),
}


@pytest.mark.parametrize(("below", "remedy"), WRONG_FOLDERS.values(), ids=WRONG_FOLDERS)
def test_a_folder_without_models_is_refused_with_the_one_that_was_meant(
    tmp_path: Path, below: str, remedy: str
) -> None:
    (tmp_path / "empty").mkdir()
    shutil.copytree(REPOSITORY, tmp_path / "models")
    shutil.copy(tmp_path / "models/rfm/config.pbtxt", tmp_path / "models/rfm/1")  # as an export leaves it
    shutil.copytree(REPOSITORY / "rfm/1/checkpoint", tmp_path / "checkpoint")
    folder = tmp_path / below
    with pytest.raises(ServerStartError) as refused:
        TritonServer(folder, Endpoints.free(), find_installation()).start_ready()
    got = f"repository: expected a folder of models, got {folder}, {remedy}"
    assert str(refused.value) == got.format(folder=folder, root=tmp_path)


def test_a_server_at_an_ipv6_address_is_watched_and_reached_like_any_other() -> None:
    http, grpc, metrics, status, gateway = free_ports(5)
    endpoints = Endpoints("::1", http, grpc, metrics)
    words = [*command(REPOSITORY, endpoints), "--host=::1", f"--status-port={status}", f"--gateway-port={gateway}"]
    film = ProgressSample(Trajectory(frames=clip.render()[::8], task=clip.TASK))
    with nothing_left_behind(), subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        try:
            poll(lambda: answers(f"http://[::1]:{gateway}") or process.poll() is not None)
            poll(lambda: httpx.get(f"http://[::1]:{status}/ready").json()["ready"])
            assert "nv_inference_count" in httpx.get(endpoints.metrics_url).text
            assert httpx.get(f"http://[::1]:{gateway}/health").json()["status"] == "healthy"
            scores = []
            for url in (f"grpc://[::1]:{grpc}", f"http://[::1]:{http}"):
                with RewardClient(url) as client:
                    scores += [result.progress for result in client.evaluate([film])]  # type: ignore[union-attr]
            np.testing.assert_array_equal(*scores)
        finally:
            process.send_signal(signal.SIGTERM)
            _, log = process.communicate(timeout=EXIT_S)
    assert process.returncode == 0
    assert f"at grpc://[::1]:{grpc}, http://[::1]:{http}, metrics at http://[::1]:{metrics}/metrics\n" in log
    assert f"look at rewards in the browser: http://[::1]:{gateway}/\n" in log


def test_an_export_for_gpus_that_are_not_here_ends_in_how_to_export_it_again(tmp_path: Path) -> None:
    there = torch.cuda.device_count()
    settings = ExportConfig(num_gpus=there + 1)
    rfm_export.export(REPOSITORY / "rfm/1/checkpoint", tmp_path / "models", settings, other_machine=True)
    with nothing_left_behind():
        result = subprocess.run(
            command(tmp_path / "models", Endpoints.free()), capture_output=True, text=True, timeout=EXIT_S, check=False
        )
    assert result.returncode == 1
    last = result.stderr.splitlines()[-1]
    assert last.startswith("rfm: models: expected all to be ready, got rfm: ")
    assert last.endswith("for GPUs that this machine lacks: rfm export again here (--num-gpus 0: for the CPU)")


def test_a_program_that_cannot_run_is_named(tmp_path: Path) -> None:
    program = tmp_path / "tritonserver"
    program.write_bytes(b"\x7fELF no program")
    program.chmod(0o755)
    server = TritonServer(REPOSITORY, Endpoints.free(), find_installation(program))
    with pytest.raises(ServerStartError, match=r"tritonserver: expected a program at .*tritonserver, got: Exec format"):
        server.start_ready()


def test_a_known_vulnerable_triton_on_an_open_address_is_warned_of() -> None:
    result = subprocess.run(
        [str(RFM), "serve", "--repository", "/nowhere", "--host", "0.0.0.0", "--accept-known-vulnerabilities"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.stderr.startswith("rfm: warning: 0.0.0.0 is no loopback address, and a Triton with known")


def test_a_plain_tritonserver_serves_the_repository_too(tmp_path: Path) -> None:
    """Without ``rfm serve``: no explicit model control, configurations completed automatically."""
    triton, endpoints = find_installation(), Endpoints.free()
    arguments = [f"--model-repository={REPOSITORY}", *triton.lay_out_backends(tmp_path / "backends")]
    for protocol, port in {
        "http": endpoints.http_port,
        "grpc": endpoints.grpc_port,
        "metrics": endpoints.metrics_port,
    }.items():
        arguments += [f"--{protocol}-address={endpoints.host}", f"--{protocol}-port={port}"]
    arguments.append(f"--backend-config=python,shm-region-prefix-name=plain_{os.getpid()}_")
    with (tmp_path / "log").open("wb") as log, nothing_left_behind():
        process = subprocess.Popen(
            [triton.executable, *arguments], env={**os.environ, **triton.environment}, stdout=log, stderr=log
        )
        try:
            wait_for_http(process, endpoints)
            with RewardClient(endpoints.http_url) as client:
                result = client.progress(Trajectory(frames=clip.render()[::8], task=clip.TASK))
            assert np.isfinite(result.progress).all()
        finally:
            process.terminate()
            process.wait(EXIT_S)


def test_a_server_that_ends_at_once_is_told(tmp_path: Path) -> None:
    program = tmp_path / "tritonserver"
    program.write_text("#!/bin/sh\nexit 3\n")
    program.chmod(0o755)
    with (
        pytest.raises(ServerStartError, match="tritonserver: expected to run, got exit status 3"),
        TritonServer(REPOSITORY, Endpoints.free(), find_installation(program)),
    ):
        pass


def test_an_explicit_program_wins_over_path_and_path_over_the_wheel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert find_installation().wheel is not None
    for folder in ("in_path", "explicit"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "tritonserver").touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "in_path"), prepend=os.pathsep)
    assert find_installation().executable == tmp_path / "in_path" / "tritonserver"
    explicit = tmp_path / "explicit" / "tritonserver"
    assert find_installation(explicit).executable == explicit


def test_a_program_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ServerStartError, match=r"tritonserver: expected a program at .*/nothing, got none"):
        find_installation(tmp_path / "nothing")


def test_no_triton_at_all_is_told_with_the_command_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    with pytest.raises(ServerStartError, match=r'pip install ".\[triton\]"'):
        find_installation()


def test_numpy_2_is_refused_with_the_wheel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "version", lambda _name: "2.1.0")
    told = r"numpy: expected < 2 with the Triton of nvidia-pytriton, got 2\.1\.0: pip install 'numpy<2'"
    with pytest.raises(ServerStartError, match=told):
        find_installation()


def test_a_missing_libpython_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sysconfig, "get_config_var", lambda _name: str(tmp_path))
    monkeypatch.setattr(installation.sys, "base_prefix", str(tmp_path))
    with pytest.raises(ServerStartError, match=r"libpython3\.\d+\.so\.1\.0: expected in .*apt-get install libpython3"):
        find_installation()
