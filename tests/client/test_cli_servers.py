# SPDX-License-Identifier: MIT
"""rfm-client status, wait and sample; exit codes; servers that go away, and URLs with a wrong port."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tritonclient.http
from typer.main import get_command

import clip
from client_commands import MODEL, RFM_CLIENT, WIDTHS, ask, columns, invoke, rows, run
from engine_server import EngineServer
from gateways import running
from in_process import rfm, rfm_client_app
from proxies import Proxy
from rfm_client import InvalidSampleError, RewardClient, ServerError, Trajectory
from rfm_client.cli.bench import Load, measure
from rfm_client.command_line import ExitCode
from secured import Papers
from servers import Endpoints, Quiet, RepositoryApi, Served, folder_server, wait_for, web_server
from trajectories import random_trajectory
from vlm import PLAIN as VLM


@contextmanager
def silent_server() -> Iterator[tuple[str, socket.socket]]:
    """A server that takes connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}", listening


def test_status_reports_the_counts_of_triton(served: Served) -> None:
    with served.client("grpc", MODEL) as client:
        client.progress(random_trajectory(0, 3, *WIDTHS))
    words = ("status", "--url", served.url("grpc"), "--metrics-url", served.endpoints.metrics_url, "--json", "-")

    def shown() -> tuple[dict[str, Any], dict[str, Any]]:
        result = invoke(*words)
        assert (result.exit_code, result.stderr) == (0, "")
        (server,) = json.loads(result.stdout)["servers"]
        return server, {model["name"]: model for model in server["models"]}

    wait_for(lambda: (shown()[1][MODEL]["batches"] or {"count": 0})["count"])  # the model reports once a second
    wait_for(lambda: all(device["memory_used_bytes"] for device in shown()[0]["devices"]))  # first after two seconds
    server, models = shown()
    assert (server["ready"], server["version"], server["metrics_error"]) == (True, "2.51.0", None)
    with RepositoryApi(served.url("grpc"), served.server.admin_key) as api:
        assert models.keys() == {entry.name for entry in api.index() if entry.is_ready}
    with tritonclient.http.InferenceServerClient(served.url("http").removeprefix("http://")) as triton:
        (counted,) = triton.get_inference_statistics(MODEL)["model_stats"]
    model, stats = models[MODEL], counted["inference_stats"]
    assert (model["state"], model["version"], model["reason"]) == ("READY", "1", "")
    assert model["requests_succeeded"] == stats["success"]["count"] > 0
    with served.client("grpc", MODEL) as client, pytest.raises(InvalidSampleError):
        client.progress(Trajectory(frames=np.zeros((20, 8, 8, 3), np.uint8), task="stack the cups"))  # 4 too many
    frames = f"{MODEL}_frames"  # an ensemble, whose failures Triton counts twice
    assert shown()[1][frames]["requests_failed"] == models[frames]["requests_failed"] + 1
    assert (model["samples"], model["executions"]) == (counted["inference_count"], counted["execution_count"])
    assert model["queue_ms"] == pytest.approx(stats["queue"]["ns"] / 1e6)
    assert model["samples_per_batch"] >= 1
    assert model["compute_ms_per_batch"] > 0
    assert model["requests_pending"] == 0
    (cpu,) = (device for device in server["devices"] if device["name"] == "CPU")
    assert 0 < cpu["memory_used_bytes"] < cpu["memory_total_bytes"]


BATCHES = {  # of two instances: 40 batches, 120 samples; the work of each batch
    "batch_samples_count": (10, 30),
    "batch_samples_sum": (30, 90),
    "collate_seconds_sum": (0.5, 0.5),
    "forward_seconds_sum": (3, 6),
}


def test_status_shows_gpus_and_pending_requests(engines: EngineServer, tmp_path: Path) -> None:
    gib = 2**30
    (tmp_path / "metrics").write_text(
        "# TYPE nv_gpu_utilization gauge\n"
        'nv_gpu_utilization{gpu_uuid="GPU-a"} 0.75\n'
        f'nv_gpu_memory_used_bytes{{gpu_uuid="GPU-a"}} {3 * gib}\n'
        f'nv_gpu_memory_total_bytes{{gpu_uuid="GPU-a"}} {80 * gib}\n'
        'nv_gpu_utilization{gpu_uuid="GPU-b"} 0\n'
        f'nv_inference_pending_request_count{{model="{MODEL}",version="1"}} 12\n'
        f'rfm_samples_total{{model="{MODEL}",version="1",outcome="refused",sample_type="progress"}} 4\n'
        f'rfm_samples_total{{model="{MODEL}",version="1",outcome="refused",sample_type="preference"}} 2\n'
        f'rfm_samples_total{{model="{MODEL}",version="1",outcome="failed",sample_type="progress"}} 8\n'
        + "".join(
            f'rfm_{name}{{model="{MODEL}",version="1",device="cpu",instance="{MODEL}_0_{instance}"}} {value}\n'
            for name, values in BATCHES.items()
            for instance, value in enumerate(values)
        )
    )
    with engines.client(MODEL) as client:
        client.model_info()  # so that the server knows it
    with folder_server(tmp_path) as url:
        result = invoke("status", "--url", engines.url, "--metrics-url", f"{url}/metrics")
    assert result.exit_code == 0
    requests, batches = rows(result.stdout, f"{MODEL} ")
    assert requests[5:] == ["6", "12"]  # refused; pending
    assert batches[2:5] == ["40", "3.0", "250.00"]
    assert batches[6] == "start"
    assert columns(result.stdout, "GPU-a") == ["GPU-a", "75%", "3.0 GiB", "80.0 GiB"]
    assert columns(result.stdout, "GPU-b") == ["GPU-b", "0%", "-", "-"]


