# SPDX-License-Identifier: MIT
"""Health, model information, metrics and schemas."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import requests
import schemathesis
from hypothesis import HealthCheck, given, settings
from typer.testing import CliRunner

import goldens
from gateway_requests import (
    FILM,
    FILM_DIMS,
    FIRST,
    SECOND,
    TINY,
    TOLERANCE,
    TRUTH_S,
    VIDEO,
    Triton,
    answered,
    ask_json,
    ask_npy,
    expected,
    failure,
    filmed,
    paused,
    preference,
    progress,
)
from gateways import WITHIN_S, Gateway, answers, free_port, poll, running
from rfm.checkpoint.content import read_run_config
from rfm.launch.cleanup import SHARED_MEMORY
from rfm.launch.process import Endpoints
from rfm.rewind.network import RewindTransformer
from rfm_client import (
    InvalidSampleError,
    ModelNotFoundError,
    Trajectory,
)
from rfm_client.transport.status import read_status
from rfm_commands.cli import app

pytestmark = pytest.mark.triton


def work_done(gateway: Gateway) -> tuple[int, float]:
    (stats,) = requests.get(f"{gateway.url}/gpu_status").json()["gpu_stats"].values()
    return stats["total_requests"], stats["total_processing_time"]


@pytest.mark.parametrize("name", ["tiny", "film", "video"])
def test_gpu_status_counts_each_request_once(request: pytest.FixtureRequest, name: str) -> None:
    gateway, *others = (request.getfixturevalue(each) for each in sorted(("tiny", "film", "video"), key=name.__ne__))
    sample = progress(FIRST if name == "tiny" else filmed(1, 2))
    (count, busy_s), of_others = work_done(gateway), [work_done(other) for other in others]
    began_s = time.time()
    for _ in range(3):
        answered(ask_json(gateway, [sample]))
    assert work_done(gateway)[0] == count + 3
    parts = {"tiny": [TINY], "film": [FILM, f"{FILM}_encoder"], "video": [f"{VIDEO}_frames"]}[name]
    status = read_status(gateway.triton_url, metrics_url=request.getfixturevalue("triton").endpoints.metrics_url)
    computed_s = sum(m.busy_ms for m in status.models if m.name in parts) / 1e3
    assert busy_s < work_done(gateway)[1] == pytest.approx(computed_s, rel=0.01)
    assert [work_done(other) for other in others] == of_others
    status = requests.get(f"{gateway.url}/gpu_status").json()
    (stats,) = status.pop("gpu_stats").values()
    assert status == {"total_gpus": 1, "available_gpus": 1, "max_workers": 1, "pool_size": 1}
    assert (stats["device"], stats["status"]) == ("CPU", "ready")
    assert began_s - 1 <= stats["last_used"] <= time.time() + 1  # Triton's clock is coarser
    assert 0 <= stats["utilization"] <= 1
    assert 0 < stats["memory_used_bytes"] < stats["memory_total_bytes"]


def test_scoring_is_healthy_without_triton_s_metrics(triton: Triton, tmp_path: Path) -> None:
    nowhere = f"http://127.0.0.1:{free_port()}/metrics"
    with running(triton.endpoints, tmp_path, TINY, "--metrics-url", nowhere) as gateway:
        healthy = {"status": "healthy", "available_gpus": None, "total_gpus": None}
        assert requests.get(f"{gateway.url}/health").json() == healthy
        assert requests.get(f"{gateway.url}/model_info").json()["num_gpus"] is None
        assert "metrics" in failure(requests.get(f"{gateway.url}/gpu_status"), 503)


def test_health_has_asked_every_model(film: Gateway) -> None:
    assert requests.get(f"{film.url}/health").json() == {"status": "healthy", "available_gpus": 1, "total_gpus": 1}


def test_a_server_that_hangs_is_unhealthy_with_the_reason(triton: Triton, strict: Gateway) -> None:
    assert requests.get(f"{strict.url}/health").ok
    with paused(triton):  # what was found before is told for a second more
        hung_s = time.monotonic()
        poll(lambda: requests.get(f"{strict.url}/health").status_code == 503)
        assert time.monotonic() - hung_s < TRUTH_S
        assert "no answer within" in failure(requests.get(f"{strict.url}/health"), 503)
    poll(lambda: requests.get(f"{strict.url}/health").ok)


def test_model_info_tells_the_checkpoint(tiny: Gateway, tiny_network: RewindTransformer) -> None:
    info = requests.get(f"{tiny.url}/model_info").json()
    total = sum(parameter.numel() for parameter in tiny_network.parameters())
    architecture = info.pop("model_architecture")
    parts = architecture.pop("architecture_summary")
    assert sum(part["parameters"] for part in parts) == total
    assert {part["name"] for part in parts} == {name.partition(".")[0] for name in tiny_network.state_dict()}
    assert architecture == {
        "model_class": "RewindTransformer",
        "total_parameters": total,
        "trainable_parameters": 0,
        "frozen_parameters": total,
        "trainable_percentage": 0.0,
    }
    config = info.pop("experiment_config")["model"]
    assert config.items() >= {"video_feature_dim": 2, "hidden_dim": 8, "causal_mask": True, "progress_bins": 10}.items()
    assert info.pop("model_path").endswith("two_wide")
    assert info == {"model_version": "1", "num_gpus": 1}


def test_model_info_has_the_whole_configuration_of_the_training_run(film: Gateway) -> None:
    run = read_run_config(goldens.config("enc_c1_t1_disc10").checkpoint / "config.yaml")
    assert requests.get(f"{film.url}/model_info").json()["experiment_config"] == json.loads(json.dumps(run))


def test_metrics_count_what_was_asked(tiny: Gateway) -> None:
    def counts() -> list[float]:
        return [
            tiny.metric("requests_total", endpoint="/evaluate_batch", code="200"),
            tiny.metric("requests_total", endpoint="/evaluate_batch_npy", code="422"),
            tiny.metric("requests_total", endpoint="other", code="404"),
            tiny.metric("rejections_total", reason="invalid"),
            tiny.metric("samples_total", sample_type="progress"),
            tiny.metric("samples_total", sample_type="preference"),
            tiny.metric("request_duration_seconds_count", endpoint="/evaluate_batch"),
        ]

    before = counts()
    answered(ask_json(tiny, [progress(FIRST), preference(FIRST, SECOND), progress(SECOND)]))
    ask_npy(tiny, [progress(filmed(1, 2))])
    requests.get(f"{tiny.url}/nowhere")
    assert [after - b for after, b in zip(counts(), before, strict=True)] == [1, 1, 1, 1, 2, 1, 1]
    assert tiny.metric("requests_in_flight") == 0


def test_the_schemas_are_told(tiny: Gateway) -> None:
    assert "swagger" in requests.get(f"{tiny.url}/docs").text
    document = requests.get(f"{tiny.url}/openapi.json").json()
    names = ("evaluate_batch", "evaluate_batch_npy", "gpu_status", "health", "model_info", "metrics")
    assert document["paths"].keys() == {f"/{name}" for name in names}
    codes = document["paths"]["/evaluate_batch"]["post"]["responses"].keys()
    assert codes == {"200", "408", "413", "422", "502", "503", "504"}


@pytest.fixture(scope="module")
def api(film: Gateway) -> Any:
    """The OpenAPI document, from which requests are made up."""
    return schemathesis.openapi.from_url(f"{film.url}/openapi.json")


@pytest.mark.parametrize("path", ["/evaluate_batch", "/evaluate_batch_npy", "/gpu_status", "/model_info", "/health"])
def test_no_request_that_the_schemas_allow_breaks_the_gateway(api: Any, path: str) -> None:
    ((_, operation),) = api[path].items()

    @settings(max_examples=25, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    @given(case=operation.as_strategy())
    def check(case: schemathesis.Case) -> None:
        response = case.call()
        assert response.status_code < 500, response.text
        response.json()

    check()


def children(process_id: int) -> dict[int, str]:
    """Processes that it has started, and these, with their command lines."""
    parents, commands = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            commands[int(folder.name)] = (folder / "cmdline").read_text().replace("\0", " ")
        except (FileNotFoundError, ProcessLookupError):  # it ended meanwhile
            continue
    found: dict[int, str] = {}
    wanted = {process_id}
    while wanted:
        wanted = {child for child, parent in parents.items() if parent in wanted}
        found |= {child: commands[child] for child in wanted if child in commands}
    return found


@pytest.mark.slow
def test_rfm_serve_runs_a_gateway_until_a_signal_and_again_if_it_is_killed(triton: Triton, tmp_path: Path) -> None:
    repository, endpoints, port = tmp_path / "model_repository", Endpoints.free(), free_port()
    shutil.copytree(triton.repository / TINY, repository / TINY)
    ports = {"http": endpoints.http_port, "grpc": endpoints.grpc_port, "metrics": endpoints.metrics_port}
    options = [word for name, number in (ports | {"gateway": port}).items() for word in (f"--{name}-port", str(number))]
    options += ["--gateway-timeout", "90", "--gateway-max-waiting", "7"]
    rfm = [str(Path(sys.executable).parent / "rfm"), "serve", "--repository", str(repository), *options]
    log_file = tmp_path / "rfm.log"
    with log_file.open("wb") as log:
        process = subprocess.Popen(rfm, stdout=log, stderr=log)
    try:
        url = f"http://127.0.0.1:{port}"
        poll(lambda: process.poll() is not None or answers(url))
        assert process.poll() is None, log_file.read_text()
        gateway = Gateway(url, TINY, endpoints.grpc_url, process, log_file)
        assert answered(ask_json(gateway, [progress(FIRST)])) == expected(gateway, [progress(FIRST)])
        assert requests.get(f"{url}/health").json()["status"] == "healthy"
        started = children(process.pid)
        (gateway_id,) = (child for child, command in started.items() if "rfm_gateway" in command)
        assert "--timeout 90.0 --max-body-mib 512" in started[gateway_id]
        assert "--max-waiting 7" in started[gateway_id]
        os.kill(gateway_id, signal.SIGKILL)
        poll(lambda: not answers(url))
        poll(lambda: answers(url))
        assert answered(ask_json(gateway, [progress(FIRST)])) == expected(gateway, [progress(FIRST)])
        started |= children(process.pid)
        process.terminate()
        assert process.wait(WITHIN_S) == 0
    finally:
        process.terminate()
        process.wait(WITHIN_S)
    assert "rfm: gateway is started again: exit status -9" in gateway.log.splitlines()
    assert len(started) >= 4  # Triton, its model process, the first gateway and the second
    assert not [child for child in started if Path(f"/proc/{child}").exists()]
    assert not list(SHARED_MEMORY.glob(f"*_rfm_{process.pid}_*"))


BAD_OPTIONS: dict[str, tuple[list[str], str]] = {
    "no URL": (
        ["--triton", "localhost:8001"],
        "url: expected grpc://host:port or http://host:port, or grpcs:// or https://, got",
    ),
    "no folder": (["--allow-folder", "nowhere"], "No such file or directory"),
    "no key file": (["--api-key-file", "nowhere"], "'--api-key-file': expected a text file, got"),
    "an empty key": (
        ["--api-key-file", os.devnull],
        "'--api-key-file': expected a key, here or in RFM_GATEWAY_API_KEY, got no character",
    ),
    "less memory than a body": (
        ["--max-memory-mib", "100"],
        "'--max-memory-mib': expected at least max_body_mib (512), got less",
    ),
    "no port": (["--port", "0"], "Input should be greater than or equal to 1"),
    "an address of another machine": (["--host", "192.0.2.1"], "Cannot assign requested address; --host names another"),
    "a time-out that never ends": (["--timeout", "inf"], "Input should be less than or equal to 86400"),
}


@pytest.mark.parametrize(("options", "message"), BAD_OPTIONS.values(), ids=BAD_OPTIONS)
def test_wrong_options_are_refused(options: list[str], message: str, tmp_path: Path) -> None:
    given = ["gateway", *([] if "--triton" in options else ["--triton", "grpc://localhost:1"]), *options]
    result = CliRunner().invoke(app, given, env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert message in result.output


WITHOUT_GATEWAY = "import sys; sys.modules['rfm_gateway'] = None; sys.argv = {words}; from {module} import main; main()"


@pytest.mark.parametrize(
    ("module", "words", "message"),
    [
        (
            "rfm_client.cli",
            ["rfm-client", "gateway", "--triton", "grpc://localhost:1"],
            "pip install ./client ./gateway",
        ),
        ("rfm_commands.cli", ["rfm", "serve", "--gateway-port", "8100"], "pip install ./client ./gateway ."),
    ],
    ids=["rfm-client", "rfm"],
)
def test_a_gateway_that_is_not_installed_is_told_with_the_command_that_installs_it(
    module: str, words: list[str], message: str
) -> None:
    program = WITHOUT_GATEWAY.format(words=words, module=module)
    done = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.endswith(f"{message}\n")
    assert len(done.stderr.splitlines()) == 1


def test_the_client_encodes_a_trajectory_once_for_many_questions(film: Gateway, tiny: Gateway) -> None:
    given = filmed(1, 4)
    frames = Trajectory(frames=given["frames"], task=given["task"])
    with film.client() as client:
        encoded = client.encode(frames)
        assert (encoded.positions.shape, encoded.frames, encoded.task) == ((4, FILM_DIMS[0]), None, given["task"])
        assert encoded.text_embedding is not None
        assert encoded.text_embedding.shape == (FILM_DIMS[1],)
        first, second = client.progress(frames), client.progress(encoded)
        np.testing.assert_allclose(first.progress, second.progress, rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(first.success, second.success, rtol=0, atol=TOLERANCE)
        with pytest.raises(InvalidSampleError, match="trajectory: expected frames, got video_embeddings"):
            client.encode(encoded)
    with tiny.client() as client, pytest.raises(ModelNotFoundError, match="rfm_encoder"):
        client.encode(frames)
