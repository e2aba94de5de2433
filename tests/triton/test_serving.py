# SPDX-License-Identifier: MIT
"""The real thing: tritonserver, gRPC and HTTP, every reference checkpoint."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import tritonclient.grpc

import goldens
import rfm_export
from engines import load_engine, rewind_of, serve_config
from mixtures import FRAMES_MODEL, MODEL, assert_same, counts, mixed_samples, plug
from reference_server import Served
from repositories import forget_input
from rfm.supervise.installation import find_installation
from rfm.supervise.process import Endpoints, TritonServer
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
from rfm_client.transport.calls import connect
from trajectories import random_trajectory

pytestmark = pytest.mark.triton

VLM = "q3_tok_disc10"
TOLERANCE = 1e-5
NO_SUCH_MODEL = "not_served"


@pytest.mark.reference
@pytest.mark.parametrize("case", goldens.ANSWERED, ids=str)
def test_every_reference_answer_comes_back_over_the_wire(served: Served, protocol: str, case: goldens.Case) -> None:
    with served.client(protocol, case.config.name) as client:
        results = client.evaluate(case.samples(), logits=case.config.is_discrete)
    for result, expected in zip(results, case.expected(), strict=True):
        goldens.check(result, expected, case.tolerances)
    case.check_response(results)


@pytest.mark.reference
@pytest.mark.parametrize("case", goldens.REFUSED, ids=str)
def test_too_long_a_trajectory_is_refused_with_the_limit(served: Served, protocol: str, case: goldens.Case) -> None:
    limit = rewind_of(case.config.name).network.config.max_len
    with (
        served.client(protocol, case.config.name) as client,
        pytest.raises(InvalidSampleError, match=f"at most {limit} "),
    ):
        client.evaluate(case.samples())


def test_any_mixture_equals_its_samples_alone(served: Served, protocol: str) -> None:
    samples = mixed_samples(100)
    with served.client(protocol) as client:
        together = client.evaluate(samples)
        alone = [client.evaluate([sample])[0] for sample in samples]
    for left, right in zip(together, alone, strict=True):
        assert_same(left, right)


def test_concurrent_callers_of_mixed_lengths_and_types_share_batches(served: Served, protocol: str) -> None:
    samples = mixed_samples(200)
    alone = [load_engine(MODEL).evaluate([sample])[0] for sample in samples]
    start = threading.Barrier(len(samples))
    with (
        RewardClient(served.url(protocol), model=MODEL, max_in_flight=len(samples) + 4) as client,
        ThreadPoolExecutor(len(samples) + 1) as pool,
    ):
        before = counts(served, MODEL)

        def ask(sample: Sample) -> object:
            start.wait()
            return client.evaluate([sample])[0]

        plugged = pool.submit(client.evaluate, plug())
        answers = list(pool.map(ask, samples))
        plugged.result()
        requests, executions = (after - b for after, b in zip(counts(served, MODEL), before, strict=True))
    for answer, expected in zip(answers, alone, strict=True):
        assert_same(answer, expected)
    assert requests == len(samples) + 4  # the plug is too large for one
    assert executions <= requests // 4


def test_dense_mode_scores_each_frame_on_its_prefix(served: Served, protocol: str) -> None:
    trajectory = random_trajectory(5, 9)
    assert trajectory.video_embeddings is not None
    with served.client(protocol) as client:
        dense = client.progress(trajectory, frame_steps=4)
        for t in range(9):
            picked = trajectory.video_embeddings[np.linspace(0, t, 4).astype(int)]
            prefix = Trajectory(video_embeddings=picked, text_embedding=trajectory.text_embedding)
            assert abs(client.progress(prefix).progress[-1] - dense.progress[t]) <= TOLERANCE


def test_dense_mode_takes_trajectories_longer_than_max_len(served: Served, protocol: str) -> None:
    with served.client(protocol) as client:
        assert len(client.progress(random_trajectory(6, 40), frame_steps=4).progress) == 40


def test_a_bad_sample_fails_alone(served: Served, protocol: str) -> None:
    samples = mixed_samples(9)
    samples[4] = ProgressSample(random_trajectory(0, 17))
    with served.client(protocol) as client:
        outcomes = client.evaluate(samples, return_errors=True)
    assert isinstance(outcomes[4], InvalidSampleError)
    assert str(outcomes[4]).startswith("num_frames: expected at most 16")
    for index, outcome in enumerate(outcomes):
        if index != 4:
            assert_same(outcome, load_engine(MODEL).evaluate([samples[index]])[0])
    with served.client(protocol) as client, pytest.raises(InvalidSampleError, match=r"^samples\[4\]\.num_frames: "):
        client.evaluate(samples)


def test_a_bad_request_in_a_batch_of_callers_fails_alone(served: Served, protocol: str) -> None:
    """Other callers' requests that share its batch are served."""
    samples = mixed_samples(24)
    samples[11] = ProgressSample(random_trajectory(0, 17))
    expected = load_engine(MODEL).evaluate(samples)
    start = threading.Barrier(len(samples))
    with served.client(protocol) as client, ThreadPoolExecutor(len(samples) + 1) as pool:
        before = counts(served, MODEL)

        def ask(sample: Sample) -> object:
            start.wait()
            return client.evaluate([sample], return_errors=True)[0]

        plugged = pool.submit(client.evaluate, plug())
        outcomes = list(pool.map(ask, samples))
        plugged.result()
        _, executions = (after - b for after, b in zip(counts(served, MODEL), before, strict=True))
    assert executions < len(samples) // 2
    assert isinstance(outcomes[11], InvalidSampleError)
    for index, outcome in enumerate(outcomes):
        if index != 11:
            assert_same(outcome, expected[index])