def test_status_without_metrics_shows_the_rest_and_says_so(served: Served) -> None:
    """At port 8002, another server may answer."""
    address = free_url()
    for words, told in (
        ([], ""),
        (["--metrics-url", f"{address}/metrics"], f" {address}/metrics: Connection refused:"),
    ):
        result = invoke("status", "--url", served.url("http"), *words)
        assert result.exit_code == 0
        assert f"no metrics of the machine:{told} give their URL (--metrics-url)\n" in result.stdout
    requests, batches = rows(result.stdout, f"{MODEL} ")
    assert batches[6] == "load"
    assert (requests[1:3], requests[5:]) == (["1", "READY"], ["-", "-"])


def test_synthetic_samples_are_frames_where_embeddings_are_not_read(engines: EngineServer) -> None:
    result = ask(engines, "sample", "--num-samples", 2, model=VLM)
    assert (result.exit_code, result.stderr) == (0, "")
    assert "progress of random frames" in result.stdout


LOADS: dict[str, tuple[list[object], int, bool]] = {  # options, steps, whether the load is held
    "embeddings": (["--robots", 3, "--hz", 0.5, "--seconds", 4], 6, True),
    "frames": (["--robots", 2, "--hz", 0.5, "--seconds", 2, "--use-frames", "--size", 48, "--frames", 4], 2, True),
    "too many": (["--robots", 1, "--hz", 1000, "--seconds", 1, "--timeout", 20], 1000, False),
}


@pytest.mark.parametrize(("words", "steps", "is_held"), LOADS.values(), ids=LOADS)
def test_bench_tells_whether_the_server_holds_a_load(
    demo_server: Endpoints, words: list[object], steps: int, is_held: bool
) -> None:
    result = invoke("bench", "--url", demo_server.grpc_url, *words, "--json", "-")
    assert (result.exit_code, result.stderr) == (ExitCode.OK if is_held else ExitCode.FAILED, "")
    told = json.loads(result.stdout)
    assert told["held"] is is_held
    assert set(told["failures"]) <= (set() if is_held else {"not sent: too many earlier steps are unanswered"})
    assert told["asked"] == ("frames" if "--use-frames" in words else "embeddings")
    assert told["steps"] in range(steps, steps + 4)  # robots begin within a step
    assert 0 <= told["in_time"] <= 1
    assert 0 < told["p50_ms"] <= told["p99_ms"]
    assert told["steps_per_s"] > 0


def test_bench_counts_failed_steps_by_reason(demo_server: Endpoints) -> None:
    class Failing(RewardClient):
        """Every second step fails, as at a server that rejects it."""

        num_steps = 0

        def submit(self, sample: Any, **options: Any) -> Future[Any]:
            self.num_steps += 1
            if self.num_steps % 2:
                return super().submit(sample, **options)
            failed: Future[Any] = Future()
            failed.set_exception(ServerError("the queue is full"))
            return failed

    load = Load(robots=1, hz=4, seconds=1)
    with Failing(demo_server.grpc_url) as client:
        measured = measure(client, load)
    assert measured.failures == {"the queue is full": 2}
    assert measured.in_time <= 0.5
    assert not measured.is_held
    assert "2 failed: the queue is full\n" in measured.report(load)
    assert "not held" in measured.report(load)


def free_url() -> str:
    with silent_server() as (url, _):
        return url


@pytest.mark.parametrize("command", ["sample", "status"])
def test_a_server_that_does_not_answer_is_out_of_time(command: str) -> None:
    with silent_server() as (url, _):
        result = invoke(command, "--url", url, "--timeout", 0.2)
    assert result.exit_code == ExitCode.DEADLINE
    assert re.fullmatch(r"rfm-client: .*no answer within 0\.2 s\n", result.stderr), result.stderr


