# SPDX-License-Identifier: MIT
"""The key to Triton's admin APIs, and options of tritonserver."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import tritonclient.grpc
import tritonclient.http
from prometheus_client.parser import text_string_to_metric_families
from tritonclient.utils import InferenceServerException

from administered import KEY, Running, export_plain
from commands import EXIT_S, command, wait_for_http
from paths import ROOT
from rfm.launch.admin_key import VARIABLE, AdminKeyError, take_key
from rfm.launch.installation import ServerStartError, find_installation
from rfm.launch.process import Endpoints, TritonServer
from rfm_client import ProgressSample, RewardClient
from rfm_client.transport.status import read_status
from rollout import NAME, RFM
from trajectories import random_trajectory

pytestmark = [pytest.mark.triton, pytest.mark.slow]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        pytest.param(("rollout", "nobody", "1"), ", got nobody", id="name"),
        pytest.param(
            ("rollout", NAME, "77"), "rfm version 77: expected an exported version, got [Errno 2]", id="version"
        ),
        pytest.param(("load", "nobody"), ", got nobody", id="load"),
    ],
)
def test_what_is_not_there_is_told_and_nothing_changes(running: Running, words: tuple[str, ...], message: str) -> None:
    before = running.models("list")
    assert message in running.refused(*words)
    assert running.models("list") == before


@pytest.mark.parametrize("shown", [None, "another-key-of-16-or-more"], ids=["none", "another"])
def test_the_server_changes_nothing_without_its_key(running: Running, tmp_path: Path, shown: str | None) -> None:
    http = tritonclient.http.InferenceServerClient(running.endpoints.http_url.removeprefix("http://"))
    grpc = tritonclient.grpc.InferenceServerClient(running.endpoints.grpc_url.removeprefix("grpc://"))
    name = "rfm-admin-key"
    headers = [{}, {}] if shown is None else [{name: shown}, {f"triton-grpc-protocol-{name}": shown}]
    for client, header in zip((http, grpc), headers, strict=True):
        for call, arguments in {
            "get_model_repository_index": (),
            "load_model": (NAME,),
            "unload_model": (NAME,),
            "update_log_settings": ({"log_verbose_level": 1},),
            "update_trace_settings": (None, {"trace_rate": "1"}),
        }.items():
            with pytest.raises(InferenceServerException, match="restricted, expecting header"):
                getattr(client, call)(*arguments, headers=header)
        client.close()
    key_file = tmp_path / "key"
    key_file.touch(0o600)
    key_file.write_text(shown or "")
    words = ["--url", running.endpoints.grpc_url, *(["--admin-key-file", str(key_file)] if shown else [])]
    done = subprocess.run([str(RFM), "models", "list", *words], capture_output=True, text=True, check=False)
    expected = f"admin key: expected that of the server at {running.endpoints.grpc_url}"
    hint = f"(--admin-key-file or {VARIABLE}), got {'another' if shown else 'none'}"
    assert (done.returncode, done.stderr) == (1, f"rfm: {expected} {hint}\n")


@pytest.mark.parametrize(
    ("content", "mode", "message"),
    [
        pytest.param(None, 0, "expected a text file at FILE, got: No such file or directory", id="missing"),
        pytest.param("k" * 16, 0o604, "FILE: expected mode 640 or less of a root's file, got 604", id="others"),
        pytest.param("k" * 16, 0o660, "FILE: expected mode 640 or less of a root's file, got 660", id="group writes"),
        pytest.param("k" * 15, 0o600, "FILE: expected at least 16 characters, got 15", id="short"),
        pytest.param("k" * 16 + "ü", 0o600, "FILE: expected visible ASCII characters without spaces", id="characters"),
    ],
)
def test_a_key_file_that_cannot_be_used_is_told(
    tmp_path: Path, content: str | None, mode: int, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "key"
    if content is not None:
        file.write_text(content)
        file.chmod(mode)
    owned_by(0, monkeypatch)
    with pytest.raises(AdminKeyError) as caught:
        take_key(file, {})
    assert str(caught.value).startswith("--admin-key-file: " + message.replace("FILE", str(file)))
    assert "kkk" not in str(caught.value)


def owned_by(user: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever runs the tests, files are ``user``'s."""
    told = Path.stat

    def stat_as(path: Path, **options: Any) -> os.stat_result:
        status = list(told(path, **options))
        status[stat.ST_UID] = user
        return os.stat_result(status)

    monkeypatch.setattr(Path, "stat", stat_as)


