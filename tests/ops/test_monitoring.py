# SPDX-License-Identifier: MIT
"""docker/prometheus and docker/grafana before the real thing: Prometheus scrapes `rfm serve`, Triton and gateway."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import httpx
import numpy as np
import pytest
import torch
import yaml

from paths import ROOT
from repositories import kill_model
from rfm_client import InvalidSampleError, PreferenceSample, ProgressSample, RewardClient, RewardError, Trajectory
from servers import MODEL, Endpoints, serving, wait_for
from trajectories import random_trajectory

pytestmark = [pytest.mark.triton, pytest.mark.slow]

PROMETHEUS = ROOT / "docker" / "prometheus"
GRAFANA = ROOT / "docker" / "grafana"
RUNBOOKS = ROOT / "docs" / "guides" / "operate.md"

INTERVALS = {"15s": "1s", "1m": "10s"}  # in the files, and in the tests
EMBEDDING_DIMS = (64, 32)  # D and Dt of the demo's checkpoint
TOO_MANY_FRAMES = 100  # for it
GATEWAY_CALLERS = 4
METRIC = re.compile(r"\b(?:up|ALERTS|(?:nv|rfm)[_:][a-z0-9_:]+)\b")
NEEDS_GPU = "nv_gpu_"
PROGRAMS = f"{Path(sys.executable).parent}:{os.environ['PATH']}"

Json: TypeAlias = dict[str, Any]


def load_rules(name: str) -> list[Json]:
    groups = yaml.safe_load((PROMETHEUS / "rules" / f"{name}.yml").read_text())["groups"]
    return [rule for group in groups for rule in group["rules"]]


RECORDED = [rule["record"] for rule in load_rules("recording")]
ALERTS = load_rules("alerts")
DASHBOARD: Json = json.loads((GRAFANA / "dashboards" / "rfm.json").read_text())
ROWS = [panel for panel in DASHBOARD["panels"] if panel["type"] == "row"]
PANELS = [panel for panel in DASHBOARD["panels"] if panel["type"] != "row"]
VARIABLES = [variable for variable in DASHBOARD["templating"]["list"] if variable["type"] == "query"]
QUERIES = [
    pytest.param(target["expr"], id=f"{panel['title']} {target['refId']}")
    for panel in PANELS
    for target in panel["targets"]
]


def program(name: str) -> str:
    found = shutil.which(name, path=PROGRAMS)
    assert found, f"{name}: expected in PATH, got nothing (make ops-tools)"
    return found


@dataclass(frozen=True)
class Monitored:
    """A Prometheus with the scraped servers."""

    url: str

    def get(self, path: str, **parameters: str) -> Any:
        answer = httpx.get(f"{self.url}/api/v1/{path}", params=parameters).json()
        assert answer["status"] == "success", answer
        return answer["data"]

    def query(self, expression: str) -> list[Json]:
        """Return the series with finite values."""
        result = self.get("query", query=expression)["result"]
        return [entry for entry in result if math.isfinite(float(entry["value"][1]))]


def eventually(ask: Callable[[], Any]) -> Any:
    """The first answer that is true."""
    told: list[Any] = []
    wait_for(lambda: told.append(ask()) or told[-1])
    return told[-1]


def answers(url: str) -> bool:
    with suppress(httpx.TransportError):  # it does not listen yet
        return httpx.get(url).is_success
    return False


@contextmanager
def prometheus(folder: Path, port: int, targets: dict[str, str]) -> Iterator[Monitored]:
    command = [
        program("prometheus"),
        f"--config.file={write_configuration(folder, targets)}",
        f"--storage.tsdb.path={folder / 'data'}",
        f"--web.listen-address=127.0.0.1:{port}",
        f"--web.user-assets={RUNBOOKS.parent}",
    ]
    url = f"http://127.0.0.1:{port}"
    with (folder / "prometheus.log").open("wb") as log, subprocess.Popen(command, stdout=log, stderr=log) as process:
        try:
            wait_for(lambda: answers(f"{url}/-/ready"))
            yield Monitored(url)
        finally:
            process.terminate()


def write_configuration(folder: Path, targets: dict[str, str]) -> Path:
    """The project's, with other targets and intervals."""
    copy = shutil.copytree(PROMETHEUS, folder / "prometheus")
    file = copy / "prometheus.yml"
    config = yaml.safe_load(file.read_text())
    for name in ("scrape_interval", "evaluation_interval"):
        config["global"][name] = INTERVALS[config["global"][name]]
    for job in config["scrape_configs"]:
        job["static_configs"] = [{"targets": [targets[job["job_name"]]]}]
    file.write_text(yaml.safe_dump(config))
    for rules in (copy / "rules").iterdir():
        rules.write_text(rules.read_text().replace("[1m]", f"[{INTERVALS['1m']}]"))
    return file