def test_scoring_with_a_model_that_is_not_served_fails_and_names_it(engines: EngineServer, video: Path) -> None:
    result = ask(engines, "score", "video.mp4", "--task", clip.TASK, model="unknown")
    assert result.exit_code == ExitCode.NO_MODEL
    assert re.fullmatch(r"rfm-client: .*unknown_frames.*; served: .*: give the .* \(--model\)\n", result.stderr)
    result = ask(engines, "score", video, "--task", clip.TASK, model="c1_t1_disc10")  # which reads embeddings alone
    assert result.exit_code == ExitCode.NO_MODEL
    assert "c1_t1_disc10_frames" in result.stderr
    remedy = "this checkpoint takes embeddings alone: export it with --image-encoder and --text-encoder"
    assert result.stderr.endswith(f": {remedy}\n")


def test_wait_returns_when_the_model_is_ready_or_its_time_is_up(
    engines: EngineServer, caplog: pytest.LogCaptureFixture
) -> None:
    result = ask(engines, "wait")
    assert result.exit_code == 0
    assert re.fullmatch(r"ready after \d+\.\d s\n", result.output)
    url = free_url()
    result = invoke("wait", "--url", url, "--timeout", 0.2)
    assert result.exit_code == ExitCode.DEADLINE
    remedy = "start a server there (rfm serve), name a model that it serves (--model), or wait longer (--timeout)"
    assert (
        result.stderr
        == f"rfm-client: {url}: rfm and rfm_frames: not ready within 0.2 s: {url}: no connection: Connection refused: {remedy}\n"
    )
    assert not caplog.messages  # of another time limit


