# SPDX-License-Identifier: MIT
"""Calls of the client: answers, errors, deadlines, and the description of a served model."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from engine_server import EngineServer
from engines import load_engine
from mixtures import FRAMES_MODEL, assert_same
from rfm_client import (
    FRAME_SCORES,
    AccessDeniedError,
    DeadlineExceededError,
    InvalidSampleError,
    ModelInfo,
    ModelNotFoundError,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    RewardClient,
    Sample,
    ServerUnavailableError,
    SimilaritySample,
    Trajectory,
)
from rfm_client.frames import resize_frames
from shelves import Shelf
from tolerances import TOLERANCE
from trajectories import random_trajectory
from transports import Answer

NOBODY = "grpc://127.0.0.1:1"  # a port where nothing listens
WIDTHS = (48, 32)  # of the embeddings of FRAMES_MODEL


def test_samples_of_frames_of_several_sizes_and_embeddings_come_back_in_order(engines: EngineServer) -> None:
    embedded = [random_trajectory(seed, 1 + seed % 16, *WIDTHS) for seed in range(100)]
    samples: list[Sample] = [ProgressSample(trajectory) for trajectory in embedded]
    frames = np.random.default_rng(0).integers(0, 256, (3, 24, 32, 3), np.uint8)
    videos = [Trajectory(frames=frames[:length], task="stack the cups") for length in (1, 3)]
    taller = Trajectory(
        frames=np.random.default_rng(1).integers(0, 256, (2, 90, 61, 3), np.uint8), task="stack the cups"
    )
    samples[50:50] = [ProgressSample(videos[0]), PreferenceSample(*videos), SimilaritySample(*embedded[:2])]
    samples[60:60] = [PreferenceSample(videos[1], taller), SimilaritySample(taller, videos[0])]
    with engines.client(FRAMES_MODEL) as client:
        answers = client.evaluate(samples)
    for answer, alone in zip(answers, load_engine(FRAMES_MODEL).evaluate(samples), strict=True):
        assert_same(answer, alone)


def test_samples_of_a_model_that_is_not_served_fail_and_the_others_are_scored(engines: EngineServer) -> None:
    video = ProgressSample(Trajectory(frames=np.zeros((1, 8, 8, 3), np.uint8), task="none"))
    with engines.client() as client:  # MODEL has no encoders
        outcomes = client.evaluate([video, ProgressSample(random_trajectory(0, 2)), video], return_errors=True)
    assert [type(outcome) for outcome in outcomes] == [ModelNotFoundError, ProgressResult, ModelNotFoundError]


def test_a_long_trajectory_is_subsampled_when_asked(engines: EngineServer) -> None:
    long, short = random_trajectory(1, 40), random_trajectory(2, 5)
    kept = np.rint(np.linspace(0, 39, 16)).astype(int)
    cut = replace(long, video_embeddings=long.positions[kept])
    with engines.client() as client:
        result = client.progress(long, subsample=True)
        pair = client.preference(long, short, subsample=True)
        assert_same(result, client.progress(cut))
        assert_same(pair, client.preference(cut, short))
        dense = client.progress(long, frame_steps=4, subsample=True)
    np.testing.assert_array_equal(result.frame_indices, kept)
    np.testing.assert_array_equal(pair.first.frame_indices, kept)
    assert pair.second.frame_indices is None
    assert dense.frame_indices is None
    assert len(dense.progress) == 40


def test_both_orders_are_asked_under_the_task_of_the_first(engines: EngineServer) -> None:
    first, second = random_trajectory(1, 40), random_trajectory(2, 5)
    back = replace(second, text_embedding=first.text_embedding)
    with engines.client() as client:
        once = client.preference(first, second, subsample=True)
        swapped = client.preference(back, first, subsample=True).preference
        other_text = client.preference(second, first, subsample=True).preference
        both = client.preference(first, replace(second, text_embedding=None), both_orders=True, subsample=True)
        with pytest.raises(InvalidSampleError) as asked_once:
            client.preference(second, first)
        with pytest.raises(InvalidSampleError) as asked_both:
            client.preference(second, first, both_orders=True)
    assert other_text != pytest.approx(swapped, abs=1e-4)
    assert once.both_orders is None
    assert both.both_orders == pytest.approx((once.preference, 1 - swapped), abs=TOLERANCE)
    assert_same(replace(both, preference=once.preference), once)
    assert both.first.frame_indices is not None
    assert asked_both.value.message == asked_once.value.message


def test_each_trajectory_is_resized_by_its_own_size_when_asked(engines: EngineServer) -> None:
    random = np.random.default_rng(4)
    wide, tall = (
        Trajectory(frames=random.integers(0, 256, (num_frames, *size, 3), np.uint8), task="open the drawer")
        for num_frames, size in ((4, (120, 160)), (3, (200, 90)))
    )
    with engines.client(FRAMES_MODEL) as client:
        size = client.model_info(frames=True).frame_size
        assert size is not None
        smaller = [replace(t, frames=resize_frames(t.positions, size)) for t in (wide, tall)]
        assert smaller[0].positions.shape[1:] != smaller[1].positions.shape[1:]
        assert_same(client.preference(wide, tall, resize=True), client.preference(*smaller))
        assert_same(client.curve(wide, resize=True), client.curve(smaller[0]))
        resized = client.progress(wide, resize=True)
        np.testing.assert_allclose(resized.progress, client.progress(wide).progress, rtol=0, atol=5e-4)


@pytest.mark.parametrize("retry", [False, True])
def test_nobody_there_is_an_error_of_its_own_for_each_sample(caplog: pytest.LogCaptureFixture, retry: bool) -> None:
    samples = [ProgressSample(random_trajectory(0, 2))] * 3
    with RewardClient(NOBODY, retry=retry, timeout_s=2) as client:
        outcomes = client.evaluate(samples, return_errors=True)
    assert len({id(outcome) for outcome in outcomes}) == 3
    for outcome in outcomes:
        assert isinstance(outcome, ServerUnavailableError)
        assert "refused" in str(outcome)
    assert [record.message.partition(": trying again")[0] for record in caplog.records] == [NOBODY] * retry


def test_timing_and_logits_come_when_asked(engines: EngineServer) -> None:
    with engines.client() as client:
        plain = client.progress(random_trajectory(0, 3))
        full = client.progress(random_trajectory(0, 3), logits=True, timing=True)
    assert (plain.timing, plain.progress_logits) == (None, None)
    assert full.progress_logits is not None and full.timing is not None
    assert full.progress_logits.shape == (3, 10)
    assert full.timing.forward_ms > 0


def filmed(num_frames: int) -> Trajectory:
    frames = np.random.default_rng(num_frames).integers(0, 256, (num_frames, 32, 32, 3), np.uint8)
    return Trajectory(frames=frames, task="stack the cups")


class Described(Shelf):
    """Describes the model with ``more``. lacks_description: does not describe it"""

    lacks_description = False
    more: Mapping[str, Any] = MappingProxyType({})

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        if self.lacks_description:
            raise ModelNotFoundError(model)
        return replace(await super().model_info(model, timeout_s), **self.more)


def test_a_model_without_a_description_is_scored() -> None:
    shelf = Described(has_encoder=False)
    shelf.lacks_description = True
    with RewardClient("", transports=[shelf]) as client:
        assert client.progress(filmed(2)).unclear is None


class Secretive(Shelf):
    """Denies access to the descriptions. num_asked: how often it was asked for one"""

    num_asked = 0

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        self.num_asked += 1
        raise AccessDeniedError("no access")


def test_embeddings_are_scored_without_a_description_which_is_asked_for_once() -> None:
    shelf = Secretive()
    with RewardClient("", transports=[shelf]) as client:
        for _ in range(3):
            client.progress(random_trajectory(0, 2))
        assert (shelf.num_asked, shelf.count) == (1, 3)


class Hanging(Described):
    """Takes long to score."""

    async def infer(self, *arguments: Any, **options: Any) -> Answer:
        await asyncio.sleep(60)
        raise NotImplementedError


@pytest.mark.parametrize("by_digest", [False, True])
def test_a_call_that_waits_in_vain_for_its_turn_names_its_request(by_digest: bool) -> None:
    shelf = Hanging()
    shelf.more = {"by_digest": by_digest}
    with RewardClient("", transports=[shelf], max_in_flight=1) as client:
        open_call = client.submit(ProgressSample(filmed(1)))
        with pytest.raises(DeadlineExceededError, match=r"^no answer within 0\.1 s \(request mine-1\)$"):
            client.progress(filmed(1), timeout_s=0.1, request_id="mine")
        with pytest.raises(DeadlineExceededError, match=r"^no answer within 0\.1 s \(request \w+-1\)$"):
            client.episode("lift", timeout_s=0.1).add(filmed(1).positions[0])
        open_call.cancel()


def test_a_step_has_each_score_that_the_checkpoint_gives_unasked() -> None:
    names = [name for name, score in FRAME_SCORES.items() if not (score.is_always_asked or score.is_per_bin)]
    shelf = Described(has_encoder=False)
    shelf.more = {"more_scores": tuple(names)}
    (frame,) = filmed(1).positions
    with RewardClient("", transports=[shelf]) as client:
        step = client.episode("stack", cameras=("front", "wrist")).add({"front": frame, "wrist": frame})
    expected = {name: True if FRAME_SCORES[name].mark else pytest.approx(0.1) for name in names}
    assert step.more_scores == expected
    assert names == [*step.more_scores]
    assert step.unclear


MORE = "trajectory: expected at most 16 frames, as in the training of "
CALLS: dict[str, tuple[Callable[[RewardClient], object], int]] = {  # and the lines that follow
    "as many as in training": (lambda client: client.progress(filmed(16)), 0),
    "subsampled": (lambda client: client.progress(filmed(17), subsample=True), 0),
    "dense": (lambda client: client.progress(filmed(17), frame_steps=4), 0),
    "twice": (lambda client: [client.progress(filmed(17)) for _ in range(2)], 1),
    "submit": (lambda client: [each.result() for each in [client.submit(ProgressSample(filmed(17))) for _ in "ab"]], 1),
    "a step of an episode": (
        lambda client: client.episode("stack", sampling="linspace_round", frames=17).add(filmed(1).positions[0]),
        1,
    ),
}


@pytest.mark.parametrize(("ask", "num_lines"), CALLS.values(), ids=CALLS)
def test_a_client_warns_once_of_more_frames_than_in_training(
    caplog: pytest.LogCaptureFixture, ask: Callable[[RewardClient], object], num_lines: int
) -> None:
    with RewardClient("", transports=[Shelf(has_encoder=False)]) as client:
        ask(client)
    assert [message.startswith(MORE) for message in caplog.messages] == [True] * num_lines


def test_a_checkpoint_without_a_limit_of_training_gets_no_line(caplog: pytest.LogCaptureFixture) -> None:
    for unlimited in ({"trained_frames": None}, {"needs_whole_episode": True}):
        shelf = Described(has_encoder=False)
        shelf.more = unlimited
        with RewardClient("", transports=[shelf]) as client:
            client.progress(filmed(40))
    assert caplog.messages == []
