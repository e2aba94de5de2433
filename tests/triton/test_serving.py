# SPDX-License-Identifier: MIT
"""Embeddings and frames over the wire: reference answers, mixtures, shared batches and refusals."""

from __future__ import annotations

import os
import stat
from concurrent.futures import ThreadPoolExecutor

import grpc
import numpy as np
import pytest
import tritonclient.grpc
from tritonclient.grpc import service_pb2, service_pb2_grpc
from tritonclient.utils import np_to_triton_dtype

import goldens
from commands import own_regions
from engines import load_engine
from mixtures import FRAMES_MODEL, MODEL, assert_same, counts, infer, mixed_samples, plug, wait_until_at_work
from rfm_client import (
    InvalidSampleError,
    PreferenceSample,
    ProgressSample,
    RewardClient,
    Sample,
    SimilaritySample,
    Trajectory,
)
from rfm_client.contract.wire import Tensors, encode_samples
from servers import Served, model_processes
from tolerances import TOLERANCE
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


def embedded() -> Tensors:
    pair = PreferenceSample(random_trajectory(1, 3), random_trajectory(2, 2))
    return {name: array.copy() for name, array in encode_samples([pair]).items()}


WITH_NAN = embedded()["video_embeddings"]
WITH_NAN[0, 1, 7] = np.nan
FRAMES = np.ones((1, 5, 8, 6, 3), np.uint8)
QUESTION: Tensors = {
    "sample_type": np.array([[1]], np.uint8),
    "num_frames": np.array([[3, 2]], np.int32),
    "frame_steps": np.array([[0]], np.int32),
    "frames": FRAMES,
    "task": np.array([[b"lift"]], np.object_),
}


def second(count: int) -> Tensors:
    """Return the second trajectory's frames in a separate array."""
    return {"frames": FRAMES[:, :3], "second_frames": FRAMES[:, :count]}


BAD_EMBEDDINGS: dict[str, tuple[Tensors, str]] = {
    "NaN": ({"video_embeddings": WITH_NAN}, r"^video_embeddings: expected finite values, got nan at \[1, 7\]$"),
    "dense mode beyond max_len": (
        encode_samples([ProgressSample(random_trajectory(1, 5), 17)]),
        r"^frame_steps: expected at most 16 \(max_len of this checkpoint.*\), got 17$",
    ),
}

BAD_FRAMES: dict[str, tuple[Tensors, str]] = {
    "bytes that are no text": ({"task": np.array([[b"\xff\xfe"]], np.object_)}, "^task: expected UTF-8 text, got"),
    "no pixels": ({"frames": FRAMES[:, :, :0]}, "^frames: expected at least one frame of at least one pixel"),
    "more second frames told than sent": (second(1), "^num_frames: expected at most the 1 frames in second_frames"),
    "fewer second frames told than sent": (second(5), "^second_frames: expected zeros behind the 2"),
    "first frames behind those told": ({**second(2), "frames": FRAMES}, "^frames: expected zeros behind the 3"),
}


@pytest.mark.parametrize("name", [*BAD_EMBEDDINGS, *BAD_FRAMES])
def test_invalid_inputs_are_refused_with_the_expected_values(served: Served, name: str) -> None:
    is_video = name in BAD_FRAMES
    changes, message = BAD_FRAMES[name] if is_video else BAD_EMBEDDINGS[name]
    model, question = (f"{FRAMES_MODEL}_frames", QUESTION) if is_video else (MODEL, embedded())
    with pytest.raises(InvalidSampleError, match=message):
        infer(served.url("grpc"), model, question | changes, ["progress"])


@pytest.mark.parametrize(
    "model", [MODEL, f"{FRAMES_MODEL}_encoder", pytest.param(f"{VLM}_frames", marks=pytest.mark.slow)]
)
def test_a_batch_of_no_samples_is_refused(served: Served, model: str) -> None:
    """Triton lets the request pass if the bytes fit a single sample, which an ensemble then scores."""
    served.has(VLM if model.startswith(VLM) else model)
    question = embedded() if model == MODEL else {**QUESTION, "task": np.array([[4, 0, 0, 0, *b"lift"]], np.uint8)}
    if model.endswith("_encoder"):
        question = {name: question[name] for name in ("num_frames", "frames", "task")}
    request = service_pb2.ModelInferRequest(model_name=model)
    for name, array in question.items():
        is_text, axes = name == "task", [1] if name == "task" else array.shape[1:]
        datatype = "BYTES" if is_text else np_to_triton_dtype(array.dtype)
        request.inputs.add(name=name, datatype=datatype, shape=[0, *axes])
        request.raw_input_contents.append(array.tobytes())
    address = served.url("grpc").removeprefix("grpc://")
    with grpc.insecure_channel(address) as channel, pytest.raises(grpc.RpcError) as refused:
        service_pb2_grpc.GRPCInferenceServiceStub(channel).ModelInfer(request)
    assert refused.value.code() == grpc.StatusCode.INVALID_ARGUMENT, refused.value


def test_a_rewound_trajectory_is_scored(served: Served) -> None:
    """The array has negative strides."""
    forwards = random_trajectory(1, 6)
    backwards = Trajectory(video_embeddings=forwards.positions[::-1], text_embedding=forwards.text_embedding)
    copied = Trajectory(video_embeddings=forwards.positions[::-1].copy(), text_embedding=forwards.text_embedding)
    with served.client("http") as client:
        assert_same(client.progress(backwards), client.progress(copied))


def test_a_pair_of_two_frame_sizes_may_be_sent_through_shared_memory(served: Served, protocol: str) -> None:
    pair = PreferenceSample(video(0, 4, 200, 300), video(1, 3, 120, 90))
    with RewardClient(served.url(protocol), model=FRAMES_MODEL, shared_memory=True) as client:
        (result,) = client.evaluate([pair])
        with tritonclient.grpc.InferenceServerClient(served.url("grpc").removeprefix("grpc://")) as triton:
            assert triton.get_system_shared_memory_status().regions
    assert_same(result, load_engine(FRAMES_MODEL).evaluate([pair])[0])


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


@pytest.mark.parametrize("model", [FRAMES_MODEL, pytest.param(VLM, marks=pytest.mark.slow)])
def test_a_second_array_may_hold_frames_of_one_size(served: Served, model: str) -> None:
    """Tensors may use the optional input for any pair, and for a sample without a second trajectory."""
    first, second = (video(seed, 2, 56, 56) for seed in (1, 2))
    tensors = encode_samples([PreferenceSample(first, second), ProgressSample(first)])
    apart = {
        "frames": np.stack([first.positions, first.positions]),
        "second_frames": np.stack([second.positions, np.zeros_like(second.positions)]),
    }
    outputs = ["progress", "success", "preference"]
    served.has(model)
    url = served.url("http")
    expected, got = (infer(url, f"{model}_frames", t, outputs) for t in (tensors, tensors | apart))
    for name in outputs:
        assert np.isfinite(got[name][0]).all()
        np.testing.assert_allclose(got[name], expected[name], rtol=0, atol=TOLERANCE)
