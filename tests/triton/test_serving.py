# SPDX-License-Identifier: MIT
"""Reference answers, mixtures and refusals over the wire."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import goldens
from engines import load_engine, rewind_of
from mixtures import FRAMES_MODEL, MODEL, assert_same, counts, mixed_samples, plug, wait_until_at_work
from reference_server import Served
from rfm_client import (
    InvalidSampleError,
    PreferenceSample,
    ProgressSample,
    RewardClient,
    Sample,
    Trajectory,
)
from rfm_client.contract import wire
from tensors import TOLERANCE, infer
from trajectories import random_trajectory

pytestmark = pytest.mark.triton


@pytest.mark.reference
@pytest.mark.parametrize("case", goldens.SERVED_CASES, ids=str)
def test_a_reference_answer_of_each_checkpoint_comes_back_over_the_wire(
    served: Served, protocol: str, case: goldens.Case
) -> None:
    with served.client(protocol, case.config.name) as client:
        results = client.evaluate(case.samples(), logits=case.config.is_discrete)
    for result, expected in zip(results, case.expected(), strict=True):
        goldens.check(result, expected, case.tolerances)
    case.check_response(results)


@pytest.mark.reference
def test_too_long_a_trajectory_is_refused_with_the_limit(served: Served, protocol: str) -> None:
    case = goldens.REFUSED_CASE
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
        wait_until_at_work(MODEL)
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
        wait_until_at_work(MODEL)
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
        "^num_frames: expected at most 16 .*, got 17: .*sampling rule$",
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
    pair = [Trajectory(frames=np.zeros((2, 64, 64, 3), np.uint8), task="lift")] * 2
    message = "sample_type: expected progress or preference .*no similarity head.*, got similarity"
    with served.client(protocol, "q3_tok_disc10") as client, pytest.raises(InvalidSampleError, match=message):
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