def embedded(seed: int, num_frames: int) -> Trajectory:
    return random_trajectory(seed, num_frames, *EMBEDDING_DIMS)


def load_triton(url: str, is_over: threading.Event) -> None:
    """Send samples of all kinds to both models, also bad ones."""
    frames = np.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), np.uint8)
    seed = 0
    with RewardClient(url, retry=False) as client:
        while not is_over.wait(0.02):  # the scrapes want some of the cores
            seed += 1
            try:
                pair = PreferenceSample(embedded(seed, 9), embedded(seed + 1, 5))
                client.evaluate([ProgressSample(embedded(seed, 12)), pair])
                client.progress(Trajectory(frames=frames, task="stack the cups"))
                client.progress(embedded(seed, TOO_MANY_FRAMES))
            except InvalidSampleError:
                pass
            except RewardError:  # the model process was killed
                is_over.wait(0.1)


def load_gateway(url: str, is_over: threading.Event) -> None:
    """Several requests at a time, and something that is no request."""
    video, text = embedded(0, 8).video_embeddings, embedded(0, 8).text_embedding
    assert video is not None and text is not None
    trajectory = {"video_embeddings": video.tolist(), "text_embedding": text.tolist()}
    good = {"samples": [{"sample_type": "progress", "trajectory": trajectory}] * 20}
    with httpx.Client(base_url=url, timeout=60) as client, ThreadPoolExecutor(GATEWAY_CALLERS) as callers:
        while not is_over.wait(0.1):
            for body in (good, {"samples": "none"}):
                list(callers.map(lambda body: client.post("/evaluate_batch", json=body), [body] * GATEWAY_CALLERS))


@contextmanager
def loaded(endpoints: Endpoints, gateway_url: str) -> Iterator[None]:
    is_over = threading.Event()
    with ThreadPoolExecutor() as threads:
        loads = [
            threads.submit(load_triton, endpoints.grpc_url, is_over),
            threads.submit(load_gateway, gateway_url, is_over),
        ]
        try:
            yield
        finally:
            is_over.set()
        for load in loads:
            load.result()


@pytest.fixture(scope="module")
def monitored(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Monitored]:
    """After the first scrape a model process dies, since metrics of restarts appear with the first restart."""
    folder = tmp_path_factory.mktemp("monitored")
    repository = shutil.copytree(ROOT / "model_repository", folder / "model_repository")
    free = Endpoints.free()
    gateway = f"http://127.0.0.1:{free.http_port}"
    with serving(repository, f"--gateway-port={free.http_port}") as served:
        wait_for(lambda: served.is_ready() and answers(f"{gateway}/metrics"))
        urls = {"triton": served.endpoints.metrics_url, "gateway": gateway, "rfm-serve": served.status_url}
        targets = {job: httpx.URL(url).netloc.decode() for job, url in urls.items()}
        with prometheus(folder, free.grpc_port, targets) as monitored, loaded(served.endpoints, gateway):
            wait_for(lambda: monitored.query(f'rfm_serve_ready{{model="{MODEL}"}} == 1'))
            kill_model(repository)
            yield monitored


@pytest.mark.parametrize("name", ["recording", "alerts"])
def test_rules_do_on_made_up_series_what_they_should(name: str) -> None:
    command = [program("promtool"), "test", "rules", PROMETHEUS / "tests" / f"{name}.yml"]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("rule", ALERTS, ids=[rule["alert"] for rule in ALERTS])
def test_every_alert_says_what_to_do(rule: Json) -> None:
    assert rule["labels"]["severity"] in ("critical", "warning")
    assert rule["for"]
    assert {"summary", "description", "runbook_url"} == rule["annotations"].keys()
    assert rule["annotations"]["runbook_url"] == f"{{{{ $externalURL }}}}/user/operate.md#:~:text={rule['alert']}"
    assert f"\n### {rule['alert']}\n" in RUNBOOKS.read_text()


def test_the_dashboard_begins_with_models_restarts_and_alerts_which_link_to_their_runbooks(
    monitored: Monitored,
) -> None:
    order = sorted(PANELS, key=lambda panel: (panel["gridPos"]["y"], panel["gridPos"]["x"]))
    assert [panel["title"] for panel in order[:3]] == ["Models ready", "Restarts", "Alerts"]
    (column,) = order[2]["fieldConfig"]["overrides"]
    (link,) = column["properties"][0]["value"]
    assert (column["matcher"]["options"], link["url"]) == ("alertname", "${runbooks}#:~:text=${__value.text}")
    (runbooks,) = (each["query"] for each in DASHBOARD["templating"]["list"] if each["name"] == "runbooks")
    served = httpx.get(monitored.url + httpx.URL(runbooks).path)
    assert served.headers["content-type"].startswith("text/")
    assert served.text == RUNBOOKS.read_text()


