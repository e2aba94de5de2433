# SPDX-License-Identifier: MIT
from __future__ import annotations

import asyncio
import math
import os
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from typer.testing import CliRunner

import goldens
import rfm_export
from engines import serve_config
from rfm.config import ExportConfig
from rfm.launch.temporary import temporary_server
from rfm_client import ProgressSample, RewardClient, Sample
from rfm_commands import tune
from rfm_commands.cli import app
from rfm_commands.config import Config, File
from rfm_commands.tune import Setting, Sweep, Trial, quickest, write_setting
from rfm_export import ExportError
from trajectories import random_trajectory

pytestmark = [pytest.mark.triton, pytest.mark.slow]

ONE, TWO, FOUR = Setting(1, 4, 64), Setting(2, 2, 64), Setting(4, 1, 64)


@pytest.fixture(scope="module")
def repository(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tuned") / "model_repository"
    config = goldens.config("c1_t1_disc10")
    rfm_export.export(config.checkpoint, folder, serve_config(config))
    return folder


@pytest.mark.parametrize(
    ("trials", "expected"),
    [
        ([Trial(ONE, 100.0, 7.0), Trial(TWO, 200.0, 9.0)], TWO),
        ([Trial(ONE, 200.0, 9.0), Trial(TWO, 100.0, 7.0)], ONE),
        ([Trial(ONE, 98.0, 7.0), Trial(TWO, 100.0, 9.0)], ONE),
        ([Trial(ONE, 90.0, 7.0), Trial(TWO, 98.0, 8.0), Trial(FOUR, 100.0, 9.0)], TWO),
    ],
    ids=["faster", "faster with fewer", "as fast, and one caller waits less", "of those that are as fast"],
)
def test_the_quickest_of_the_fastest_settings_is_best(trials: list[Trial], expected: Setting) -> None:
    assert quickest(trials).setting == expected


def test_every_setting_is_served_and_measured(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tune, "BATCH_SIZES", (8, 64))
    before = {file: file.read_bytes() for file in repository.rglob("*") if file.is_file()}
    told: list[str] = []
    best = Sweep(repository, "rfm", callers=4, seconds=0.3, rounds=1, report=told.append).best()
    cores = len(os.sched_getaffinity(0))
    settings = [Setting(count, cores // count, 64) for count in (1, 2, 4, 8, 16, 32, 64) if count <= cores]
    settings += [Setting(1, 1, 64)] if cores > 1 else []
    assert best in [*settings, *(Setting(s.instances, s.torch_threads, 8) for s in settings)]
    assert len(told) == len(settings) + 1  # of the two batch sizes one is the repository's
    assert {file: file.read_bytes() for file in repository.rglob("*") if file.is_file()} == before


class Lagging:
    """A client of which the clock tells how long it takes: 10 s to connect, and each answer 0.4 s."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 0.0
        monkeypatch.setattr(tune, "time", SimpleNamespace(perf_counter=lambda: self.now_s))
        monkeypatch.setattr(tune, "AsyncRewardClient", lambda *_, **__: self)

    async def __aenter__(self) -> Lagging:
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    async def score(self, sample: Sample) -> None:
        self.now_s += 0.4 if self.now_s else 10.0


@pytest.mark.parametrize(("seconds", "count"), [(1.0, 2), (0.4, 1), (4.2, 10)])
def test_only_what_is_answered_in_time_is_counted(monkeypatch: pytest.MonkeyPatch, seconds: float, count: int) -> None:
    Lagging(monkeypatch)
    latencies_s = asyncio.run(
        tune._measure_latencies("", "rfm", repeat(ProgressSample(random_trajectory(0, 1))), 1, seconds)
    )
    assert latencies_s == pytest.approx([0.4] * count)


def test_a_setting_that_answers_nobody_in_time_is_the_slowest(monkeypatch: pytest.MonkeyPatch) -> None:
    Lagging(monkeypatch)
    assert (
        asyncio.run(tune._measure_latencies("", "rfm", repeat(ProgressSample(random_trajectory(0, 1))), 1, 0.3)) == []
    )
    slow, slower = Trial(ONE, 0.5, 2000.0), Trial(TWO, 0.0, math.inf)
    assert quickest([slower, slow]) == slow
    with pytest.raises(ExportError, match=r"--seconds: expected time for an answer, got none in time with any setting"):
        quickest([slower, slower])


def test_the_command_writes_what_export_reads(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Sweep, "best", lambda self: TWO)  # measured above
    config, output = tmp_path / "serve.yaml", tmp_path / "tuned.yaml"
    config.write_text("num_gpus: 0\ninstances: 1\nserver_port: 8010\n")
    words = ["tune", "--repository", str(repository), "--config", str(config), "--output", str(output)]
    assert CliRunner().invoke(app, words).exit_code == 0
    assert yaml.safe_load(output.read_text()) == {
        "export": {"num_gpus": 0, "instances": 2, "torch_threads": 2, "max_batch_size": 64},
        "serve": {"http_port": 8010},
    }
    assert Config.from_yaml(output).export == ExportConfig(num_gpus=0, instances=2, torch_threads=2, max_batch_size=64)


def test_without_a_configuration_only_the_measured_keys_are_written(tmp_path: Path) -> None:
    write_setting(FOUR, tmp_path / "tuned.yaml", File())
    expected = Config(ExportConfig(instances=4, torch_threads=1, max_batch_size=64))
    assert Config.from_yaml(tmp_path / "tuned.yaml") == expected


def test_what_is_no_repository_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ExportError, match=r"repository: expected a folder of models, got .*: rfm export --checkpoint .* writes them"
    ):
        Sweep(tmp_path, "rfm").best()


def test_two_instances_score_as_one(repository: Path, tmp_path: Path) -> None:
    config = goldens.config("c1_t1_disc10")
    rfm_export.export(config.checkpoint, tmp_path / "two", replace(serve_config(config), instances=2, torch_threads=0))
    trajectories = [random_trajectory(seed, 5) for seed in range(8)]
    answers = []
    for folder in (repository, tmp_path / "two"):
        with temporary_server(folder, tmp_path / "triton.log") as endpoints, RewardClient(endpoints.grpc_url) as client:
            answers.append([client.progress(trajectory).last_progress for trajectory in trajectories])
    assert answers[0] == pytest.approx(answers[1], abs=1e-5)
