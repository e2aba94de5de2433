# SPDX-License-Identifier: MIT
"""The rfm_* metrics on Triton's endpoint, after loads that are known to the sample."""

from __future__ import annotations

import time
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest
import tritonclient.grpc
from prometheus_client import Metric
from prometheus_client.parser import text_string_to_metric_families

import goldens
import rfm_export
from engines import load_engine, serve_config
from one_model import BriefServer
from rfm.engine.execution import Execution
from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints
from rfm.launch.repository_api import RepositoryApi
from rfm.triton_model.metrics import BUCKETS_S, PADDING_BUCKETS, SAMPLES_BUCKETS
from rfm.triton_model.request import OUTCOMES, UNKNOWN_TYPE
from rfm_client import (
    InferenceFailedError,
    InvalidSampleError,
    PreferenceSample,
    ProgressSample,
    Result,
    RewardClient,
    Sample,
    SimilaritySample,
    Trajectory,
)
from rfm_client.contract import wire
from rfm_client.contract.names import PROBE_PREFIX
from trajectories import random_trajectory

pytestmark = pytest.mark.triton

PLAIN, FILM = goldens.config("c1_t1_disc10"), goldens.config("enc_c1_t1_disc10")
MODEL, TWICE, SLOW = "rfm", "twice", "slow"  # MODEL has encoders, TWICE two instances
WIDTHS, PLAIN_WIDTHS = (48, 32), (768, 384)
TO_FAIL = "to-fail"
KEY = "0123456789abcdef"
PATIENCE_S = 30.0
TYPES = ("progress", "preference", "similarity")
HISTOGRAMS = {
    "batch_samples": SAMPLES_BUCKETS,
    "batch_padding_ratio": PADDING_BUCKETS,
    "collate_seconds": BUCKETS_S,
    "forward_seconds": BUCKETS_S,
}

Series: TypeAlias = dict[str, float]


@dataclass(frozen=True)
class Scraped:
    """All of Triton's metrics at one moment."""

    families: list[Metric]

    def value(self, name: str, **labels: str) -> float:
        """The sum of a metric's series that have these labels."""
        samples = (sample for family in self.families for sample in family.samples)
        return sum(s.value for s in samples if s.name == name and labels.items() <= s.labels.items())

    def samples(self, model: str) -> Series:
        """How many samples there were, as ``progress scored``; nothing of what there was none."""
        found = {
            f"{kind} {outcome}": self.value("rfm_samples_total", model=model, sample_type=kind, outcome=outcome)
            for kind in (*TYPES, "encode", UNKNOWN_TYPE)
            for outcome in OUTCOMES
        }
        return {key: count for key, count in found.items() if count}

    def family(self, name: str) -> Metric:
        return next(family for family in self.families if family.name == name)


@dataclass(frozen=True)
class Running:
    repository: Path
    endpoints: Endpoints
    log: Path

    def client(self, model: str = MODEL) -> RewardClient:
        return RewardClient(self.endpoints.grpc_url, model=model, retry=False)

    def scrape(self) -> Scraped:
        with urllib.request.urlopen(self.endpoints.metrics_url, timeout=PATIENCE_S) as answer:
            return Scraped(list(text_string_to_metric_families(answer.read().decode())))

    def scrape_when(self, is_so: Callable[[Scraped], bool]) -> Scraped:
        """As soon as it is: metrics are told in the background."""
        ends_s = time.monotonic() + PATIENCE_S
        while not is_so(scraped := self.scrape()):
            assert time.monotonic() < ends_s, [scraped.samples(model) for model in (MODEL, f"{MODEL}_encoder", TWICE)]
            time.sleep(0.05)
        return scraped

    def after(self, model: str, expected: Series, before: Scraped) -> Scraped:
        """When these samples, and no others, were counted since ``before``."""
        base = before.samples(model)
        counts = {key: base.get(key, 0) + expected.get(key, 0) for key in base.keys() | expected.keys()}
        return self.scrape_when(lambda scraped: scraped.samples(model) == counts)


# A request of a certain id fails.
FAILING = f"""


class TritonPythonModel(TritonPythonModel):
    def _scored(self, batch):
        self.is_to_fail = any(request.request_id.startswith("{TO_FAIL}") for request in batch)
        try:
            return super()._scored(batch)
        finally:
            self.is_to_fail = False

    def answer(self, questions, execution):
        if self.is_to_fail:
            raise ZeroDivisionError("a fault of the model's")
        return super().answer(questions, execution)
"""