def good_tensors() -> wire.Tensors:
    pair = PreferenceSample(random_trajectory(1, 3), random_trajectory(2, 2))
    return {name: array.copy() for name, array in wire.encode_samples([pair]).items()}


def bad(**changes: object) -> wire.Tensors:
    return good_tensors() | changes  # type: ignore[return-value]


def with_value(value: float) -> np.ndarray:
    embeddings = good_tensors()[wire.VIDEO_EMBEDDINGS]
    embeddings[0, 1, 7] = value
    return embeddings


int32 = np.int32
BAD_TENSORS = {
    "unknown sample type": (
        bad(sample_type=np.array([[3]], np.uint8)),
        r"^sample_type: expected one of 0 \(progress\), 1 \(preference\), 2 \(similarity\), got 3$",
    ),
    "NaN": (
        bad(video_embeddings=with_value(np.nan)),
        r"^video_embeddings: expected finite values, got nan at \[1, 7\]$",
    ),
    "Inf": (
        bad(video_embeddings=with_value(np.inf)),
        r"^video_embeddings: expected finite values, got inf at \[1, 7\]$",
    ),
    "wrong D": (bad(video_embeddings=np.ones((1, 5, 7), np.float32)), r"video_embeddings.*[Ee]xpected.*768.*got.*7"),
    "wrong Dt": (bad(text_embedding=np.ones((1, 7), np.float32)), r"text_embedding.*[Ee]xpected.*384.*got.*7"),
    "more frames told than sent": (
        bad(num_frames=np.array([[3, 3]], int32)),
        r"^num_frames: expected at most the 5 frames in video_embeddings, got 6$",
    ),
    "fewer frames told than sent": (
        bad(num_frames=np.array([[3, 1]], int32)),
        r"^video_embeddings: expected zeros behind the 4 frames that num_frames tells, got other values$",
    ),
    "empty second trajectory": (
        bad(num_frames=np.array([[5, 0]], int32)),
        r"^num_frames: expected at least one frame of each of the two trajectories, got \[5, 0\]$",
    ),
    "negative length": (
        bad(num_frames=np.array([[-1, 6]], int32)),
        r"^num_frames: expected at least one frame of each of the two trajectories, got \[-1, 6\]$",
    ),
    "second trajectory in a progress sample": (
        bad(sample_type=np.array([[0]], np.uint8)),
        r"^num_frames: expected \[at least 1, 0\] for progress, got \[3, 2\]$",
    ),
    "empty trajectory": (
        bad(sample_type=np.array([[0]], np.uint8), num_frames=np.array([[0, 0]], int32)),
        r"^num_frames: expected \[at least 1, 0\] for progress, got \[0, 0\]$",
    ),
    "dense mode of one frame": (
        bad(
            sample_type=np.array([[0]], np.uint8),
            num_frames=np.array([[5, 0]], int32),
            frame_steps=np.array([[1]], int32),
        ),
        r"^frame_steps: expected 0 or a whole number from 2 to 4096, got 1$",
    ),
    "dense mode of a pair": (
        bad(frame_steps=np.array([[4]], int32)),
        r"^frame_steps: expected 0 unless the sample is of type progress, got 4$",
    ),
    "dense mode beyond max_len": (
        bad(
            sample_type=np.array([[0]], np.uint8),
            num_frames=np.array([[5, 0]], int32),
            frame_steps=np.array([[17]], int32),
        ),
        r"^frame_steps: expected at most 16 \(max_len of this checkpoint.*\), got 17$",
    ),
}


