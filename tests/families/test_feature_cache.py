# SPDX-License-Identifier: MIT
"""Embeddings are computed once per frame and task, cached by content, and never mixed up."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest

from engines import load_engine
from rfm.engine import Execution
from rfm.engine.family import FrameEncoders
from rfm.engine.feature_cache import FeatureCache, get_or_make
from rfm_client import InferenceFailedError, InvalidSampleError, RewardError, Trajectory, UInt8Array
from rfm_client.contract import wire
from rfm_client.contract.samples import EncoderSample
from rfm_client.contract.wire import frame_digest
from vlm import video

TASK = "stack the cups"


@pytest.fixture(scope="module")
def encoders() -> FrameEncoders:
    loaded = load_engine("enc_c1_t1_disc10").encoders
    assert loaded is not None
    return loaded


def frames_of(seed: int, count: int) -> UInt8Array:
    return video(seed, count, 40, 56).positions


def footage(frames: UInt8Array, task: str = TASK) -> EncoderSample:
    return EncoderSample((Trajectory(frames=frames, task=task),))


def named(frames: UInt8Array, sent: UInt8Array, cache: FeatureCache[Any]) -> EncoderSample:
    """Return a request about frames with only some of them sent, as a model with this cache decodes it."""
    (sample,) = wire.decode_trajectories(wire.encode_refs([[*map(frame_digest, frames)]], [TASK], [*sent]), cache.found)
    return sample


def embeddings(outcome: EncoderSample | RewardError) -> tuple[np.ndarray, np.ndarray]:
    assert isinstance(outcome, EncoderSample), outcome
    (trajectory,) = outcome.trajectories
    assert trajectory.video_embeddings is not None
    assert trajectory.text_embedding is not None
    return trajectory.video_embeddings, trajectory.text_embedding


@pytest.mark.parametrize("limit_bytes", [2**20, 0], ids=["kept", "evicted at once"])
def test_episodes_that_grow_by_a_frame_are_embedded_as_without_a_cache(
    encoders: FrameEncoders, limit_bytes: int
) -> None:
    frames, cache, execution = frames_of(0, 12), FeatureCache(limit_bytes), Execution()
    for stop in range(1, 13):
        (expected,) = encoders.encode([footage(frames[:stop])], Execution(), None)
        sent = frames[stop - 1 : stop] if limit_bytes else frames[:stop]
        (outcome,) = encoders.encode([named(frames[:stop], sent, cache)], execution, cache)
        for got, wanted in zip(embeddings(outcome), embeddings(expected), strict=True):
            np.testing.assert_allclose(got, wanted, atol=1e-5)
    assert execution.num_encoded == (12 if limit_bytes else 78)
    assert execution.num_found == (66 if limit_bytes else 0)


def test_equal_frames_of_one_batch_are_encoded_once(encoders: FrameEncoders) -> None:
    frames, execution, cache = frames_of(1, 5), Execution(), FeatureCache(2**20)
    batch = [footage(frames), footage(frames[[0, 0, 4, 4]], "another task"), named(frames[:3], frames[:3], cache)]
    outcomes = encoders.encode(batch, execution, cache)
    assert execution.num_encoded == 5
    whole, others, first = (embeddings(outcome)[0] for outcome in outcomes)
    np.testing.assert_array_equal(others, whole[[0, 0, 4, 4]])
    np.testing.assert_array_equal(first, whole[:3])


def test_a_frame_that_is_evicted_after_its_request_came_is_not_missing(encoders: FrameEncoders) -> None:
    frames, cache = frames_of(6, 3), FeatureCache(2**20)
    (expected,) = encoders.encode([footage(frames)], Execution(), cache)
    sample, execution = named(frames, frames[:0], cache), Execution()
    cache.clear()
    (outcome,) = encoders.encode([sample], execution, cache)
    np.testing.assert_array_equal(embeddings(outcome)[0], embeddings(expected)[0])
    assert (execution.num_encoded, execution.num_found) == (0, 3)


def test_frame_digests_given_by_a_caller_do_not_count(encoders: FrameEncoders) -> None:
    """Pixels are named by who reads them: a digest that a caller gives them counts for nothing."""
    frames, cache = frames_of(4, 2), FeatureCache(2**20)
    with pytest.raises(
        InvalidSampleError,
        match=r"frame_digests: expected digests of .*, got 1 others",
    ):
        named(frames[:1], frames[1:], cache)
    (expected,) = encoders.encode([footage(frames[:1])], Execution(), None)
    (outcome,) = encoders.encode([footage(frames[:1])], Execution(), cache)
    np.testing.assert_allclose(embeddings(outcome)[0], embeddings(expected)[0], atol=1e-5)


def test_features_that_are_not_finite_are_not_cached() -> None:
    cache = FeatureCache(2**20)
    sources = {b"nan": np.float32(np.nan), b"error": np.float32(0), b"good": np.float32(1)}

    def make(values: object) -> list[np.ndarray | RewardError]:
        return [np.full(2, np.nan, np.float32), InferenceFailedError("no memory"), np.ones(2, np.float32)]

    features, num_made = get_or_make(cache, [*sources, b"unknown"], sources, make)
    assert (list(features), num_made) == ([b"nan", b"error", b"good"], 3)
    assert list(cache.found(sources)) == [b"good"]


def test_memory_is_bounded_whatever_comes() -> None:
    limit, many = 256 * 2**10, 2_000
    cache = FeatureCache(limit)
    tracemalloc.start()
    for number in range(many):
        cache.keep({number.to_bytes(32, "little"): np.full(64, number, np.float32)})
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert cache.num_bytes <= limit
    assert held < 2 * limit
    last = (many - 1).to_bytes(32, "little")
    assert cache.found([last])[last][0] == many - 1
    assert not cache.found([bytes(32)])


def test_the_most_recently_used_features_stay_in_the_cache() -> None:
    cache = FeatureCache(3 * (64 * 4 + 256))
    features = {bytes([number]): np.zeros(64, np.float32) for number in range(4)}
    for number in range(3):
        cache.keep({bytes([number]): features[bytes([number])]})
    cache.found([b"\x00"])
    cache.keep({b"\x03": features[b"\x03"]})
    assert list(cache.found(features)) == [b"\x00", b"\x02", b"\x03"]


def test_a_black_frame_with_pixels_is_always_encoded(encoders: FrameEncoders) -> None:
    """A server probes itself with such: it is to see whether the encoder works."""
    black, cache, execution = np.zeros((2, 40, 56, 3), np.uint8), FeatureCache(2**20), Execution()
    expected = [embeddings(encoders.encode([footage(black)], execution, cache)[0])[0] for _ in range(2)]
    (outcome,) = encoders.encode([named(black, black[:0], cache)], execution, cache)
    np.testing.assert_allclose(embeddings(outcome)[0], expected[0], atol=1e-5)
    assert execution.num_encoded == 2