def append(model: Path, code: str) -> None:
    """To the model's own."""
    file = model / "1" / "model.py"
    file.write_text(file.read_text() + code)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("metrics")
    repository, log = folder / "repository", folder / "tritonserver.log"
    rfm_export.export(FILM.checkpoint, repository, serve_config(FILM, MODEL))
    rfm_export.export(PLAIN.checkpoint, repository, replace(serve_config(PLAIN, TWICE), instances=2))
    rfm_export.export(PLAIN.checkpoint, repository, serve_config(PLAIN, SLOW))
    append(repository / SLOW, FAILING)
    with (
        log.open("wb") as lines,
        BriefServer(repository, Endpoints.free(), find_installation(), log=lines, admin_key=KEY) as server,
    ):
        yield Running(repository, server.endpoints, log)


def trajectory(seed: int, num_frames: int) -> Trajectory:
    return random_trajectory(seed, num_frames, *WIDTHS)


def film(num_frames: int = 3) -> Trajectory:
    random = np.random.default_rng(num_frames)
    return Trajectory(frames=random.integers(0, 256, (num_frames, 40, 40, 3), np.uint8), task="lift the cup")


def ask_raw(running: Running, sample_type: int, count: int, request_id: str = "") -> None:
    """One request of a foreign client."""
    tensors = wire.encode_samples([ProgressSample(trajectory(0, 2))] * count)
    tensors[wire.SAMPLE_TYPE] = np.full((count, 1), sample_type, np.uint8)
    inputs = []
    for name, array in tensors.items():
        inputs.append(
            tritonclient.grpc.InferInput(name, array.shape, tritonclient.utils.np_to_triton_dtype(array.dtype))
        )
        inputs[-1].set_data_from_numpy(array)
    with tritonclient.grpc.InferenceServerClient(running.endpoints.grpc_url.removeprefix("grpc://")) as client:
        client.infer(MODEL, inputs, request_id=request_id)


def too_long() -> Sample:
    return ProgressSample(trajectory(0, 17))


def mixed(count: int, widths: tuple[int, int] = WIDTHS) -> list[Sample]:
    made: list[Sample] = []
    for seed in range(count):
        first, second = (random_trajectory(seed + shift, 1 + (seed * 5 + shift) % 16, *widths) for shift in (0, 1))
        made.append((ProgressSample(first), PreferenceSample(first, second), SimilaritySample(first, second))[seed % 3])
    return made


def num_frames(samples: list[Sample]) -> int:
    return sum(trajectory.num_frames for sample in samples for trajectory in sample.trajectories)


def test_samples_are_counted_by_type_and_by_what_became_of_them(running: Running) -> None:
    good = mixed(12)
    before = running.scrape()
    with running.client() as client:
        for sample in good:
            client.evaluate([sample])
        for _ in range(2):
            with pytest.raises(InvalidSampleError, match="at most 16"):
                client.evaluate([too_long()])
    with pytest.raises(tritonclient.utils.InferenceServerException, match="sample_type"):
        ask_raw(running, sample_type=7, count=3)
    after = running.after(
        MODEL,
        {
            "progress scored": 4,
            "preference scored": 4,
            "similarity scored": 4,
            "progress refused": 2,
            "unknown refused": 3,
        },
        before,
    )
    assert after.value("rfm_frames_total", model=MODEL) - before.value("rfm_frames_total", model=MODEL) == num_frames(
        good
    )
    assert after.value("rfm_out_of_memory_retries_total", model=MODEL) == 0


def test_what_the_model_fails_at_is_counted_as_failed(running: Running) -> None:
    before = running.scrape()
    with running.client(SLOW) as client, pytest.raises(InferenceFailedError, match="log has the reason"):
        client.evaluate(mixed(3, PLAIN_WIDTHS), request_id=TO_FAIL)
    # Together, then each sample alone, as the client does where a request fails.
    after = running.after(SLOW, {f"{kind} failed": 2 for kind in TYPES}, before)
    assert after.value("rfm_frames_total", model=SLOW) == before.value("rfm_frames_total", model=SLOW)


def test_a_request_shares_the_fate_of_its_samples(running: Running) -> None:
    """The client asks again about each sample of a request that one of them spoils."""
    samples = [*(ProgressSample(trajectory(seed, 4)) for seed in range(3)), too_long()]
    before = running.scrape()
    with running.client() as client:
        outcomes = client.evaluate(samples, return_errors=True)
    assert isinstance(outcomes[3], InvalidSampleError)
    running.after(MODEL, {"progress refused": 4 + 1, "progress scored": 3}, before)