@pytest.mark.parametrize(("tensors", "message"), BAD_TENSORS.values(), ids=BAD_TENSORS)
def test_bad_tensors_are_refused_with_what_was_expected(
    served: Served, protocol: str, tensors: wire.Tensors, message: str
) -> None:
    url = served.url(protocol)
    with pytest.raises(InvalidSampleError, match=message):
        infer(url, MODEL, tensors, [wire.PROGRESS])
    assert infer(url, MODEL, good_tensors(), [wire.PROGRESS])[wire.PROGRESS].shape == (1, 5)


def test_no_frames_at_all_are_refused(served: Served, protocol: str) -> None:
    empty = bad(video_embeddings=np.ones((1, 0, 768), np.float32), num_frames=np.array([[0, 0]], int32))
    with pytest.raises(InvalidSampleError, match=r"^num_frames: expected at least one frame of each .*, got \[0, 0\]$"):
        infer(served.url(protocol), MODEL, empty, [wire.PROGRESS])


FRAMES = np.ones((1, 5, 8, 6, 3), np.uint8)
QUESTION: wire.Tensors = {
    wire.SAMPLE_TYPE: np.array([[1]], np.uint8),
    wire.NUM_FRAMES: np.array([[3, 2]], int32),
    wire.FRAME_STEPS: np.array([[0]], int32),
    wire.FRAMES: FRAMES,
    wire.TASK: np.array([[b"lift"]], np.object_),
}
BAD_FRAMES: dict[str, tuple[wire.Tensors, str]] = {
    "bytes that are no text": ({wire.TASK: np.array([[b"\xff\xfe"]], np.object_)}, "^task: expected UTF-8 text, got"),
    "no task": ({wire.TASK: np.array([[b" "]], np.object_)}, "task: expected a task sentence.*, got ' '$"),
    "more frames told than sent": ({wire.NUM_FRAMES: np.array([[3, 3]], int32)}, "^num_frames: expected at most the 5"),
    "fewer frames told than sent": (
        {wire.NUM_FRAMES: np.array([[2, 2]], int32)},
        "^frames: expected zeros behind the 4",
    ),
    "a negative length": ({wire.NUM_FRAMES: np.array([[-1, 6]], int32)}, "^num_frames: expected .*at least 1"),
    "unknown sample type": ({wire.SAMPLE_TYPE: np.array([[9]], np.uint8)}, "^sample_type: expected one of"),
    "no pixels": ({wire.FRAMES: FRAMES[:, :, :0]}, "^frames: expected at least one frame of at least one pixel"),
    "four channels": ({wire.FRAMES: np.ones((1, 5, 8, 6, 4), np.uint8)}, "[Ee]xpected.*3.*got.*4"),
    "a sliver": (
        {wire.FRAMES: np.ones((1, 5, 2, 200, 3), np.uint8)},
        "^frames: expected frames at most 50 times as long",
    ),
    "more second frames told than sent": (
        {wire.FRAMES: FRAMES[:, :3], wire.SECOND_FRAMES: FRAMES[:, :1]},
        "^num_frames: expected at most the 1 frames in second_frames, got 2$",
    ),
    "fewer second frames told than sent": (
        {wire.FRAMES: FRAMES[:, :3], wire.SECOND_FRAMES: FRAMES},
        "^second_frames: expected zeros behind the 2",
    ),
    "first frames behind those told, beside second ones": (
        {wire.SECOND_FRAMES: FRAMES[:, :2]},
        "^frames: expected zeros behind the 3",
    ),
    "a second sliver": (
        {wire.FRAMES: FRAMES[:, :3], wire.SECOND_FRAMES: np.ones((1, 2, 200, 2, 3), np.uint8)},
        "^frames: expected frames at most 50 times as long as wide, got 200 x 2$",
    ),
    "four channels in the second": ({wire.SECOND_FRAMES: np.ones((1, 2, 8, 6, 4), np.uint8)}, "[Ee]xpected.*3.*got.*4"),
    "too many frames": (
        {wire.FRAMES: np.ones((1, 19, 8, 6, 3), np.uint8), wire.NUM_FRAMES: np.array([[2, 17]], int32)},
        "^num_frames: expected at most 16 .*, got 17$",
    ),
}


