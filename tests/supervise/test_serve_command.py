# SPDX-License-Identifier: MIT
"""``rfm serve``: the process, signals, and the remains."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import re
import shutil
import signal
import socket
import subprocess
import sysconfig
from pathlib import Path

import httpx
import numpy as np
import pytest
import torch

import clip
import rfm_export
import stand_in_triton
from client_commands import Terminal
from commands import EXIT_S, REPOSITORY, RFM, command, is_alive, nothing_left_behind
from gateways import answers
from in_process import rfm
from paths import ROOT
from rfm.config import ExportConfig
from rfm.serve import installation
from rfm.serve.access import free_ports
from rfm.serve.installation import ServerStartError, find_installation, has_gpu
from rfm.serve.triton_server import Endpoints, TritonServer, short_spin
from rfm_client import PreferenceSample, ProgressSample, RewardClient, Trajectory
from rfm_client.contract.process import MOST_FILES
from servers import PATIENCE_S, Serving, children, model_processes, wait_for

VIDEO = ROOT / "tests/videos/jaco_play_pick_up_green_cup.mp4"
TRY = ["try", str(VIDEO), f"--repository={REPOSITORY}", f"--task={clip.TASK}"]


def executable(file: Path, content: str) -> Path:
    file.write_text(content)
    file.chmod(0o755)
    return file


def environment(pid: int) -> set[str]:
    """Names and values of a process."""
    return set(Path("/proc", str(pid), "environ").read_text().split("\0"))


@pytest.mark.triton
@pytest.mark.slow
def test_the_committed_repository_is_served_with_a_gateway_until_a_signal(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """At an IPv6 address, with the FastAPI server's file. Only the gateway has the key."""
    keys = {name: f"a-secret-of-{name}" for name in ("RFM_ADMIN_KEY", "RFM_GATEWAY_API_KEY")}
    for name, key in keys.items():
        monkeypatch.setenv(name, key)
    http, grpc, metrics, status, gateway = free_ports(5)
    endpoints = Endpoints("::1", http, grpc, metrics)
    (tmp_path / "server.yaml").write_text(f"server_url: http://[::1]/\nserver_port: {gateway}\n")
    words = [*command(REPOSITORY, endpoints), "--host=::1", f"--status-port={status}"]
    words += ["--config", str(tmp_path / "server.yaml")]
    page = f"http://[::1]:{gateway}"
    video = Trajectory(frames=clip.render()[::8], task=clip.TASK)
    samples = [ProgressSample(video), PreferenceSample(video, video)]
    with nothing_left_behind(), subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        try:
            Serving(process, endpoints, f"http://[::1]:{status}", tmp_path).wait_ready()  # type: ignore[arg-type]
            wait_for(lambda: answers(page))
            assert "<title>Robot video rewards</title>" in httpx.get(page).text
            assert httpx.get(f"{page}/health").json()["status"] == "healthy"
            assert "nv_inference_count" in httpx.get(endpoints.metrics_url).text
            scores = []
            for url in (f"grpc://[::1]:{grpc}", f"http://[::1]:{http}"):
                with RewardClient(url) as client:
                    first, second = client.evaluate(samples)
                assert np.isfinite(first.progress).all()  # type: ignore[union-attr]
                assert 0 < second.preference < 1  # type: ignore[union-attr]
                scores.append(first.progress)  # type: ignore[union-attr]
            np.testing.assert_array_equal(*scores)
            (triton,) = children(process.pid, "tritonserver")
            (beside,) = children(process.pid, "python")
            for pid in (triton, *model_processes(triton)):
                assert not [word for word in environment(pid) if "a-secret-of-" in word]
                assert "GOMP_SPINCOUNT=10000" in environment(pid)
            secrets = [word for word in environment(beside) if "a-secret-of-" in word]
            assert secrets == [f"RFM_GATEWAY_API_KEY={keys['RFM_GATEWAY_API_KEY']}"]
        finally:
            process.send_signal(signal.SIGINT)
            _, log = process.communicate(timeout=EXIT_S)
    assert process.returncode == 0
    assert f"at grpc://[::1]:{grpc}, http://[::1]:{http}, metrics at http://[::1]:{metrics}/metrics\n" in log
    assert "no key needed: gRPC, HTTP, metrics, status; needs a key: page\n" in log
    assert has_gpu() != ("]: no GPU: Triton's lines about " in log)
    assert has_gpu() or not re.search("NVML|DCGM|Unable to allocate pinned", log)
    assert f"answers requests at {page}/\n" in log
    assert f"look at rewards in the browser: {page}/\n" in log
    assert not re.search(r"^I\d{4} ", log, re.MULTILINE)  # Triton's remarks


