# SPDX-License-Identifier: MIT
"""docker/prometheus and docker/grafana before the real thing: Prometheus scrapes `rfm serve`, Triton and gateway."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import torch
import yaml

from gateways import inside
from paths import ROOT
from repositories import kill_model
from rfm.serve.status import Status
from rfm_client import InvalidSampleError, PreferenceSample, ProgressSample, RewardClient, RewardError, Trajectory
from servers import MODEL, Endpoints, Served, serving, wait_for
from trajectories import random_trajectory

PROMETHEUS = ROOT / "docker" / "prometheus"
RUNBOOKS = ROOT / "docs" / "guides" / "operate.md"
INTERVAL = "10s"  # of rates, instead of a minute
WIDTHS = (64, 32)  # D and Dt of the demo's checkpoint
METRIC = re.compile(r"\b(?:up|(?:nv|rfm)[_:][a-z0-9_:]+)\b")
NEEDS_GPU = "nv_gpu_"
RULES = [
    rule
    for name in ("recording", "alerts")
    for group in yaml.safe_load((PROMETHEUS / "rules" / f"{name}.yml").read_text())["groups"]
    for rule in group["rules"]
]
DASHBOARD: dict[str, Any] = json.loads((ROOT / "docker" / "grafana" / "dashboards" / "rfm.json").read_text())
QUERIES = [target["expr"] for panel in DASHBOARD["panels"] for target in panel.get("targets", ())]


@pytest.mark.parametrize("name", ["recording", "alerts"])
def test_prometheus_rules_pass_their_tests_on_made_up_series(promtool: str, name: str) -> None:
    for words in (
        ["check", "config", PROMETHEUS / "prometheus.yml"],
        ["test", "rules", PROMETHEUS / "tests" / f"{name}.yml"],
    ):
        done = subprocess.run([promtool, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert done.returncode == 0, done.stdout


def test_every_alert_has_a_severity_and_a_runbook() -> None:
    for rule in (rule for rule in RULES if "alert" in rule):
        assert rule["labels"]["severity"] in ("critical", "warning")
        assert {"summary", "description", "runbook_url"} == rule["annotations"].keys()
        assert rule["annotations"]["runbook_url"] == f"{{{{ $externalURL }}}}/user/operate.md#:~:text={rule['alert']}"
        assert f"\n### {rule['alert']}\n" in RUNBOOKS.read_text()


def test_every_metric_of_the_rules_and_the_dashboard_is_exposed(served: Served) -> None:
    """By Triton with the models, ``rfm serve`` or the gateway."""
    with inside() as gateway:
        told = httpx.get(served.endpoints.metrics_url).text + Status().metrics().decode() + gateway.get("/metrics").text
    families = {re.sub("_total$", "", name) for name in re.findall(r"^# TYPE (\S+) ", told, re.MULTILINE)}
    named = {name for text in (*QUERIES, *(rule["expr"] for rule in RULES)) for name in METRIC.findall(text)}
    recorded = {rule["record"] for rule in RULES if "record" in rule}
    assert named - {"up"} - recorded > {"nv_inference_request_success", "rfm_serve_ready"}
    for name in named - {"up"} - recorded:
        family = re.sub("_(total|bucket|sum|count)$", "", name)
        assert family in families or name in families or name.startswith(NEEDS_GPU), name


def load(url: str, gateway: str, is_over: threading.Event) -> None:
    """Send samples of all kinds to both models and the gateway, also bad ones."""
    embedded = [random_trajectory(seed, num_frames, *WIDTHS) for seed, num_frames in enumerate((12, 9, 5, 100))]
    frames = np.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), np.uint8)
    arrays = {name: getattr(embedded[0], name).tolist() for name in ("video_embeddings", "text_embedding")}
    bodies = [[{"sample_type": "progress", "trajectory": arrays}] * 20, "none"]
    with RewardClient(url, retry=False) as client, httpx.Client(base_url=gateway, timeout=60) as caller:
        while not is_over.wait(0.05):  # the scrapes want some of the cores
            with suppress(InvalidSampleError, RewardError):  # too many frames; the model process was killed
                client.evaluate([ProgressSample(embedded[0]), PreferenceSample(*embedded[1:3])])
                client.progress(Trajectory(frames=frames, task="stack the cups"))
                client.progress(embedded[3])
            for body in bodies:
                with suppress(httpx.TransportError):  # too slow an answer is load, too
                    caller.post("/evaluate_batch", json={"samples": body})


@contextmanager
def scraping(prometheus: str, folder: Path, targets: dict[str, str]) -> Iterator[Callable[..., Any]]:
    """Run Prometheus with the project's files, other targets and shorter intervals. Yields a function that asks it."""
    copy, port = shutil.copytree(PROMETHEUS, folder / "prometheus"), Endpoints.free().http_port
    for file in (copy / "prometheus.yml", *(copy / "rules").iterdir()):
        text = file.read_text()
        for shown, here in {**targets, "15s": "1s", "[1m]": f"[{INTERVAL}]"}.items():
            text = text.replace(shown, here)
        file.write_text(text)
    words = [f"--config.file={copy / 'prometheus.yml'}", f"--storage.tsdb.path={folder / 'data'}"]

    def get(path: str, **parameters: str) -> Any:
        with suppress(httpx.TransportError):  # it does not listen yet
            answer = httpx.get(f"http://127.0.0.1:{port}/api/v1/{path}", params=parameters)
            if answer.status_code != 503:  # it starts
                return answer.json()["data"]
        return {"result": []}

    with (folder / "log").open("wb") as log:
        process = subprocess.Popen([prometheus, *words, f"--web.listen-address=127.0.0.1:{port}"], stderr=log)
    try:
        yield get
    finally:
        process.terminate()
        process.wait(60)