def test_histograms_add_up_to_what_each_execution_took(running: Running) -> None:
    """Asked one after the other, each request is an execution, and results tell its times."""
    engine = load_engine(FILM.name)
    requests = [mixed(count) for count in (1, 2, 5, 9)]
    expected_padding = 0.0
    before = running.scrape()
    results: list[Result] = []
    with running.client() as client:
        client.model_info()
        for request in requests:
            results.append(client.evaluate(request, timing=True)[0])
            execution = Execution()
            engine.evaluate(request, execution)
            assert execution.num_slots >= execution.num_tokens > num_frames(request)
            expected_padding += execution.padding_ratio
    each = {key: before.samples(MODEL).get(key, 0) for key in ("progress scored",)}
    after = running.scrape_when(
        lambda scraped: scraped.samples(MODEL).get("progress scored", 0) - each["progress scored"] == 1 + 1 + 2 + 3
    )

    def change(name: str, **labels: str) -> float:
        return after.value(f"rfm_{name}", model=MODEL, **labels) - before.value(f"rfm_{name}", model=MODEL, **labels)

    timings = [result.timing for result in results if result.timing is not None]
    assert len(timings) == len(requests)
    for name in HISTOGRAMS:
        assert change(f"{name}_count") == len(requests), name
        assert change(f"{name}_bucket", le="+Inf") == len(requests), name
    assert change("batch_samples_sum") == 1 + 2 + 5 + 9
    assert [change("batch_samples_bucket", le=le) for le in ("1", "2", "4", "8", "16")] == [1, 2, 2, 3, 4]
    assert change("batch_padding_ratio_sum") == pytest.approx(expected_padding, abs=1e-9)
    assert change("collate_seconds_sum") == pytest.approx(sum(t.collate_ms for t in timings) / 1e3, rel=1e-5)
    assert change("forward_seconds_sum") == pytest.approx(sum(t.forward_ms for t in timings) / 1e3, rel=1e-5)


def test_metrics_have_their_kinds_buckets_and_labels(running: Running) -> None:
    scraped = running.scrape()
    kinds = {"samples": "counter", "frames": "counter", "out_of_memory_retries": "counter", "forward_passes": "counter"}
    for name, kind in {**kinds, **dict.fromkeys(HISTOGRAMS, "histogram")}.items():
        assert scraped.family(f"rfm_{name}").type == kind
    instances = {MODEL: 1, f"{MODEL}_encoder": 1, TWICE: 2, SLOW: 1}
    expected = {
        (model, "1", "cpu", f"{model}_0_{number}") for model, count in instances.items() for number in range(count)
    }
    for name, buckets in HISTOGRAMS.items():
        samples = [s for s in scraped.family(f"rfm_{name}").samples if s.name.endswith("_bucket")]
        labels = ("model", "version", "device", "instance")
        assert {tuple(sample.labels[label] for label in labels) for sample in samples} == expected
        assert {float(sample.labels["le"]) for sample in samples} == {*buckets, float("inf")}
    of_one = [s.labels for s in scraped.family("rfm_samples").samples if s.labels["instance"] == f"{TWICE}_0_1"]
    assert {(labels["sample_type"], labels["outcome"]) for labels in of_one} == {
        (kind, outcome) for kind in (*TYPES, UNKNOWN_TYPE) for outcome in OUTCOMES
    }  # before there is one of them, so that the first is an increase


def test_two_instances_count_apart_and_add_up(running: Running) -> None:
    samples = mixed(60, PLAIN_WIDTHS)
    before = running.scrape()
    with running.client(TWICE) as client, ThreadPoolExecutor(len(samples)) as pool:
        list(pool.map(lambda sample: client.evaluate([sample]), samples))
    after = running.after(TWICE, {f"{kind} scored": 20 for kind in TYPES}, before)
    assert after.value("rfm_frames_total", model=TWICE) - before.value("rfm_frames_total", model=TWICE) == num_frames(
        samples
    )
    assert after.value("rfm_batch_samples_sum", model=TWICE) - before.value("rfm_batch_samples_sum", model=TWICE) == 60
    each = [after.value("rfm_samples_total", instance=f"{TWICE}_0_{number}") for number in range(2)]
    assert sum(each) == after.value("rfm_samples_total", model=TWICE)
    assert min(each) > 0