@pytest.mark.parametrize(("changes", "message"), BAD_FRAMES.values(), ids=BAD_FRAMES)
def test_bad_frames_are_refused_with_what_was_expected(
    served: Served, protocol: str, changes: wire.Tensors, message: str
) -> None:
    url = served.url(protocol)
    with pytest.raises(InvalidSampleError, match=message):
        infer(url, f"{FRAMES_MODEL}_frames", QUESTION | changes, [wire.PROGRESS])
    assert infer(url, f"{FRAMES_MODEL}_frames", QUESTION, [wire.PROGRESS])[wire.PROGRESS].shape == (1, 5)


def test_samples_of_another_width_do_not_cost_the_others(served: Served, protocol: str) -> None:
    good = ProgressSample(random_trajectory(1, 3))
    samples = [
        good,
        ProgressSample(random_trajectory(1, 3, 768, 7)),
        ProgressSample(random_trajectory(1, 3, 5, 384)),
        good,
    ]
    with served.client(protocol) as client:
        outcomes = client.evaluate(samples, return_errors=True)
    assert_same(outcomes[0], outcomes[3])
    assert [type(outcome) for outcome in outcomes[1:3]] == [InvalidSampleError] * 2


def test_a_rewound_trajectory_is_scored(served: Served, protocol: str) -> None:
    forwards = random_trajectory(1, 6)
    backwards = Trajectory(video_embeddings=forwards.positions[::-1], text_embedding=forwards.text_embedding)
    copied = Trajectory(video_embeddings=forwards.positions[::-1].copy(), text_embedding=forwards.text_embedding)
    with served.client(protocol) as client:
        assert_same(client.progress(backwards), client.progress(copied))
    assert_same(*load_engine(MODEL).evaluate([ProgressSample(backwards), ProgressSample(copied)]))


def test_a_checkpoint_without_similarity_says_so(served: Served, protocol: str) -> None:
    pair = random_trajectory(1, 2), random_trajectory(2, 2)
    message = "sample_type: expected progress or preference .*no similarity head.*, got similarity"
    with served.client(protocol, "robometer_c1_t1_disc10") as client, pytest.raises(InvalidSampleError, match=message):
        client.similarity(*pair)


def test_what_was_not_asked_is_nan_on_the_wire(served: Served, protocol: str) -> None:
    samples = [
        ProgressSample(random_trajectory(1, 2)),
        PreferenceSample(random_trajectory(2, 1), random_trajectory(3, 3)),
    ]
    outputs = [wire.PROGRESS, wire.SUCCESS, wire.PREFERENCE, wire.SIMILARITY, wire.PROGRESS_LOGITS, wire.TIMING_MS]
    tensors = infer(served.url(protocol), MODEL, wire.encode_samples(samples), outputs)
    assert np.isnan(tensors[wire.PROGRESS]).tolist() == [[False, False, True, True], [False] * 4]
    assert np.isnan(tensors[wire.SUCCESS]).tolist() == [[False, False, True, True], [False] * 4]
    assert np.isnan(tensors[wire.PROGRESS_LOGITS][0]).all(axis=-1).tolist() == [False, False, True, True]
    assert np.isnan(tensors[wire.PREFERENCE]).tolist() == [[True], [False]]
    assert np.isnan(tensors[wire.SIMILARITY]).all()
    assert (tensors[wire.TIMING_MS] > 0).all()
    assert {array.dtype for array in tensors.values()} == {np.dtype(np.float32)}


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

        busy = pool.submit(client.encode, sized_film(0, 3000, 30, 30))
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
        TritonServer(repository, Endpoints.free(), find_installation(), log=log) as server,
    ):
        yield Served(repository, server.endpoints)


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


def infer(url: str, model: str, tensors: wire.Tensors, outputs: list[str]) -> wire.Tensors:
    """The tensors as they stand, right or wrong, in one request."""

    async def ask() -> wire.Tensors:
        transport = connect(url)
        try:
            return (await transport.infer(model, tensors, outputs, timeout_s=30)).tensors
        finally:
            await transport.close()

    return asyncio.run(ask())