@pytest.mark.parametrize(
    ("user", "mode", "taken"), [(0, 0o440, True), (0, 0o400, True), (7, 0o400, True), (7, 0o440, False)]
)
def test_the_group_may_read_a_secret_of_root_s_alone(
    tmp_path: Path, user: int, mode: int, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Kubernetes mounts it: links to a file of root's, which the pod's group reads."""
    (tmp_path / "data").write_text(f"{KEY}\n")
    (tmp_path / "data").chmod(mode)
    (tmp_path / "key").symlink_to("data")
    owned_by(user, monkeypatch)
    if taken:
        assert take_key(tmp_path / "key", {VARIABLE: "other"}) == KEY
    else:
        with pytest.raises(AdminKeyError, match="expected mode 600 or less of a file, got 440"):
            take_key(tmp_path / "key", {})


def test_a_folder_is_no_key(tmp_path: Path) -> None:
    with pytest.raises(AdminKeyError, match=r"expected a file, got .*, which is none"):
        take_key(tmp_path, {})


def test_a_key_is_taken_out_of_the_environment() -> None:
    environment = {VARIABLE: KEY}
    assert take_key(None, environment) == KEY
    assert environment == {}
    assert take_key(None, environment) is None


def test_rfm_serve_takes_the_key_of_the_environment_and_options_of_tritonserver(tmp_path: Path) -> None:
    """Its children have the key among Triton's arguments alone; nothing that is logged has it."""
    repository, endpoints = tmp_path / "repository", Endpoints.free()
    export_plain(repository, "rfm")
    trace = tmp_path / "trace.json"
    more = ["--", "--trace-config=rate=1", "--trace-config=level=TIMESTAMPS", f"--trace-config=triton,file={trace}"]
    environment = {**os.environ, VARIABLE: KEY}
    log = tmp_path / "log"
    with log.open("w") as lines:
        process = subprocess.Popen(
            [*command(repository, endpoints), *more, "--log-verbose=1"], env=environment, stdout=lines, stderr=lines
        )
        try:
            wait_for_http(process, endpoints)
            with RewardClient(endpoints.grpc_url) as client:
                client.progress(random_trajectory(0, 3))
            words = ["models", "list", "--url", endpoints.grpc_url]
            done = subprocess.run([str(RFM), *words], env=environment, capture_output=True, text=True, check=False)
            assert done.stdout.split() == ["rfm", "1", "READY"], done.stderr
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            for child in children:
                assert KEY not in Path(f"/proc/{child}/environ").read_text()
            assert children
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(EXIT_S)
    assert KEY not in log.read_text()
    assert "COMPUTE_START" in trace.read_text()


@pytest.mark.parametrize("argument", ["--http-port=1", "--http-po=1", "--model-store=/"])
def test_options_that_rfm_serve_sets_are_refused(argument: str) -> None:
    with pytest.raises(
        ServerStartError, match=f"expected an option that rfm serve leaves open, got {argument.split('=')[0]}$"
    ):
        server_with(argument).start()


@pytest.mark.parametrize("argument", ["trace", "--trace-config", "-x=1"])
def test_what_is_no_option_is_refused(argument: str) -> None:
    with pytest.raises(ServerStartError, match=f"tritonserver: expected --option=value, got {argument.split('=')[0]}$"):
        server_with(argument).start()


def server_with(argument: str) -> TritonServer:
    repository = ROOT / "model_repository"
    return TritonServer(repository, Endpoints.free(), find_installation(), more_arguments=[argument])


def test_status_and_prometheus_agree_on_a_known_load(running: Running) -> None:
    """Without the key: the repository's index is not asked for."""
    export_plain(running.repository, "counted")
    running.models("load", "counted")
    url, metrics_url = running.endpoints.grpc_url, running.endpoints.metrics_url
    before = {protocol: counted(running, protocol) for protocol in ("grpc", "http")}
    assert before["grpc"] == before["http"]
    with RewardClient(url, model="counted") as client:
        for index in range(7):
            client.evaluate([ProgressSample(random_trajectory(index, 2 + index))] * 3)
    for protocol in ("grpc", "http"):
        status = counted(running, protocol)
        assert status[0] - before[protocol][0] == 7
        assert status[1] - before[protocol][1] == 21
    with urllib.request.urlopen(metrics_url) as answer:
        families = list(text_string_to_metric_families(answer.read().decode()))
    told = {
        sample.name: sample.value
        for family in families
        for sample in family.samples
        if sample.labels.get("model") == "counted"
    }
    requests, samples = counted(running, "grpc")
    assert told["nv_inference_request_success_total"] == requests
    assert told["nv_inference_count_total"] == samples


def counted(running: Running, protocol: str) -> tuple[int, int]:
    """Requests and samples."""
    url = running.endpoints.grpc_url if protocol == "grpc" else running.endpoints.http_url
    status = read_status(url, metrics_url=running.endpoints.metrics_url)
    (model,) = (model for model in status.models if model.name == "counted")
    assert (model.state, model.version, status.ready) == ("READY", "1", True)
    assert {"rfm", "rfm_encoder", "rfm_frames"} <= {model.name for model in status.models}
    return model.requests_succeeded, model.samples
