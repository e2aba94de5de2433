# SPDX-License-Identifier: MIT
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rfm_client import (
    InvalidSampleError,
    PreferenceSample,
    ProgressSample,
    Sample,
    SimilaritySample,
    Trajectory,
    float_frames_to_uint8,
)
from rfm_client.contract import wire
from rfm_client.scoring.batching import MAX_REQUEST_BYTES, groups, padded_bytes, parts

FRAMES = np.zeros((3, 8, 6, 3), np.uint8)
VIDEO = np.ones((3, 5), np.float32)
TEXT = np.ones(4, np.float32)


def embedded(num_frames: int = 3, width: int = 5) -> Trajectory:
    return Trajectory(video_embeddings=np.ones((num_frames, width), np.float32), text_embedding=TEXT)


def filmed(num_frames: int = 3, height: int = 8) -> Trajectory:
    return Trajectory(frames=np.full((num_frames, height, 6, 3), num_frames, np.uint8), task="lift the cup")


with_nan = VIDEO.copy()
with_nan[2, 1] = np.nan

BAD: dict[str, tuple[Callable[[], Any], str]] = {
    "nothing": (lambda: Trajectory(), "trajectory: expected either frames or video_embeddings, got neither"),
    "both": (
        lambda: Trajectory(frames=FRAMES, video_embeddings=VIDEO),
        "trajectory: expected either frames or video_embeddings, got both",
    ),
    "float frames": (
        lambda: Trajectory(frames=FRAMES.astype(np.float32)),  # type: ignore[arg-type]
        "frames: expected uint8 [T, H, W, 3] (see float_frames_to_uint8), got float32 [3, 8, 6, 3]",
    ),
    "one image": (lambda: Trajectory(frames=FRAMES[0]), "frames: expected uint8 [T, H, W, 3], got uint8 [8, 6, 3]"),
    "no frames": (
        lambda: Trajectory(frames=FRAMES[:0]),
        "frames: expected at least one frame of at least one pixel, got uint8 [0, 8, 6, 3]",
    ),
    "paths as frames": (
        lambda: Trajectory(frames=["/etc/passwd"]),  # type: ignore[arg-type]
        "frames: expected uint8 [T, H, W, 3] (see float_frames_to_uint8), got <U11 [1]",
    ),
    "no embeddings": (
        lambda: Trajectory(video_embeddings=VIDEO[:0]),
        "video_embeddings: expected float32 [T, D] without an empty axis, got float32 [0, 5]",
    ),
    "rows of unequal length": (
        lambda: Trajectory(video_embeddings=[[1.0], [1.0, 2.0]]),  # type: ignore[arg-type]
        "video_embeddings: expected float32 [T, D], got rows of unequal length",
    ),
    "NaN": (
        lambda: Trajectory(video_embeddings=with_nan),
        "video_embeddings: expected finite values, got nan at [2, 1]",
    ),
    "too large for float32": (
        lambda: Trajectory(video_embeddings=VIDEO.astype(np.float64) * 1e300),
        "video_embeddings: expected finite values, got inf at [0, 0]",
    ),
    "text embedding of rank 2": (
        lambda: Trajectory(video_embeddings=VIDEO, text_embedding=TEXT[None]),
        "text_embedding: expected float32 [Dt], got float32 [1, 4]",
    ),
    "task that is no text": (
        lambda: Trajectory(frames=FRAMES, task=3),  # type: ignore[arg-type]
        "task: expected str, got int",
    ),
    "task that UTF-8 cannot encode": (
        lambda: Trajectory(frames=FRAMES, task="\ud800"),
        "task: expected text that UTF-8 can encode, got a lone surrogate",
    ),
    "embeddings without text": (
        lambda: ProgressSample(Trajectory(video_embeddings=VIDEO)),
        "trajectory.text_embedding: expected float32 [Dt] with video_embeddings, got None",
    ),
    "frames without task": (
        lambda: ProgressSample(Trajectory(frames=FRAMES, task=" ")),
        "trajectory.task: expected a task sentence with frames, got ' '",
    ),
    "one frame step": (
        lambda: ProgressSample(embedded(), frame_steps=1),
        "frame_steps: expected 0 or a whole number from 2 to 4096, got 1",
    ),
    "frame steps beyond the wire's type": (
        lambda: ProgressSample(embedded(), frame_steps=2**40),
        f"frame_steps: expected 0 or a whole number from 2 to 4096, got {2**40}",
    ),
    "no trajectory": (
        lambda: ProgressSample(VIDEO),  # type: ignore[arg-type]
        "trajectory: expected Trajectory, got ndarray",
    ),
    "no second trajectory": (
        lambda: PreferenceSample(embedded(), None),  # type: ignore[arg-type]
        "second: expected Trajectory, got NoneType",
    ),
    "frames with a text embedding": (
        lambda: Trajectory(frames=FRAMES, text_embedding=TEXT),
        "text_embedding: expected None with frames, which go with task, got an embedding",
    ),
    "frames of unequal size": (
        lambda: Trajectory(frames=[FRAMES[0], FRAMES[0, :2]]),  # type: ignore[arg-type]
        "frames: expected uint8 [T, H, W, 3], got frames of unequal size",
    ),
    "frames against embeddings": (
        lambda: PreferenceSample(embedded(), filmed()),
        "second: expected video_embeddings, as the first trajectory, got frames",
    ),
    "a pair with a goal, which the wire has for the first alone": (
        lambda: PreferenceSample(filmed(), replace(filmed(), goal=FRAMES[0])),
        "second: expected trajectories without views and goal, which only progress has, got them",
    ),
    "unequal widths": (
        lambda: PreferenceSample(embedded(), embedded(width=6)),
        "second.video_embeddings: expected [5] per frame, as the first trajectory (one array holds both), got [6]",
    ),
}