@pytest.mark.slow
def test_a_terminal_shows_one_screen_and_a_file_the_lines_of_triton(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """With a stand-in for Triton."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    repository = stand_in_triton.repository(tmp_path, "rfm", "rfm_encoder", "rfm_frames")
    endpoints, gateway = Endpoints.free(), free_ports(1)[0]
    program = stand_in_triton.installation(tmp_path).executable
    words = [*command(repository, endpoints), f"--gateway-port={gateway}", f"--tritonserver={program}"]
    with nothing_left_behind(), Terminal(words) as terminal:
        wait_for(lambda: "look at rewards in the browser" in terminal.shown)
        terminal.process.send_signal(signal.SIGINT)
        assert terminal.process.wait(EXIT_S) == 0
    log = tmp_path / "rfm" / f"triton-{endpoints.http_port}.log"
    shown = terminal.shown.splitlines()
    assert shown[0] == f"rfm serve: loading rfm, rfm_encoder, rfm_frames from {repository} ..."
    for line in (
        "  models   rfm 1, rfm_encoder 1, rfm_frames 1, on the CPU",
        f"  gRPC     {endpoints.grpc_url} (no key needed)",
        f"  page     http://127.0.0.1:{gateway}/ (no key needed)",
        f"  log      {log} (lines of Triton and the models)",
    ):
        assert line in shown
    assert any(line.endswith(f"rfm-client score VIDEO --task TASK --url {endpoints.grpc_url}") for line in shown)
    assert "stopping, after the requests in flight" in shown[-1]
    assert "a stand-in has loaded rfm\n" in log.read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "number"),
    [([], signal.SIGHUP), ([], signal.SIGKILL), (TRY, signal.SIGTERM)],
    ids=["hang up", "kill", "try"],
)
def test_a_signal_leaves_nothing_running(tmp_path: Path, arguments: list[str], number: signal.Signals) -> None:
    """A stand-in never gets ready, so the moment of the signal is certain."""
    started = tmp_path / "started"
    program = executable(
        tmp_path / "tritonserver", f"#!/bin/sh\necho $$ > {tmp_path}/pid\nmv {tmp_path}/pid {started}\nexec sleep 600\n"
    )
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    words = [RFM, *arguments] if arguments else command(REPOSITORY, Endpoints.free())
    process = subprocess.Popen(
        [*words, "--tritonserver", program],
        cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(temporary)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    wait_for(lambda: started.exists() or process.poll() is not None)
    process.send_signal(number)
    process.wait(EXIT_S)
    wait_for(lambda: not is_alive(int(started.read_text())))
    assert number != signal.SIGHUP or process.returncode == 0
    if number != signal.SIGKILL:  # which leaves folders to the next start
        assert list(temporary.glob("rfm-*")) == []


@pytest.mark.triton
@pytest.mark.slow
def test_models_that_cannot_be_loaded_are_named_with_a_remedy(tmp_path: Path) -> None:
    """An unreadable checkpoint, and an export for missing GPUs."""
    models = tmp_path / "models"
    shutil.copytree(REPOSITORY / "rfm", models / "rfm")
    settings = ExportConfig(name="gpu", num_gpus=torch.cuda.device_count() + 1)
    rfm_export.export(REPOSITORY / "rfm/1/checkpoint", models, settings, other_machine=True)
    (models / "rfm/1/checkpoint/config.json").write_text("{")
    with nothing_left_behind():
        words = command(models, Endpoints.free())
        result = subprocess.run(words, capture_output=True, text=True, timeout=EXIT_S, check=False)
    assert result.returncode == 1
    (line,) = (line for line in result.stderr.splitlines() if line.startswith("rfm: "))
    assert line.startswith("rfm: models: expected all to be ready, got ")
    assert re.search(r"\brfm: [^;]*config\.json: expected JSON", line)
    assert "gpu: " in line
    assert line.endswith("for GPUs that this machine lacks: rfm export again here (--num-gpus 0: for the CPU)")


@pytest.mark.parametrize(
    ("option", "what"),
    [("http", "HTTP"), ("grpc", "gRPC"), ("metrics", "metrics"), ("gateway", "gateway: port"), ("status", "status")],
)
def test_a_port_that_is_taken_is_named_with_its_option(option: str, what: str) -> None:
    with nothing_left_behind(), socket.create_server(("::1", 0), family=socket.AF_INET6) as taken:
        port = taken.getsockname()[1]
        words = command(REPOSITORY, Endpoints.free())[1:]
        done = rfm(*words, "--host=::1", f"--{option}-port={port}")
    told = f"rfm: {what}: expected a free port of this machine at [::1]:{port}, got Address already in use; "
    assert done.exit_code == 1
    assert done.stderr.splitlines()[-1] == f"{told}--{option}-port names another port"


WRONG_FOLDERS: dict[str, tuple[str, str]] = {  # below a folder
    "missing": ("nothing", "which is not there: rfm export --checkpoint CHECKPOINT --repository {folder} writes one"),
    "empty": ("empty", "which has none: rfm export --checkpoint CHECKPOINT --repository {folder} writes them"),
    "a file": ("models/rfm/config.pbtxt", "a file: --repository names the folder"),
    "a model": ("models/rfm", "a folder inside one: --repository {root}/models"),
    "a served checkpoint": ("models/rfm/1/checkpoint", "a folder inside one: --repository {root}/models"),
    "one above": ("", "a folder that has one: --repository {root}/models"),
    "a training's folder": (
        "trained",
        "a folder that holds a checkpoint: rfm serve {folder}/checkpoint --image-encoder {folder}/image_encoder "
        "exports and serves it",
    ),
    "a checkpoint": ("checkpoint", "a checkpoint: rfm serve {folder} exports and serves it"),
    "a part": ("part", "which has none: rfm export --checkpoint CHECKPOINT --repository {folder} writes them"),
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("folders")
    (root / "empty").mkdir()
    (root / "part").mkdir()
    (root / "part/model.safetensors.part").touch()
    shutil.copytree(REPOSITORY, root / "models")
    shutil.copy(root / "models/rfm/config.pbtxt", root / "models/rfm/1")  # as an export leaves it
    for folder in ("checkpoint", "trained/checkpoint"):
        shutil.copytree(REPOSITORY / "rfm/1/checkpoint", root / folder)
    (root / "trained/image_encoder").mkdir()
    return root


@pytest.mark.parametrize(("below", "remedy"), WRONG_FOLDERS.values(), ids=WRONG_FOLDERS)
def test_a_folder_without_models_is_refused_with_the_one_that_was_meant(folders: Path, below: str, remedy: str) -> None:
    folder = folders / below
    with pytest.raises(ServerStartError) as refused:
        TritonServer(folder, Endpoints.free(), find_installation()).start_ready()
    got = f"repository: expected a folder of models, got {folder}, {remedy}"
    assert str(refused.value) == got.format(folder=folder, root=folders)


@pytest.mark.nightly
@pytest.mark.triton
@pytest.mark.slow
def test_a_plain_tritonserver_serves_the_repository_too(tmp_path: Path) -> None:
    """Without ``rfm serve``: no explicit model control, configurations completed automatically."""
    triton, endpoints = find_installation(), Endpoints.free()
    arguments = [f"--model-repository={REPOSITORY}", *triton.lay_out_backends(tmp_path / "backends")]
    arguments += [*endpoints.arguments(), f"--backend-config=python,shm-region-prefix-name=plain_{os.getpid()}_"]
    environment = {**os.environ, **triton.environment}
    with (tmp_path / "log").open("wb") as log, nothing_left_behind():
        process = subprocess.Popen([triton.executable, *arguments], env=environment, stdout=log, stderr=log)
        try:
            with RewardClient(endpoints.http_url) as client:
                client.wait_ready(PATIENCE_S)
                result = client.progress(Trajectory(frames=clip.render()[::8], task=clip.TASK))
            assert np.isfinite(result.progress).all()
        finally:
            process.terminate()
            process.wait(EXIT_S)


@pytest.mark.slow
def test_triton_may_have_as_many_files_and_connections_open_as_its_user(tmp_path: Path) -> None:
    program = executable(tmp_path / "tritonserver", "#!/bin/sh\nulimit -Sn\nulimit -Hn\nexit 3\n")
    words = [*command(REPOSITORY, Endpoints.free()), f"--tritonserver={program}"]
    done = subprocess.run(["sh", "-c", 'ulimit -Sn 256; exec "$@"', "sh", *words], capture_output=True, text=True)
    soft, hard = done.stdout.split()
    assert int(soft) == (MOST_FILES if hard == "unlimited" else min(int(hard), MOST_FILES))


@pytest.mark.parametrize(
    ("program", "told"),
    [
        (None, "expected a program at .*/tritonserver, got none"),
        ("\x7fELF no program", "expected a program at .*/tritonserver, got Exec format"),
        ("#!/bin/sh\nexit 3\n", "expected to run, got exit status 3"),
        ("#!/bin/sh\nexec sleep 0.1\n", "expected to run, got exit status 0"),
    ],
    ids=["missing", "no program", "fails at once", "ends without serving"],
)
@pytest.mark.slow
def test_a_tritonserver_that_cannot_serve_ends_rfm_serve_with_the_reason_and_no_crash_loop(
    tmp_path: Path, program: str | None, told: str
) -> None:
    file = tmp_path / "tritonserver"
    if program is not None:
        executable(file, program)
    words = [*command(REPOSITORY, Endpoints.free()), f"--status-port={free_ports(1)[0]}", f"--tritonserver={file}"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 1
    assert re.search(rf"^rfm: tritonserver: {told}", done.stderr.splitlines()[-1])


def test_threads_spin_shortly_unless_the_environment_says_how_they_wait() -> None:
    assert short_spin({}) == {"GOMP_SPINCOUNT": "10000"}
    for own in ({"GOMP_SPINCOUNT": "7"}, {"OMP_WAIT_POLICY": "passive"}):
        assert short_spin(own) == {}


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


def test_without_triton_the_error_names_the_command_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
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
