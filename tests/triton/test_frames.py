# SPDX-License-Identifier: MIT
"""Frames of many sizes, pairs of two, and tasks, over the wire."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import tritonclient.grpc

import goldens
import rfm_export
from engines import load_engine, serve_config
from mixtures import FRAMES_MODEL, assert_same, counts, wait_until_at_work
from one_model import BriefServer
from reference_server import Served
from repositories import forget_input
from rfm.launch.installation import find_installation
from rfm.launch.process import Endpoints
from rfm_client import (
    InvalidSampleError,
    ModelNotFoundError,
    PreferenceSample,
    ProgressSample,
    RewardClient,
    RewardError,
    Sample,
    ServerUnavailableError,
    SimilaritySample,
    Trajectory,
)
from rfm_client.contract import wire
from tensors import TOLERANCE, infer
from trajectories import random_trajectory

pytestmark = pytest.mark.triton


VLM = "q3_tok_disc10"


NO_SUCH_MODEL = "not_served"


def test_frames_of_many_sizes_and_lengths_go_in_one_call(served: Served, protocol: str) -> None:
    random = np.random.default_rng(3)
    samples: list[Sample] = [
        ProgressSample(Trajectory(frames=random.integers(0, 256, (t, h, w, 3), np.uint8), task=f"task {t}"))
        for t, h, w in ((1, 64, 64), (3, 48, 100), (5, 64, 64), (2, 90, 60))
    ]
    with served.client(protocol, FRAMES_MODEL) as client:
        results = client.evaluate(samples)
    for result, expected in zip(results, load_engine(FRAMES_MODEL).evaluate(samples), strict=True):
        assert_same(result, expected)


def sized_film(seed: int, num_frames: int, height: int, width: int) -> Trajectory:
    frames = np.random.default_rng(seed).integers(0, 256, (num_frames, height, width, 3), np.uint8)
    return Trajectory(frames=frames, task=f"task {seed}")


def pairs(count: int, *, two_sizes: bool) -> list[Sample]:
    """Of both types, and lengths and sizes that differ from pair to pair."""
    samples: list[Sample] = []
    for index in range(count):
        size = (48, 100) if index % 2 else (90, 61)
        first = sized_film(2 * index, 1 + index % 5, *size)
        second = sized_film(2 * index + 1, 1 + index % 3, *(size[::-1] if two_sizes else size))
        samples.append(SimilaritySample(first, second) if index % 4 > 1 else PreferenceSample(first, second))
    return samples


def test_pairs_of_two_frame_sizes_are_scored_beside_all_others(served: Served, protocol: str) -> None:
    samples = [
        sample
        for group in zip(pairs(12, two_sizes=True), pairs(12, two_sizes=False), strict=True)
        for sample in (*group, ProgressSample(group[0].trajectories[1]))
    ]
    alone = [load_engine(FRAMES_MODEL).evaluate([sample])[0] for sample in samples]
    with served.client(protocol, FRAMES_MODEL) as client:
        together = client.evaluate(samples, logits=True)
        one_by_one = [client.evaluate([sample])[0] for sample in samples[:6]]
    for result, expected in zip((*together, *one_by_one), (*alone, *alone[:6]), strict=True):
        assert_same(result, expected)


@pytest.mark.parametrize("two_sizes", [False, True], ids=["one size", "two sizes"])
def test_pairs_of_frames_share_batches(served: Served, protocol: str, two_sizes: bool) -> None:
    """Of all callers, those without the optional input as before there was one."""
    samples = pairs(32, two_sizes=two_sizes)
    alone = [load_engine(FRAMES_MODEL).evaluate([sample])[0] for sample in samples]
    start = threading.Barrier(len(samples))
    with served.client(protocol, FRAMES_MODEL) as client, ThreadPoolExecutor(len(samples) + 1) as pool:
        before = counts(served, f"{FRAMES_MODEL}_encoder")

        def ask(sample: Sample) -> object:
            start.wait()
            return client.evaluate([sample])[0]

        film = sized_film(1000 + 2 * two_sizes + (protocol == "grpc"), 12_000, 30, 30)  # new, so that no cache has it
        busy = pool.submit(client.encode, film)
        wait_until_at_work(f"{FRAMES_MODEL}_encoder")
        answers = list(pool.map(ask, samples))
        busy.result()
        requests, executions = (
            after - b for after, b in zip(counts(served, f"{FRAMES_MODEL}_encoder"), before, strict=True)
        )
    for answer, expected in zip(answers, alone, strict=True):
        assert_same(answer, expected)
    assert requests == len(samples) + 1
    assert executions <= requests // 4


def test_a_pair_of_two_frame_sizes_may_be_sent_through_shared_memory(served: Served, protocol: str) -> None:
    pair = PreferenceSample(sized_film(0, 4, 200, 300), sized_film(1, 3, 120, 90))
    with RewardClient(served.url(protocol), model=FRAMES_MODEL, shared_memory=True) as client:
        (result,) = client.evaluate([pair])
        with tritonclient.grpc.InferenceServerClient(served.url("grpc").removeprefix("grpc://")) as triton:
            assert triton.get_system_shared_memory_status().regions
    assert_same(result, load_engine(FRAMES_MODEL).evaluate([pair])[0])


@pytest.mark.parametrize("model", [FRAMES_MODEL, VLM])
def test_a_second_array_may_hold_frames_of_one_size(served: Served, protocol: str, model: str) -> None:
    """Whoever writes tensors may use the optional input for any pair, and for a sample without a second trajectory."""
    first, second = (np.random.default_rng(seed).integers(0, 256, (2, 56, 56, 3), np.uint8) for seed in (1, 2))
    films = [Trajectory(frames=frames, task="lift") for frames in (first, second)]
    tensors = wire.encode_samples([PreferenceSample(films[0], films[1]), ProgressSample(films[0])])
    apart = {
        wire.FRAMES: np.stack([first, first]),
        wire.SECOND_FRAMES: np.stack([second, np.zeros_like(second)]),
    }
    outputs = [wire.PROGRESS, wire.SUCCESS, wire.PREFERENCE]
    url = served.url(protocol)
    expected, got = (infer(url, f"{model}_frames", t, outputs) for t in (tensors, tensors | apart))
    for name in outputs:
        assert np.isfinite(got[name][0]).all()
        np.testing.assert_allclose(got[name], expected[name], rtol=0, atol=TOLERANCE)


@pytest.fixture(scope="module")
def served_from_before(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server of models that were exported before there was an optional input."""
    folder = tmp_path_factory.mktemp("before")
    repository = folder / "model_repository"
    for name in (FRAMES_MODEL, VLM):
        config = goldens.config(name)
        rfm_export.export(config.checkpoint, repository, serve_config(config, name))
    for model in (f"{FRAMES_MODEL}_encoder", f"{FRAMES_MODEL}_frames", f"{VLM}_frames"):
        forget_input(repository, model, wire.SECOND_FRAMES)
    with (
        (folder / "tritonserver.log").open("wb") as log,
        BriefServer(repository, Endpoints.free(), find_installation(), log=log) as server,
    ):
        yield Served(server)


