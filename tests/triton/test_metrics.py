# SPDX-License-Identifier: MIT
"""The rfm_* metrics on Triton's endpoint, after loads that are known to the sample."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import httpx
import numpy as np
import pytest
from prometheus_client import Metric
from prometheus_client.parser import text_string_to_metric_families

import goldens
import rfm_export
from engines import serve_config
from mixtures import TOLD_S, infer, mixed_samples
from repositories import FAILING, FAILING_STEPS, make_repository
from rfm.serve.installation import Installation, find_installation
from rfm.triton_model.metrics import BUCKETS_S, PADDING_BUCKETS, SAMPLES_BUCKETS
from rfm.triton_model.request import OUTCOMES, UNKNOWN_TYPE
from rfm_client import InferenceFailedError, InvalidSampleError, ProgressSample, RewardClient, Trajectory
from rfm_client.contract import wire
from servers import RepositoryApi, Served, start_triton, wait_for
from trajectories import random_trajectory

pytestmark = pytest.mark.triton

PLAIN = goldens.config("c1_t1_disc10")
FILMED = "enc_c1_t1_disc10"
MODEL, TWICE = PLAIN.name, "twice"  # which has two instances
TYPES = ("progress", "preference", "similarity")
HISTOGRAMS = {
    "batch_samples": SAMPLES_BUCKETS,
    "batch_padding_ratio": PADDING_BUCKETS,
    "collate_seconds": BUCKETS_S,
    "forward_seconds": BUCKETS_S,
}


@dataclass(frozen=True)
class Scraped:
    """Triton's metrics at a moment."""

    families: list[Metric]

    def value(self, name: str, **labels: str) -> float:
        """Return the sum of a metric's series with these labels."""
        samples = (sample for family in self.families for sample in family.samples)
        return sum(s.value for s in samples if s.name == f"rfm_{name}" and labels.items() <= s.labels.items())

    def family(self, name: str) -> Metric:
        return next(family for family in self.families if family.name == f"rfm_{name}")


def scrape(served: Served, told_s: float = TOLD_S) -> Scraped:
    """Return Triton's metrics ``told_s`` from now, which cover all finished requests."""
    time.sleep(told_s)
    return Scraped(list(text_string_to_metric_families(httpx.get(served.endpoints.metrics_url).text)))


def counted(after: Scraped, before: Scraped, model: str) -> dict[str, float]:
    """How many samples there were in between, as ``progress scored``; and ``frames``."""

    def change(name: str, **labels: str) -> float:
        return after.value(name, model=model, **labels) - before.value(name, model=model, **labels)

    found = {
        f"{kind} {outcome}": change("samples_total", sample_type=kind, outcome=outcome)
        for kind in (*TYPES, "encode", UNKNOWN_TYPE)
        for outcome in OUTCOMES
    }
    return {key: count for key, count in {**found, "frames": change("frames_total")}.items() if count}


@pytest.fixture(scope="module")
def served_too(served: Served) -> Iterator[Served]:
    """The shared server with a model of this file."""
    rfm_export.export(PLAIN.checkpoint, served.repository, replace(serve_config(PLAIN, TWICE), instances=2))
    file = served.repository / TWICE / "1" / "model.py"
    file.write_text(file.read_text() + FAILING)
    with served.api() as api:
        api.load(TWICE)
        yield served
        api.unload(TWICE)


def client(served: Served, model: str) -> RewardClient:
    return RewardClient(served.url("grpc"), model=model, retry=False)


@pytest.mark.slow
def test_samples_are_counted_by_type_and_outcome_in_each_of_two_instances(served_too: Served) -> None:
    """Failures are counted, too: in a batch, then alone, as the client asks again."""
    samples = mixed_samples(60)
    before = scrape(served_too)
    with client(served_too, TWICE) as asked, ThreadPoolExecutor(len(samples)) as pool:
        list(pool.map(lambda sample: asked.evaluate([sample]), samples))
        for _ in range(2):
            with pytest.raises(InvalidSampleError, match="at most 16"):
                asked.evaluate([ProgressSample(random_trajectory(0, 17))])
        with pytest.raises(InferenceFailedError, match="log has the reason"):
            asked.evaluate([ProgressSample(random_trajectory(0, 8), frame_steps=FAILING_STEPS)])
    foreign = wire.encode_samples([samples[0]] * 3) | {wire.SAMPLE_TYPE: np.full((3, 1), 7, np.uint8)}
    with pytest.raises(InvalidSampleError, match="sample_type"):
        infer(served_too.url("grpc"), TWICE, foreign, [wire.PROGRESS])
    scored = dict.fromkeys((f"{kind} scored" for kind in TYPES), 20.0)
    num_frames = sum(trajectory.num_frames for sample in samples for trajectory in sample.trajectories)
    others = {"progress refused": 2, "unknown refused": 3, "progress failed": 1}
    after = scrape(served_too)
    assert counted(after, before, TWICE) == {**scored, **others, "frames": num_frames}
    each = [after.value("samples_total", instance=f"{TWICE}_0_{number}") for number in range(2)]
    assert sum(each) == after.value("samples_total", model=TWICE) == 66
    assert after.value("batch_samples_sum", model=TWICE) == 60
    assert min(each) > 0


