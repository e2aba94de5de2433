# SPDX-License-Identifier: MIT
"""Embeddings and frames over the wire: reference answers, mixtures, shared batches and refusals."""

from __future__ import annotations

import os
import stat
from concurrent.futures import ThreadPoolExecutor

import pytest

import goldens
from commands import own_regions
from engines import load_engine
from mixtures import FRAMES_MODEL, MODEL, assert_same, counts, mixed_samples, plug, wait_until_at_work
from rfm_client import (
    InvalidSampleError,
    PreferenceSample,
    ProgressSample,
    RewardClient,
    Sample,
    SimilaritySample,
    Trajectory,
)
from servers import Served, model_processes
from trajectories import random_trajectory
from vlm import video

pytestmark = pytest.mark.triton

VLM = "q3_tok_disc10"
MARKS = {VLM: [pytest.mark.slow], "q25_video_avg_disc10": [pytest.mark.nightly]}  # loaded for these tests
CASES = [pytest.param(case, marks=MARKS.get(case.config.name, [])) for case in goldens.SERVED_CASES]
LEAST_REGION_BYTES = 2**20  # of the Python backend, per model process


@pytest.mark.reference
@pytest.mark.parametrize("case", CASES, ids=str)  # each of the others runs on the engine
def test_a_reference_answer_of_each_kind_of_checkpoint_comes_back(
    served: Served, protocol: str, case: goldens.Case
) -> None:
    with served.client(protocol, case.config.name) as client:
        results = client.evaluate(case.samples(), logits=case.config.is_discrete)
    for result, expected in zip(results, case.expected(), strict=True):
        goldens.check(result, expected, case.tolerances)
    case.check_response(results)


def filmed_samples(count: int) -> list[Sample]:
    """Return pairs of both types with equal and different sizes, and single videos, all with different lengths."""
    samples: list[Sample] = []
    for index in range(count):
        size, task = (48, 100) if index % 2 else (90, 61), f"task {index}"
        first = video(2 * index, 1 + index % 5, *size, task)
        second = video(2 * index + 1, 1 + index % 3, *(size[::-1] if index % 4 > 1 else size), task)
        pair = PreferenceSample if index % 3 == 1 else SimilaritySample
        samples.append(pair(first, second) if index % 3 else ProgressSample(first))
    return samples


@pytest.mark.parametrize(
    ("protocol", "model", "samples"),
    [
        ("grpc", MODEL, mixed_samples(100)),
        ("http", MODEL, mixed_samples(30)),
        ("http", FRAMES_MODEL, filmed_samples(24)),
    ],
    ids=["grpc", "http", "frames"],
)
def test_any_mixture_equals_its_samples_alone(served: Served, protocol: str, model: str, samples: list[Sample]) -> None:
    with served.client(protocol, model) as client:
        together = client.evaluate(samples, logits=True)
        alone = [client.evaluate([sample])[0] for sample in samples[:6]]
    expected = [load_engine(model).evaluate([sample])[0] for sample in samples]
    for result, wanted in zip((*together, *alone), (*expected, *expected[:6]), strict=True):
        assert_same(result, wanted)


BAD = 11  # index of the refused sample


@pytest.mark.slow
@pytest.mark.parametrize(("protocol", "model"), [("grpc", MODEL), ("http", MODEL), ("http", FRAMES_MODEL)])
def test_callers_share_batches_and_a_bad_sample_fails_alone(served: Served, protocol: str, model: str) -> None:
    samples = mixed_samples(100) if model == MODEL else filmed_samples(32)
    samples[BAD] = ProgressSample(random_trajectory(0, 17) if model == MODEL else video(0, 17, 8, 8))
    expected = [load_engine(model).evaluate([sample])[0] for sample in samples]
    works = model if model == MODEL else f"{FRAMES_MODEL}_encoder"
    busy = plug() if model == MODEL else [ProgressSample(video(1000, 16, 2500, 2500))]
    with (
        RewardClient(served.url(protocol), model=model, max_in_flight=len(samples)) as client,
        served.client("http", model) as other,  # a large request would hold up those behind it on one gRPC connection
        ThreadPoolExecutor(1) as pool,
    ):
        client.evaluate(samples, return_errors=True)  # the first batches after a start were seen to be small
        before = counts(served, works)
        plugged = pool.submit(other.evaluate, busy)
        wait_until_at_work(works)
        asked = [client.submit(sample) for sample in samples]
        outcomes = [future.exception() or future.result() for future in asked]
        plugged.result()
        requests, executions = (after - b for after, b in zip(counts(served, works), before, strict=True))
    assert requests >= len(samples) - 1
    assert executions <= requests // 4
    refused = outcomes.pop(BAD)
    assert isinstance(refused, InvalidSampleError)
    assert "num_frames: expected at most 16" in str(refused)
    for outcome, wanted in zip(outcomes, [*expected[:BAD], *expected[BAD + 1 :]], strict=True):
        assert_same(outcome, wanted)


def test_a_rewound_trajectory_is_scored(served: Served) -> None:
    """The array has negative strides."""
    forwards = random_trajectory(1, 6)
    backwards = Trajectory(video_embeddings=forwards.positions[::-1], text_embedding=forwards.text_embedding)
    copied = Trajectory(video_embeddings=forwards.positions[::-1].copy(), text_embedding=forwards.text_embedding)
    with served.client("http") as client:
        assert_same(client.progress(backwards), client.progress(copied))


def test_a_load_of_an_unchanged_model_keeps_its_process(served: Served) -> None:
    before = model_processes(served.server.pid, MODEL)
    with served.api() as api:
        api.load(MODEL)
    assert model_processes(served.server.pid, MODEL) == before != []


@pytest.mark.usefixtures("served")
def test_no_other_user_can_read_the_shared_memory_of_a_server() -> None:
    found = [path.stat() for path in own_regions(os.getpid())]
    assert any(stat.S_ISREG(each.st_mode) and each.st_size >= LEAST_REGION_BYTES for each in found)
    assert {stat.S_IMODE(each.st_mode) & 0o077 for each in found} == {0}
