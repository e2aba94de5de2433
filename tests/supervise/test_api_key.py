# SPDX-License-Identifier: MIT
"""``rfm serve --api-key-file``: one key for the gateway, gRPC and HTTP."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from commands import REPOSITORY
from gateways import answers
from in_process import rfm
from rfm.serve.access import Endpoints, callers_restrictions, free_ports
from rfm.serve.installation import find_installation
from rfm.serve.repository_api import RepositoryApi
from rfm.serve.triton_server import TritonServer
from rfm_client import AccessDeniedError, ProgressSample, RewardClient
from rfm_client.contract.triton import bearer_headers
from rfm_client.contract.wire import PROGRESS, encode_samples
from servers import KEY, PATIENCE_S, Quiet, administered, wait_for, web_server
from trajectories import random_trajectory

API_KEY = "the-key-of-all-callers="
TRAJECTORY = random_trajectory(0, 3, 64, 32)


@pytest.mark.triton
@pytest.mark.slow
def test_one_key_opens_every_door_and_none_opens_without_it(tmp_path: Path) -> None:
    repository = shutil.copytree(REPOSITORY, tmp_path / "model_repository")
    (tmp_path / "api.key").touch(0o600)
    (tmp_path / "api.key").write_text(f"{API_KEY}\n")
    (port,) = free_ports(1)
    page, asked = f"http://127.0.0.1:{port}", {"samples": [{"sample_type": "progress", "trajectory": _document()}]}
    options = ["--api-key-file", str(tmp_path / "api.key"), "--gateway-port", str(port)]
    with administered(repository, *options) as served:
        assert "needs a key: gRPC, HTTP, page; no key needed: metrics, status" in "\n".join(served.said)
        wait_for(lambda: answers(page))
        curves = []
        for url in (served.endpoints.grpc_url, served.endpoints.http_url):
            for key in (None, "another-key-of-16-or-more"):
                with RewardClient(url, api_key=key) as client, pytest.raises(AccessDeniedError, match="restricted"):
                    client.progress(TRAJECTORY)
            with RewardClient(url, api_key=API_KEY) as client:
                curves.append(client.progress(TRAJECTORY).progress)
        assert httpx.post(f"{page}/evaluate_batch", json=asked).status_code == 401
        answer = httpx.post(f"{page}/evaluate_batch", json=asked, headers={"X-API-Key": API_KEY})
        curves.append(np.float32(answer.json()["outputs_progress"]["progress_pred"][0]))
        np.testing.assert_allclose(curves[1:], curves[:1] * 2, atol=1e-5)

        tensors, grpc = encode_samples([ProgressSample(TRAJECTORY)]), served.endpoints.grpc_url
        rollout = ["models", "rollout", "rfm", "1", "--repository", str(repository), "--url", grpc]
        for option, told in (([], "none"), (["--api-key-file", str(tmp_path / "key")], "another")):
            done = rfm(*rollout, "--admin-key-file", str(tmp_path / "key"), *option)
            expected = f"expected that of the server at {grpc} (--api-key-file or RFM_API_KEY_FILE), got {told}"
            assert (done.stdout, done.stderr) == ("", f"rfm: API key: {expected}\n")  # nothing was loaded
        with RepositoryApi(grpc, KEY, headers=bearer_headers(API_KEY)) as api:
            assert api.infer("rfm", 1, tensors, [PROGRESS])[PROGRESS].shape[0] == 1

        before = _scored(served.endpoints.metrics_url)
        wait_for(lambda: _scored(served.endpoints.metrics_url) > before)  # the watch's probes show the key, too
    assert API_KEY not in served.log.read_text(errors="replace")


def _scored(metrics_url: str) -> float:
    found = re.search(
        r'^nv_inference_request_success\{model="rfm",.*\} (\d+)', httpx.get(metrics_url).text, re.MULTILINE
    )
    assert found is not None
    return float(found[1])


def _document() -> dict[str, object]:
    return {
        "task": TRAJECTORY.task,
        "video_embeddings": TRAJECTORY.video_embeddings.tolist(),  # type: ignore[union-attr]
        "text_embedding": TRAJECTORY.text_embedding.tolist(),  # type: ignore[union-attr]
    }


@pytest.mark.parametrize("apis", ["health,inference", "shared-memory", "health, inference"])
@pytest.mark.parametrize("option", ["grpc-restricted-protocol", "http-restricted-api", "http-restr"])
def test_a_second_key_for_callers_is_refused(option: str, apis: str, tmp_path: Path) -> None:
    """Triton would not start, or one port would ask for another key than the other."""
    file = tmp_path / "api.key"
    file.touch(0o600)
    file.write_text(API_KEY)
    done = rfm("serve", str(REPOSITORY), "--api-key-file", str(file), "--", f"--{option}={apis}:header=another")
    told = r"rfm: --api-key-file: expected no --\S+ for inference or shared-memory beside it, got both: leave out one\n"
    assert done.exit_code == 1
    assert re.fullmatch(told, done.stderr)
    assert f" --{option}" in done.stderr


@pytest.mark.parametrize("option", ["--api-key-file", "--gateway-api-key-file"])
def test_callers_with_the_admin_key_are_refused(option: str, tmp_path: Path) -> None:
    file = tmp_path / "a.key"
    file.touch(0o600)
    file.write_text(API_KEY)
    done = rfm("serve", str(REPOSITORY), "--gateway-port", "8100", option, str(file), "--admin-key-file", str(file))
    told = "rfm: admin key: expected another than the callers' key, got the same: make its own\n"
    assert (done.exit_code, done.stderr) == (1, told)


def test_a_key_for_other_apis_stays() -> None:
    both = callers_restrictions("k", ["--grpc-restricted-protocol=health:a=b"])
    apis = "inference,shared-memory:authorization=Bearer k"
    assert both == [f"--http-restricted-api={apis}", f"--grpc-restricted-protocol={apis}"]
    assert callers_restrictions(None, ["--http-restricted-api=inference:a=b"]) == []


class Recorder(Quiet, BaseHTTPRequestHandler):
    """Stands in for a server, whose requests it keeps."""

    def __init__(self, kept: list[Mapping[str, str]], *connection: Any) -> None:
        self.kept = kept
        super().__init__(*connection)

    def do_GET(self) -> None:
        self.kept.append(dict(self.headers.items()))
        self.send_response(200)
        self.end_headers()


def test_over_http_the_key_is_in_the_usual_header_alone_and_in_no_description() -> None:
    """Logs of proxies redact no other header."""
    kept: list[Mapping[str, str]] = []
    with web_server(partial(Recorder, kept)) as url:
        endpoints = replace(Endpoints.free(), http_port=int(url.rpartition(":")[2]))
        arguments = callers_restrictions(API_KEY, [])
        server = TritonServer(REPOSITORY, endpoints, find_installation(), api_key=API_KEY, more_arguments=arguments)
        server.http.request("GET", "/", PATIENCE_S)
        with RewardClient(url, api_key=API_KEY) as client:
            client.is_ready()
    shown = [[name.lower() for name, value in headers.items() if API_KEY in value] for headers in kept]
    assert shown == [["authorization"]] * len(kept)
    assert len(kept) > 1
    assert API_KEY not in repr(server)