def test_raw_frames_are_counted_where_they_are_encoded_and_where_they_are_scored(running: Running) -> None:
    before = running.scrape()
    with running.client() as client:
        client.encode(film(3))
        client.progress(film(4))
        client.preference(film(2), film(5))
    after = running.after(f"{MODEL}_encoder", {"encode scored": 3}, before)
    running.after(MODEL, {"progress scored": 1, "preference scored": 1}, before)
    for name, change in {
        "rfm_frames_total": 3 + 4 + 7,
        "rfm_batch_samples_sum": 3,
        "rfm_forward_seconds_count": 3,
    }.items():
        of_encoder = [scraped.value(name, model=f"{MODEL}_encoder") for scraped in (before, after)]
        assert of_encoder[1] - of_encoder[0] == change
    assert after.value("rfm_collate_seconds_sum", model=f"{MODEL}_encoder") > 0


def test_health_probes_and_warm_up_are_not_counted(running: Running) -> None:
    before = running.scrape()
    blank = Trajectory(
        video_embeddings=np.zeros((2, WIDTHS[0]), np.float32), text_embedding=np.zeros(WIDTHS[1], np.float32)
    )
    blank_film = Trajectory(frames=np.zeros((2, 64, 64, 3), np.uint8), task="canary")
    with running.client() as client:
        for _ in range(3):
            client.progress(blank, request_id=PROBE_PREFIX)
            client.encode(blank_film, request_id=f"{PROBE_PREFIX}-probe")
        ask_raw(running, sample_type=0, count=2)  # without an id, as warm-up; but that is over
        client.encode(film())
    running.after(MODEL, {"progress scored": 2}, before)
    after = running.after(f"{MODEL}_encoder", {"encode scored": 1}, before)
    for name, change in {"batch_samples": 1, "forward_seconds": 1, "collate_seconds": 1}.items():
        counts = [scraped.value(f"rfm_{name}_count", model=MODEL) for scraped in (before, after)]
        assert counts[1] - counts[0] == change


def test_the_served_checkpoint_is_told(running: Running) -> None:
    scraped = running.scrape()
    told = [sample for sample in scraped.family("rfm_checkpoint_info").samples if sample.labels["model"] == MODEL]
    with running.client() as client:
        info = client.model_info()
    assert [(sample.value, sample.labels) for sample in told] == [
        (
            1.0,
            {
                "model": MODEL,
                "version": "1",
                "source": info.source,
                "revision": "",
                "weights_digest": info.weights_digest,
                "network": "RewindTransformer",
            },
        )
    ]
    encoder = {"model": f"{MODEL}_encoder", "network": "Encoders", "source": str(info.source)}
    assert scraped.value("rfm_checkpoint_info", **encoder) == 1


def test_a_model_that_is_loaded_again_counts_on(running: Running) -> None:
    """Unloaded, its checkpoint is served no more; loaded in place, it is."""
    sample = ProgressSample(random_trajectory(0, 3, *PLAIN_WIDTHS))
    before = running.scrape()

    def is_served(value: float) -> Callable[[Scraped], bool]:
        return lambda scraped: scraped.value("rfm_checkpoint_info", model=SLOW) == value

    with running.client(SLOW) as client, RepositoryApi(running.endpoints.grpc_url, KEY) as api:
        client.evaluate([sample])
        api.unload(SLOW)
        api.wait_gone(SLOW)
        running.after(SLOW, {"progress scored": 1}, before)  # told before it went
        running.scrape_when(is_served(0))
        api.load(SLOW)
        client.evaluate([sample])
        running.after(SLOW, {"progress scored": 2}, before)
        config = running.repository / SLOW / "config.pbtxt"
        config.write_text(
            config.read_text().replace('key: "dtype"', 'key: "other"\n  value {\n  }\n}\nparameters {\n  key: "dtype"')
        )
        api.load(SLOW)  # the new instances come before the old ones go
        client.evaluate([sample])
        running.after(SLOW, {"progress scored": 3}, before)
        running.scrape_when(is_served(1))


# What Triton refuses: another kind of metric has that name.
BROKEN = """

import rfm.triton_model.metrics as metrics

metrics._TOTALS["feature_cache_bytes"] = "A counter."
"""


def test_a_model_without_its_metrics_serves_all_the_same_and_says_so_once(tmp_path: Path) -> None:
    repository, log = tmp_path / "repository", tmp_path / "tritonserver.log"
    rfm_export.export(PLAIN.checkpoint, repository, serve_config(PLAIN, MODEL))
    append(repository / MODEL, BROKEN)
    with (
        log.open("wb") as lines,
        BriefServer(repository, Endpoints.free(), find_installation(), log=lines) as server,
        RewardClient(server.endpoints.grpc_url, model=MODEL) as client,
    ):
        for _ in range(3):
            assert len(client.evaluate(mixed(3, PLAIN_WIDTHS))) == 3
    assert log.read_text().count("metrics cannot be reported") == 1