def test_wait_does_not_wait_for_a_server_that_wants_a_key() -> None:
    """With a stand-in for a proxy before Triton."""

    class Denied(Quiet, BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(401)

    with web_server(Denied) as url:
        result = invoke("wait", "--url", url, "--timeout", 600)
    assert result.exit_code == ExitCode.FAILED
    assert f"{url}: access denied: " in result.stderr
    assert "show the key that it wants with api_key (--api-key-file)" in result.stderr


def test_certificates_from_the_environment_beside_a_url_without_tls_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RFM_CA_FILE", str(Papers.issue(tmp_path).ca))
    for application, words in ((invoke, ("status",)), (invoke, ("sample",)), (rfm, ("models", "list"))):
        result = application(*words, "--url", "grpc://localhost:8001")
        assert result.exit_code == ExitCode.USAGE
        assert "expected grpcs:// or https:// with certificates, got grpc://localhost:8001" in result.stderr
        assert "leave out ca_file (RFM_CA_FILE)" in result.stderr


def test_an_interrupt_ends_it_without_a_traceback() -> None:
    with silent_server() as (url, listening):
        command = [str(RFM_CLIENT), "score", "video.mp4", "--task", "x", "--url", url]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        connection, _ = listening.accept()  # by now it is asking
        with connection:
            process.send_signal(signal.SIGINT)
            _, told = process.communicate(timeout=30)
    assert (process.returncode, told) == (ExitCode.INTERRUPTED, "rfm-client: interrupted\n")


def test_without_typer_the_client_prints_the_command_that_installs_it() -> None:
    program = "import sys; sys.modules['typer'] = None; from rfm_client.cli import main; main()"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert result.stderr == 'rfm-client: expected the package typer, got none: pip install "./client[cli]"\n'


VARIABLE = {"RFM_API_KEY_FILE": "/variable"}


def test_an_option_wins_over_its_variable() -> None:
    for options, winner in (([], "/variable"), (["--api-key-file", "/option"], "/option")):
        result = invoke("status", *options, env=VARIABLE)
        assert result.exit_code == ExitCode.USAGE
        assert f"got {winner}: No such file or directory" in " ".join(result.stderr.split())


def test_an_api_key_is_read_once_so_that_a_pipe_will_do(tmp_path: Path) -> None:
    np.save(tmp_path / "clip.npy", np.zeros((2, 8, 8, 3), np.uint8))
    pipe, end = os.pipe()
    os.write(end, b"key")
    os.close(end)
    result = invoke(
        "score",
        tmp_path / "clip.npy",
        "--task",
        "x",
        "--url",
        "grpc://127.0.0.1:1",
        "--api-key-file",
        f"/dev/fd/{pipe}",
    )
    os.close(pipe)
    assert result.exit_code == ExitCode.UNAVAILABLE, result.stderr


def test_a_missing_package_costs_a_line(engines: EngineServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client.parser", None)
    result = invoke("status", "--url", engines.url)
    assert result.exit_code == ExitCode.FAILED
    assert re.fullmatch(r'rfm-client: .*prometheus_client.*: pip install "./client\[cli\]"\n', result.stderr)


def test_exit_codes_are_documented_with_every_command() -> None:
    (exit_codes,) = re.findall(r"Exit codes: .* one a line\.", " ".join(invoke("--help").stdout.split()))
    for code in ExitCode:
        assert re.search(rf"\b{code.value} ", exit_codes), code
    commands = get_command(rfm_client_app).commands  # type: ignore[attr-defined]
    assert len(commands) == 9
    for name in commands:
        assert exit_codes in " ".join(invoke(name, "--help").stdout.split())


NUM_SOURCES = 1000  # more than are scored before the server is gone
NOT_ASKED = "not asked, since no server answers any more"
NO_GRPC = "no answer of Triton's gRPC port (by default 8001)"
OF_HTTP = "Triton's HTTP port (by default 8000)"
PORTS = {
    ("grpc", "http_port"): (ExitCode.UNAVAILABLE, NO_GRPC),
    ("grpc", "metrics_port"): (ExitCode.UNAVAILABLE, NO_GRPC),
    ("http", "grpc_port"): (ExitCode.FAILED, OF_HTTP),
    ("http", "metrics_port"): (ExitCode.FAILED, OF_HTTP),
}


@pytest.mark.parametrize(("scheme", "port"), PORTS)
def test_the_error_for_a_wrong_port_names_the_right_one(demo_server: Endpoints, scheme: str, port: str) -> None:
    url = f"{scheme}://127.0.0.1:{getattr(demo_server, port)}"
    code, expected = PORTS[scheme, port]
    for command in ("sample", "status"):
        result = invoke(command, "--url", url)
        assert (result.exit_code, expected in result.stderr) == (code, True), result.stderr
    result = invoke("wait", "--url", url, "--timeout", 0.5)
    assert (result.exit_code, expected in result.stderr) == (ExitCode.DEADLINE, True), result.stderr


def test_the_error_for_tls_to_a_server_without_it_names_the_plain_scheme(demo_server: Endpoints) -> None:
    for url, remedy in ((demo_server.grpc_url, "use grpc://"), (demo_server.http_url, "without: grpc:// or http://")):
        with RewardClient(url.replace("://", "s://"), retry=False) as client, pytest.raises(ServerError, match=remedy):
            client.model_info()
    told = run("sample", "--url", demo_server.grpc_url.replace("://", "s://")).stderr
    assert re.fullmatch(r"rfm-client: .*use grpc://.*\n", told), told  # without gRPC's own lines


def test_a_gateway_and_a_folder_are_no_triton(demo_server: Endpoints, tmp_path: Path) -> None:
    with running(demo_server, tmp_path) as gateway, folder_server(tmp_path) as folder:
        assert NO_GRPC in invoke("sample", "--url", gateway.url.replace("http", "grpc")).stderr
        for url in (gateway.url, folder):
            assert f"expected {OF_HTTP}, got " in invoke("sample", "--url", url).stderr


ENDS = {"has gone": ExitCode.UNAVAILABLE, "hangs": ExitCode.DEADLINE}


@pytest.mark.slow
@pytest.mark.parametrize("how", ENDS)
def test_a_server_that_goes_away_is_not_asked_any_more(engines: EngineServer, tmp_path: Path, how: str) -> None:
    random = np.random.default_rng(0)
    source, target = tmp_path / "episode.npz", tmp_path / "scores.json"
    shown, told = tmp_path / "stdout", tmp_path / "stderr"
    embeddings = {"video_embeddings": random.random((8, 64)), "text_embedding": random.random(32)}
    np.savez(source, **{name: array.astype(np.float32) for name, array in embeddings.items()})
    with ExitStack() as proxies:
        proxies.enter_context(engines.client("rfm")).model_info()  # loaded before the timeout counts
        proxy = proxies.enter_context(Proxy(int(engines.url.rpartition(":")[2])))
        url = f"grpc://127.0.0.1:{proxy.port}"
        words = ("score", *[source] * NUM_SOURCES, "--timeout", 2, "--json", target, "--url", url)
        with shown.open("w") as out, told.open("w") as err:
            process = subprocess.Popen([str(RFM_CLIENT), *map(str, words)], stdout=out, stderr=err)
            wait_for(lambda: len(rows(shown.read_text(), str(source))) >= 5)  # they come while others are asked
            if how == "hangs":
                proxies.enter_context(proxy.held())
            else:
                proxies.close()
            assert process.wait(timeout=60) == ENDS[how], told.read_text()
    scored = rows(shown.read_text(), str(source))
    outcomes = json.loads(target.read_text())["videos"]
    failures = [outcome for outcome in outcomes if "error" in outcome]
    assert len(outcomes) == NUM_SOURCES == len(scored) + len(failures)
    not_asked = [failure for failure in failures if failure["error"] == NOT_ASKED]
    assert 0 < len(failures) - len(not_asked) <= 8
    assert len(re.findall(f"^rfm-client: {source}: {NOT_ASKED}$", told.read_text(), re.MULTILINE)) == len(not_asked) > 0