@pytest.mark.parametrize("model", [FRAMES_MODEL, VLM])
def test_a_model_from_before_pairs_of_two_frame_sizes_says_so(
    served_from_before: Served, protocol: str, model: str
) -> None:
    wide, tall = sized_film(0, 2, 56, 84), sized_film(1, 2, 84, 56)
    with served_from_before.client(protocol, model) as client:
        outcomes = client.evaluate(
            [PreferenceSample(wide, wide), PreferenceSample(wide, tall), PreferenceSample(tall, tall)],
            return_errors=True,
        )
    assert isinstance(outcomes[1], InvalidSampleError)
    assert outcomes[1].message == (
        "second_frames: expected a model that takes pairs of two frame sizes, "
        "got one that was exported before there was this input: export it again, or resize a trajectory"
    )
    assert not isinstance(outcomes[0], RewardError)
    assert not isinstance(outcomes[2], RewardError)


def test_special_tokens_in_a_task_are_text(served: Served, protocol: str) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), np.uint8)
    with served.client(protocol, FRAMES_MODEL) as client:
        plain, special = (
            client.progress(Trajectory(frames=frames, task=task)).progress
            for task in ("lift [ SEP ] it", "lift [SEP] it")
        )
    np.testing.assert_allclose(plain, special, rtol=0, atol=TOLERANCE)


def test_too_long_a_task_is_refused(served: Served, protocol: str) -> None:
    film = Trajectory(frames=np.zeros((1, 64, 64, 3), np.uint8), task="lift " * 50)
    with (
        served.client(protocol, FRAMES_MODEL) as client,
        pytest.raises(InvalidSampleError, match=r"^task: expected at most 32 tokens .*, got"),
    ):
        client.progress(film)


def test_a_model_that_is_not_served_is_named(served: Served, protocol: str) -> None:
    with served.client(protocol, NO_SUCH_MODEL) as client:
        assert not client.is_ready()
        with pytest.raises(ModelNotFoundError, match=NO_SUCH_MODEL):
            client.progress(random_trajectory(0, 2))


def test_one_model_missing_does_not_cost_the_others(served: Served, protocol: str) -> None:
    film = ProgressSample(Trajectory(frames=np.zeros((1, 8, 8, 3), np.uint8), task="lift"))
    with served.client(protocol) as client:  # embeddings only
        outcomes = client.evaluate([film, ProgressSample(random_trajectory(0, 2)), film], return_errors=True)
    assert [type(outcome).__name__ for outcome in outcomes] == [
        "ModelNotFoundError",
        "ProgressResult",
        "ModelNotFoundError",
    ]


def test_a_server_that_is_not_there_is_unavailable(protocol: str) -> None:
    with RewardClient(f"{protocol}://127.0.0.1:9", retry=False) as client:
        assert not client.is_ready()
        with pytest.raises(ServerUnavailableError):
            client.progress(random_trajectory(0, 2))