def test_grafana_finds_its_data_source_where_the_dashboard_looks_for_it() -> None:
    (source,) = yaml.safe_load((GRAFANA / "provisioning/datasources/prometheus.yml").read_text())["datasources"]
    assert source["jsonData"]["timeInterval"] == "15s"  # as Prometheus scrapes
    for part in (*PANELS, *VARIABLES):
        assert part["datasource"] == {"type": "prometheus", "uid": source["uid"]}


def test_triton_the_gateway_and_rfm_serve_are_scraped(monitored: Monitored) -> None:
    def up() -> bool:
        told = {entry["metric"]["job"]: entry["value"][1] for entry in monitored.query("up")}
        return told == {"triton": "1", "gateway": "1", "rfm-serve": "1"}

    wait_for(up)


@pytest.mark.parametrize("name", RECORDED)
def test_every_recording_rule_gives_data(monitored: Monitored, name: str) -> None:
    for entry in eventually(lambda: monitored.query(name)):
        assert {"job", "instance"} <= entry["metric"].keys() <= {"__name__", "job", "instance", "model", "version"}
        assert float(entry["value"][1]) >= 0


def test_every_rule_is_evaluated(monitored: Monitored) -> None:
    def healths() -> list[tuple[str, str]]:
        groups = monitored.get("rules")["groups"]
        rules = [(rule["name"], rule["health"], rule.get("lastError")) for group in groups for rule in group["rules"]]
        return [] if any(health == "unknown" for _, health, _ in rules) else rules

    told = eventually(healths)
    assert {name for name, *_ in told} == {*RECORDED, *(rule["alert"] for rule in ALERTS)}
    assert [rule for rule in told if rule[1] != "ok"] == []


@pytest.mark.parametrize("expression", QUERIES)
def test_every_query_of_the_dashboard_gives_data(monitored: Monitored, expression: str) -> None:
    for name, value in {"$model": ".*", "$version": ".*", "$__rate_interval": INTERVALS["1m"]}.items():
        expression = expression.replace(name, value)
    assert "$" not in expression
    if expression.startswith("ALERTS"):  # about the killed process; may be over by now
        expression = f"last_over_time({expression}[10m])"
    if NEEDS_GPU in expression and not torch.cuda.is_available():
        assert monitored.query(expression) == []
    else:
        wait_for(lambda: monitored.query(expression))


@pytest.mark.parametrize("variable", VARIABLES, ids=lambda variable: variable["name"])
def test_every_variable_of_the_dashboard_has_values(monitored: Monitored, variable: Json) -> None:
    series, label = re.fullmatch(r"label_values\((.*), (\w+)\)", variable["query"]["query"]).groups()  # type: ignore[union-attr]
    expected = {"model": {"rfm", "rfm_encoder", "rfm_frames"}, "version": {"1"}}[label]
    series = series.replace("$model", ".*")
    wait_for(lambda: set(monitored.get(f"label/{label}/values", **{"match[]": series})) == expected)


@pytest.mark.parametrize("rule", ALERTS, ids=[rule["alert"] for rule in ALERTS])
def test_every_metric_of_an_alert_is_there(monitored: Monitored, rule: Json) -> None:
    """A name that is misspelt would never fire."""
    wanted = set(METRIC.findall(rule["expr"]))
    assert wanted
    if not torch.cuda.is_available():
        wanted = {name for name in wanted if NEEDS_GPU not in name}
    wait_for(lambda: wanted <= set(monitored.get("label/__name__/values")))


def test_a_dead_model_process_is_noticed_and_healed(monitored: Monitored) -> None:
    """The fixture has killed it."""
    name = f'{{alertname="RfmModelNotReady", alertstate="pending", model="{MODEL}"}}'
    wait_for(lambda: monitored.query(f"last_over_time(ALERTS{name}[10m])"))
    wait_for(lambda: monitored.query(f'rfm_serve_restarts_total{{what="{MODEL}"}} == 1'))
    wait_for(lambda: monitored.query(f'rfm_serve_ready{{model="{MODEL}"}} == 1'))
    wait_for(lambda: not monitored.query(f"ALERTS{name}"))
    assert not monitored.query('{alertname="RfmModelNotReady", alertstate="firing"}')