@pytest.mark.parametrize(("make", "message"), BAD.values(), ids=BAD)
def test_invalid_samples_are_refused_on_construction(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(InvalidSampleError) as caught:
        make()
    assert str(caught.value) == message


def test_float_frames_are_clipped_and_truncated() -> None:
    frames = np.array([-3.0, 0.9, 1.0, 254.99, 300.0])
    assert float_frames_to_uint8(frames).tolist() == [0, 0, 1, 254, 255]


@pytest.mark.parametrize("frames", [np.full((2, 2), 0.7), np.array([np.nan, 3.0])], ids=["0..1", "NaN"])
def test_float_frames_that_would_turn_black_are_refused(frames: np.ndarray) -> None:
    with pytest.raises(InvalidSampleError, match=r"^frames: expected"):
        float_frames_to_uint8(frames)


def test_requests_of_two_frame_sizes_are_bounded_by_the_padded_bytes_sent() -> None:
    """The longest first and second trajectories may belong to different samples."""
    small, large = (np.zeros((9, height, 400, 3), np.uint8) for height in (100, 400))
    counts = [(1, 9), (9, 1), (5, 5), (2, 8), (8, 2), (1, 1)]
    pairs = [[Trajectory(frames=small[:n], task="lift"), Trajectory(frames=large[:m], task="lift")] for n, m in counts]
    samples: dict[int, Sample] = dict(enumerate(PreferenceSample(*pair) for pair in pairs))
    samples |= {len(counts) + index: SimilaritySample(first, first) for index, (first, _) in enumerate(pairs)}
    asked: list[int] = []
    for _, group in groups(samples, "rfm"):
        for part in parts(samples, group, max_batch_size=64):
            tensors = wire.encode_samples([samples[index] for index in part])
            sent = sum(tensors[name].nbytes for name in (wire.FRAMES, wire.SECOND_FRAMES) if name in tensors)
            assert sent == padded_bytes([samples[index] for index in part])
            assert sent <= MAX_REQUEST_BYTES
            asked += part
    assert sorted(asked) == sorted(samples)
