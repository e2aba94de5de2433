# SPDX-License-Identifier: MIT
"""The wire contract without a server: one side writes, the other reads."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import goldens
from every_score import NUM_BINS, assert_same_scores, every_score
from rfm_client import (
    FRAME_SCORES,
    InferenceFailedError,
    InvalidSampleError,
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Result,
    Sample,
    SimilarityResult,
    SimilaritySample,
    Trajectory,
)
from rfm_client.contract import wire
from rfm_client.contract.results import BatchTiming
from rfm_client.contract.samples import EncoderSample

OF_SOME = [name for name, score in FRAME_SCORES.items() if not (score.is_always_asked or score.is_per_bin)]
OUTPUTS = [spec.name for spec in wire.score_outputs(NUM_BINS, OF_SOME)]
TIMING = BatchTiming(1.5, 2.5)


def embedded(seed: int, num_frames: int) -> Trajectory:
    random = np.random.default_rng(seed)
    return Trajectory(
        video_embeddings=random.standard_normal((num_frames, 5), np.float32),
        text_embedding=random.standard_normal(3, np.float32),
    )


def filmed(seed: int, num_frames: int) -> Trajectory:
    frames = np.random.default_rng(seed).integers(1, 256, (num_frames, 6, 4, 3), np.uint8)
    return Trajectory(frames=frames, task=f"lift cup {seed}")


@pytest.mark.parametrize("make", [embedded, filmed])
def test_samples_of_all_kinds_and_lengths_arrive_as_they_were(make: Any) -> None:
    samples: list[Sample] = [
        ProgressSample(make(0, 2), frame_steps=3),
        PreferenceSample(make(1, 1), make(2, 4)),
        SimilaritySample(make(3, 3), make(4, 1)),
        ProgressSample(make(5, 1)),
    ]
    tensors = wire.encode_samples(samples)
    assert tensors[wire.SAMPLE_TYPE].tolist() == [[0], [1], [2], [0]]
    assert tensors[wire.NUM_FRAMES].tolist() == [[2, 0], [1, 4], [3, 1], [1, 0]]
    assert tensors[wire.FRAME_STEPS].tolist() == [[3], [0], [0], [0]]
    assert wire.num_positions(tensors) == 5
    for got, wanted in zip(wire.decode_samples(tensors), samples, strict=True):
        assert type(got) is type(wanted)
        assert getattr(got, "frame_steps", 0) == getattr(wanted, "frame_steps", 0)
        text = wanted.trajectories[0]  # a pair has one
        for one, other in zip(got.trajectories, wanted.trajectories, strict=True):
            np.testing.assert_array_equal(one.positions, other.positions)
            assert one.task == text.task
            if text.text_embedding is not None:
                np.testing.assert_array_equal(one.text_embedding, text.text_embedding)


def results() -> tuple[list[Sample], list[Result]]:
    samples: list[Sample] = [
        ProgressSample(embedded(0, 2)),
        PreferenceSample(embedded(1, 1), embedded(2, 4)),
        SimilaritySample(embedded(3, 3), embedded(4, 1)),
    ]
    first = every_score(0, 2)
    return samples, [
        ProgressResult(**vars(first), timing=TIMING),
        PreferenceResult(preference=0.25, first=every_score(1, 1), second=every_score(2, 4), timing=TIMING),
        SimilarityResult(similarity=-3.5, reference=every_score(3, 3), other=every_score(4, 1)),
    ]


def test_results_arrive_as_they_were() -> None:
    samples, sent = results()
    tensors = wire.encode_results(sent, 5, OUTPUTS)
    assert {name: list(array.shape) for name, array in tensors.items()} == {
        "progress": [3, 5], "success": [3, 5], "preference": [3, 1], "similarity": [3, 1], "timing_ms": [3, 2],
        "progress_logits": [3, 5, 4], **{name: [3, 5] for name in OF_SOME},
    }  # fmt: skip
    assert all(array.dtype == np.float32 for array in tensors.values())
    assert np.isnan(tensors["preference"][:, 0]).tolist() == [True, False, True]
    assert np.isnan(tensors["similarity"][:, 0]).tolist() == [True, True, False]
    assert np.isnan(tensors["timing_ms"]).tolist() == [[False] * 2, [False] * 2, [True] * 2]
    assert np.isnan(tensors["progress"]).sum(axis=1).tolist() == [3, 0, 1]
    for got, expected in zip(wire.decode_results(tensors, samples, "7"), sent, strict=True):
        assert type(got) is type(expected)
        for scores, others in zip(goldens.frame_scores(got), goldens.frame_scores(expected), strict=True):
            assert_same_scores(scores, others)
        for name in ("preference", "similarity", *["timing"] * (expected.timing is not None)):
            assert getattr(got, name, None) == getattr(expected, name, None)
        assert got.model_version == "7"


def lacking(name: str, row: int, at: slice) -> wire.Tensors:
    tensors = {key: array.copy() for key, array in wire.encode_results(results()[1], 5, OUTPUTS).items()}
    tensors[name][row, at] = np.nan
    tensors.pop("remaining_s", None)  # a model that predicts progress gives no seconds
    return tensors


@pytest.mark.parametrize(
    ("name", "row", "at"),
    [
        ("progress", 0, slice(0, 2)),  # the requested trajectory
        ("progress", 1, slice(0, 1)),  # all of a pair's first trajectory
        ("success", 0, slice(1, 2)),  # a part
        ("preference", 1, slice(0, 1)),
        ("similarity", 2, slice(0, 1)),
        ("progress_logits", 0, slice(0, 1)),
    ],
)
def test_a_score_that_lacks_is_an_error(name: str, row: int, at: slice) -> None:
    samples, _ = results()
    tensors = lacking(name, row, at)
    with pytest.raises(InferenceFailedError, match=f"{name}: expected "):
        wire.decode_results(tensors, samples)


def test_progress_may_lack_at_all_frames_where_seconds_take_its_place() -> None:
    samples, _ = results()
    seconds = wire.encode_results(results()[1], 5, OUTPUTS)["remaining_s"]
    tensors = {**lacking("progress", 0, slice(0, None)), "remaining_s": seconds}
    (result, *_) = wire.decode_results(tensors, samples)
    assert all(np.isnan(each.progress).all() for each in goldens.frame_scores(result))
    with pytest.raises(InferenceFailedError, match="progress: expected "):
        wire.decode_results({**tensors, "progress": lacking("progress", 0, slice(0, 1))["progress"]}, samples)


@pytest.mark.parametrize("row", [0, 1])
def test_success_that_lacks_at_all_frames_is_not_predicted(row: int) -> None:
    samples, sent = results()
    result = wire.decode_results(lacking("success", row, slice(0, None)), samples)[row]
    for got, expected in zip(goldens.frame_scores(result), goldens.frame_scores(sent[row]), strict=True):
        assert got.progress.tolist() == expected.progress.tolist()
        assert (len(got.success), np.isnan(got.success).all()) == (len(expected.success), True)
        with pytest.raises(ValueError, match=r"^success: expected .* this checkpoint does not predict it$"):
            got.succeeded()


@pytest.mark.parametrize(
    ("shape", "message"),
    [((3,), "scores of sample 0"), ((2, 5), "scores of sample 2"), ((3, 4), "4 finite scores, got")],
)
def test_an_answer_of_fewer_rows_positions_or_axes_is_an_error(shape: tuple[int, ...], message: str) -> None:
    samples, sent = results()
    tensors = wire.encode_results(sent, 5, OUTPUTS) | {"success": np.ones(shape, np.float32)}
    with pytest.raises(InferenceFailedError, match=f"success: expected {message}"):
        wire.decode_results(tensors, samples)


def test_the_encoder_s_requests_and_answers_arrive_as_they_were() -> None:
    video = filmed(0, 3)
    tensors = wire.encode_frames(video)
    needed = [spec.name for spec in wire.encoder_inputs() if not spec.optional]
    assert list(tensors) == needed == ["num_frames", "frames", "task"]
    (footage,) = wire.decode_trajectories(tensors)
    (got,) = footage.trajectories
    np.testing.assert_array_equal(got.positions, video.positions)
    assert got.task == video.task
    answer = embedded(1, 3)
    outputs = [spec.name for spec in wire.encoder_outputs(5, 3)]
    assert outputs == ["video_embeddings", "text_embedding"]
    told = wire.encode_trajectories([EncoderSample((answer,))], 4, outputs)
    assert told["video_embeddings"].shape == (1, 4, 5)
    assert not told["video_embeddings"][0, 3:].any()
    told["video_embeddings"] = told["video_embeddings"][:, :3]
    decoded = wire.decode_embeddings(told, video)
    np.testing.assert_array_equal(decoded.positions, answer.positions)
    np.testing.assert_array_equal(decoded.text_embedding, answer.text_embedding)
    assert decoded.task == video.task


def test_embeddings_of_another_shape_are_an_error() -> None:
    for video, text in (((3, 5), (1, 3)), ((1, 3, 5), (3,)), ((1, 2, 5), (1, 3)), ((2, 3, 5), (1, 3))):
        tensors = {"video_embeddings": np.ones(video, np.float32), "text_embedding": np.ones(text, np.float32)}
        with pytest.raises(InferenceFailedError, match=r"embeddings: expected \[1, 3, D\] and \[1, Dt\]"):
            wire.decode_embeddings(tensors, filmed(0, 3))


@pytest.mark.parametrize(
    ("num_sent", "shape"),
    [(0, (2, 1, 1, 1, 3)), (1, (2, 1, 6, 4, 3)), (2, (2, 1, 6, 4, 3)), (3, (2, 2, 6, 4, 3))],
    ids=["all are known", "one is new", "one of each is new", "one of them has no place beside the others"],
)
def test_named_frames_arrive_with_those_that_are_sent(num_sent: int, shape: tuple[int, ...]) -> None:
    videos = filmed(0, 2), filmed(1, 3)
    digests = [[wire.frame_digest(frame) for frame in video.positions] for video in videos]
    frames = [*videos[0].positions, *videos[1].positions]
    kept = {wire.frame_digest(frame): frame for frame in frames[num_sent:]}
    tensors = wire.encode_refs(digests, [video.task for video in videos], frames[:num_sent])
    assert tensors[wire.FRAMES].shape == shape
    assert wire.num_positions(tensors) == 3
    samples = wire.decode_samples(tensors, lambda asked: {each: kept[each] for each in asked if each in kept})
    footage = wire.decode_trajectories(tensors, lambda asked: {each: np.ones(2, np.float32) for each in asked})
    for sample, encoded, video, wanted in zip(samples, footage, videos, digests, strict=True):
        assert isinstance(sample, ProgressSample)
        for trajectory in (*sample.trajectories, *encoded.trajectories):
            assert trajectory.named is not None
            assert [digest for digest, _ in trajectory.named] == wanted
            assert (trajectory.task, trajectory.num_frames) == (video.task, len(wanted))
            for (digest, known), frame in zip(trajectory.named, video.positions, strict=True):
                expected = np.ones(2) if trajectory in encoded.trajectories and digest in kept else frame
                np.testing.assert_array_equal(known, expected)


def request(lengths: tuple[int, int], kind: int, steps: int = 0, stray: int = 0) -> wire.Tensors:
    """Return a request with four positions. stray: number of nonzero positions behind the frames"""
    return {
        "sample_type": np.array([[kind]], np.uint8),
        "num_frames": np.array([lengths], np.int32),
        "frame_steps": np.array([[steps]], np.int32),
        "video_embeddings": np.where(np.arange(4) < sum(lengths) + stray, 1, 0).astype(np.float32)[None, :, None],
        "text_embedding": np.ones((1, 2), np.float32),
    }


PICTURES = np.ones((1, 5, 8, 6, 3), np.uint8)


def of_pictures(**changes: npt.NDArray[Any]) -> wire.Tensors:
    """Return a request about a pair of three and two frames in an array each."""
    question = request((3, 2), 1) | {"frames": PICTURES[:, :3], "second_frames": PICTURES[:, :2]}
    task = np.array([[b"lift"]], np.object_)
    return {name: question[name] for name in question if "embedding" not in name} | {"task": task} | changes


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        (of_pictures(task=np.array([[b"\xff\xfe"]], np.object_)), "task: expected UTF-8 text, got other bytes"),
        (of_pictures(frames=PICTURES[:, :3, :0]), "frames: expected at least one frame of at least one pixel, got .*"),
        (
            of_pictures(second_frames=PICTURES[:, :1]),
            "num_frames: expected at most the 1 frames in second_frames, got 2",
        ),
        (of_pictures(second_frames=PICTURES), "second_frames: expected zeros behind the 2 frames that .*"),
        (of_pictures(frames=PICTURES), "frames: expected zeros behind the 3 frames that .*"),
        (request((0, 0), 0), r"num_frames: expected \[at least 1, 0\] for progress, got \[0, 0\]"),
        (request((1, 1), 0), r"num_frames: expected \[at least 1, 0\] for progress, got \[1, 1\]"),
        (request((2, 0), 1), r"num_frames: expected at least one frame of each of the two trajectories, got \[2, 0\]"),
        (request((1, 1), 1, 1), r"frame_steps: expected 0 unless the sample is of type progress, got 1"),
        (request((1, 1), 3), r"sample_type: expected one of 0 \(progress\), 1 \(preference\), 2 \(similarity\), got 3"),
        (request((5, 0), 0), r"num_frames: expected at most the 4 frames in video_embeddings, got 5"),
        (
            request((1, 0), 0, stray=1),
            "video_embeddings: expected zeros behind the 1 frames that num_frames states, got .*",
        ),
        (request((2, 3), 1), r"num_frames: expected at most the 4 frames in video_embeddings, got 5"),
    ],
)
def test_numbers_that_mean_nothing_are_refused(tensors: wire.Tensors, message: str) -> None:
    with pytest.raises(InvalidSampleError, match=f"^{message}$"):
        wire.decode_samples(tensors)


@pytest.mark.parametrize(("lengths", "is_refused"), [((1, 0), False), ((1, 1), False), ((0, 1), True), ((1, -1), True)])
def test_the_encoder_reads_videos_with_frames_and_refuses_other_frame_counts(
    lengths: tuple[int, int], is_refused: bool
) -> None:
    tensors = wire.encode_frames(filmed(0, 2)) | {"num_frames": np.array([lengths], np.int32)}
    tensors["frames"] = np.where(np.arange(2)[None, :, None, None, None] < sum(lengths), tensors["frames"], 0)
    if is_refused:
        with pytest.raises(InvalidSampleError, match="num_frames: expected"):
            wire.decode_trajectories(tensors)
    else:
        (footage,) = wire.decode_trajectories(tensors)
        assert sum(trajectory.num_frames for trajectory in footage.trajectories) == sum(lengths)


def test_arrays_whose_length_varies_are_ragged_and_second_frames_optional() -> None:
    """``rfm export --check`` compares names, types and dims with the committed config.pbtxt."""
    inputs = (*wire.embedding_inputs(5, 3), *wire.frame_inputs(), *wire.encoder_inputs())
    assert {spec.name for spec in inputs if spec.ragged} == {"video_embeddings", "frames", "second_frames"}
    assert {spec.name for spec in inputs if spec.optional} == {"second_frames"}
    assert not any(spec.ragged for spec in (*wire.encoder_outputs(5, 3), *wire.score_outputs(4)))


def test_a_request_asks_for_every_given_score_except_those_on_request() -> None:
    sample = ProgressSample(embedded(0, 2))
    always, given = {"progress", "success"}, {"log_prob", "unclear", "remaining_s", "relative_s", "entropy", "hop"}
    assert {*wire.outputs_for([sample])} == always
    assert {*wire.outputs_for([sample], FRAME_SCORES)} == always | given