@contextmanager
def loaded(url: str, gateway: str) -> Iterator[None]:
    is_over = threading.Event()
    with ThreadPoolExecutor() as threads:
        loading = threads.submit(load, url, gateway, is_over)
        try:
            yield
        finally:
            is_over.set()
            loading.result()  # its error is the cause of others


@pytest.mark.nightly
@pytest.mark.triton
def test_prometheus_gets_every_series_of_the_rules_and_the_dashboard_and_notices_a_dead_model(
    prometheus: str, tmp_path: Path
) -> None:
    repository = shutil.copytree(ROOT / "model_repository", tmp_path / "model_repository")
    gateway = f"127.0.0.1:{Endpoints.free().http_port}"
    with serving(repository, f"--gateway-port={gateway.partition(':')[2]}") as served:
        served.wait_ready()
        here = [httpx.URL(url).netloc.decode() for url in (served.endpoints.metrics_url, served.status_url)]
        targets = {"server:8002": here[0], "server:8003": here[1], "gateway:8100": gateway}
        with scraping(prometheus, tmp_path, targets) as get, loaded(served.endpoints.grpc_url, f"http://{gateway}"):
            check(get, repository)


def check(get: Callable[..., Any], repository: Path) -> None:
    def query(expression: str) -> list[Any]:
        """Return the series with finite values."""
        found = get("query", query=expression)["result"]
        return [entry for entry in found if math.isfinite(float(entry["value"][1]))]

    ready, of_model = f'rfm_serve_ready{{model="{MODEL}"}} == 1', f'{{alertname="RfmModelNotReady", model="{MODEL}"}}'
    wait_for(lambda: len(query("up == 1")) == 3 and query(ready))
    kill_model(repository)  # metrics of restarts appear with the first restart
    wait_for(lambda: query(f"last_over_time(ALERTS{of_model}[10m])"))
    wait_for(lambda: query(f'rfm_serve_restarts_total{{what="{MODEL}"}} == 1'))
    wait_for(lambda: query(ready) and not query(f"ALERTS{of_model}"))
    replaced = {"$model": ".*", "$version": ".*", "$__rate_interval": INTERVAL}
    unanswered = []
    for expression in (*QUERIES, *(rule["record"] for rule in RULES if "record" in rule)):
        for name, value in replaced.items():
            expression = expression.replace(name, value)
        if expression.startswith("ALERTS"):  # about the killed process; may be over by now
            expression = f"last_over_time({expression}[10m])"
        if NEEDS_GPU not in expression or torch.cuda.is_available():
            unanswered.append(expression)

    def all_answered() -> bool:
        unanswered[:] = [expression for expression in unanswered if not query(expression)]
        return not unanswered

    wait_for(all_answered, told=unanswered)
    wanted = {name for rule in RULES for name in METRIC.findall(rule["expr"])}  # misspelt, it would never fire
    wanted = {name for name in wanted if NEEDS_GPU not in name or torch.cuda.is_available()}
    wait_for(lambda: wanted <= set(get("label/__name__/values")))
    rules = [rule for group in get("rules")["groups"] for rule in group["rules"]]
    assert {rule["name"] for rule in rules} == {rule.get("record") or rule["alert"] for rule in RULES}
    assert [(rule["name"], rule.get("lastError")) for rule in rules if rule["health"] != "ok"] == []