@pytest.mark.slow
def test_metrics_have_their_kinds_buckets_and_labels(served_too: Served) -> None:
    scraped = scrape(served_too, 0)
    counters = ("samples", "frames", "out_of_memory_retries", "forward_passes")
    for name, kind in {**dict.fromkeys(counters, "counter"), **dict.fromkeys(HISTOGRAMS, "histogram")}.items():
        assert scraped.family(name).type == kind
    expected = {(TWICE, "1", "cpu", f"{TWICE}_0_{number}") for number in range(2)}
    for name, buckets in HISTOGRAMS.items():
        samples = [s for s in scraped.family(name).samples if s.name.endswith("_bucket") and s.labels["model"] == TWICE]
        labels = ("model", "version", "device", "instance")
        assert {tuple(sample.labels[label] for label in labels) for sample in samples} == expected
        assert {float(sample.labels["le"]) for sample in samples} == {*buckets, float("inf")}
    of_one = [s.labels for s in scraped.family("samples").samples if s.labels["instance"] == f"{TWICE}_0_1"]
    assert {(labels["sample_type"], labels["outcome"]) for labels in of_one} == {
        (kind, outcome) for kind in (*TYPES, UNKNOWN_TYPE) for outcome in OUTCOMES
    }  # before the first, which must count as an increase


@pytest.mark.slow
def test_raw_frames_are_counted_where_they_are_encoded_and_where_they_are_scored(served: Served) -> None:
    def video(count: int) -> Trajectory:
        random = np.random.default_rng(count)
        return Trajectory(frames=random.integers(0, 256, (count, 40, 40, 3), np.uint8), task="lift the cup")

    before = scrape(served)
    with client(served, FILMED) as asked:
        asked.encode(video(3))
        asked.progress(video(4))
        asked.preference(video(2), video(5))
    after = scrape(served)
    assert counted(after, before, f"{FILMED}_encoder") == {"encode scored": 3, "frames": 3 + 4 + 7}
    assert counted(after, before, FILMED) == {"progress scored": 1, "preference scored": 1, "frames": 4 + 7}


@pytest.mark.nightly
def test_a_model_that_is_loaded_again_counts_on(served_too: Served) -> None:
    """An unloaded checkpoint is served no more; one loaded in place is."""
    sample = ProgressSample(random_trajectory(0, 3))
    before = scrape(served_too)

    def shows(value: float) -> Callable[[], bool]:
        return lambda: scrape(served_too, 0).value("checkpoint_info", model=TWICE) == value

    with client(served_too, TWICE) as asked, served_too.api() as api:
        asked.evaluate([sample])
        api.unload(TWICE)
        api.wait_gone(TWICE)
        wait_for(shows(0))
        assert counted(scrape(served_too, 0), before, TWICE) == {"progress scored": 1, "frames": 3}  # told before
        api.load(TWICE)
        asked.evaluate([sample])
        config = served_too.repository / TWICE / "config.pbtxt"
        other = 'key: "other"\n  value {\n  }\n}\nparameters {\n  key: "dtype"'
        config.write_text(config.read_text().replace('key: "dtype"', other))
        api.load(TWICE)  # the new instances come before the old ones go
        asked.evaluate([sample])
        wait_for(shows(1))
        assert counted(scrape(served_too), before, TWICE) == {"progress scored": 3, "frames": 9}


class Recorded(Installation):
    """The wheel's Triton, which writes the exit status of each model process to ``file``."""

    file: Path

    def lay_out_backends(self, folder: Path) -> list[str]:
        arguments = super().lay_out_backends(folder)
        stub = folder / "python" / "triton_python_backend_stub"
        program = stub.readlink()
        stub.unlink()
        tell = f"status=$?; test $# = 0 || echo $status >> {self.file}"  # Triton first tries it without arguments
        stub.write_text(f'#!/bin/sh\n{program} "$@"\n{tell}\n')
        stub.chmod(0o755)
        return arguments


@pytest.mark.slow
def test_the_process_of_an_unloaded_model_does_not_crash(tmp_path: Path) -> None:
    """The Python backend's metrics do not bear to be destroyed at the end, nor do its requests."""
    question = wire.encode_samples([ProgressSample(random_trajectory(0, 3, 64, 32))])
    question[wire.SAMPLE_TYPE] = np.array([[9]], np.uint8)
    wheel, Recorded.file = find_installation(), tmp_path / "statuses"
    program = Recorded(wheel.executable, wheel.environment, wheel.wheel)
    with (
        start_triton(make_repository(tmp_path), program) as server,
        RepositoryApi(server.endpoints.grpc_url, server.admin_key) as api,
    ):
        with pytest.raises(InvalidSampleError):
            infer(server.endpoints.grpc_url, "rfm", question, ["progress"])
        api.unload("rfm")
        wait_for(Recorded.file.exists)
        assert Recorded.file.read_text() == "0\n"
