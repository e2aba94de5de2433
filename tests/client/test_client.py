# SPDX-License-Identifier: MIT
"""Calls of the client: answers, errors, deadlines, and the description of a served model."""

from __future__ import annotations

import asyncio
import inspect
import re
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from engines import load_engine
from mixtures import FRAMES_MODEL, MODEL, assert_same, mixed_samples, plug
from rfm_client import (
    FRAME_SCORES,
    AsyncRewardClient,
    DeadlineExceededError,
    InvalidSampleError,
    ModelInfo,
    ModelNotFoundError,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Result,
    RewardClient,
    Sample,
    ServerUnavailableError,
    SimilaritySample,
    Trajectory,
)
from rfm_client.frames import resize_frames
from servers import Served
from shelves import Shelf
from tolerances import TOLERANCE
from trajectories import random_trajectory
from transports import Answer, Connection

NOBODY = "grpc://127.0.0.1:1"  # a port where nothing listens
KINDS: dict[type, str] = {
    ProgressSample: "progress",
    PreferenceSample: "preference",
    SimilaritySample: "similarity",
}
WIDTHS = (48, 32)  # of the embeddings of FRAMES_MODEL


@pytest.mark.parametrize("kind", [RewardClient, AsyncRewardClient])
def test_help_of_a_client_tells_of_each_option(kind: type[Any]) -> None:
    parameters = inspect.signature(kind).parameters
    assert [name for name, each in parameters.items() if each.kind is not each.KEYWORD_ONLY] == ["urls"]
    assert len(parameters) == 12
    for name in parameters:
        assert re.search(rf"^    [\w, ]*\b{name}\b[\w, ]*: ", kind.__init__.__doc__ or "", re.MULTILINE), name


def test_every_style_of_call_gives_the_engine_s_answers(served: Served, protocol: str) -> None:
    samples = mixed_samples(12)

    async def awaited() -> list[Result]:
        async with AsyncRewardClient(served.url(protocol), model=MODEL) as client:
            alone = [getattr(client, KINDS[type(sample)])(*sample.trajectories) for sample in samples]
            return [*await client.evaluate(iter(samples)), *await asyncio.gather(*alone)]

    with served.client(protocol) as client:
        answers = client.evaluate(samples)
        answers += [getattr(client, KINDS[type(sample)])(*sample.trajectories) for sample in samples]
        answers += [future.result() for future in [client.submit(sample) for sample in samples]]
    answers += asyncio.run(awaited())
    for answer, expected in zip(answers, 5 * load_engine(MODEL).evaluate(samples), strict=True):
        assert_same(answer, expected)
        assert answer.model_version == "1"


def test_hundreds_of_samples_of_frames_and_embeddings_come_back_in_order(served: Served) -> None:
    embedded = [random_trajectory(seed, 1 + seed % 16, *WIDTHS) for seed in range(300)]
    samples: list[Sample] = [ProgressSample(trajectory) for trajectory in embedded]
    frames = np.random.default_rng(0).integers(0, 256, (3, 24, 32, 3), np.uint8)
    videos = [Trajectory(frames=frames[:length], task="stack the cups") for length in (1, 3)]
    samples[150:150] = [ProgressSample(videos[0]), PreferenceSample(*videos), SimilaritySample(*embedded[:2])]
    with served.client("grpc", FRAMES_MODEL) as client:
        answers = client.evaluate(samples)
    for answer, alone in zip(answers, load_engine(FRAMES_MODEL).evaluate(samples), strict=True):
        assert_same(answer, alone)


def test_a_bad_sample_fails_alone_or_is_raised_with_its_place(served: Served, protocol: str) -> None:
    samples = mixed_samples(5)
    too_long = ProgressSample(random_trajectory(0, 20))
    with served.client(protocol) as client:
        outcomes = client.evaluate([*samples, too_long, "a string"], return_errors=True)  # type: ignore[list-item]
        good = client.evaluate(samples)
        with pytest.raises(
            InvalidSampleError,
            match=r"^samples\[5\]\.num_frames: expected at most 16 .*, got 20; .*subsample=True.* \(request \S+\)$",
        ):
            client.evaluate([*samples, too_long])
    for outcome, expected in zip(outcomes[:5], good, strict=True):
        assert_same(outcome, expected)
    assert isinstance(outcomes[5], InvalidSampleError)
    assert str(outcomes[6]) == "sample: expected ProgressSample, PreferenceSample or SimilaritySample, got str"


def test_embeddings_of_another_width_are_told_in_our_words(served: Served, protocol: str) -> None:
    with served.client(protocol) as client:
        with pytest.raises(InvalidSampleError, match=r"^video_embeddings: expected \[-1,768\], got \[2,5\] \(request "):
            client.progress(random_trajectory(0, 2, 5, 384))
        with pytest.raises(InvalidSampleError, match=r"^text_embedding: expected \[384\], got \[7\] \(request \S+\)$"):
            client.progress(random_trajectory(0, 2, 768, 7))


def test_a_deadline_ends_a_call_and_no_other(served: Served, protocol: str) -> None:
    full = [ProgressSample(random_trajectory(0, 40), frame_steps=16) for _ in range(64)]
    with served.client(protocol) as client, ThreadPoolExecutor(3) as pool:
        plugs = [pool.submit(client.evaluate, full) for _ in range(3)]
        next(as_completed(plugs))  # two more come before the next call
        with pytest.raises(DeadlineExceededError, match=r"no answer within 0\.05 s"):
            client.progress(random_trajectory(0, 4), timeout_s=0.05)
        for each in plugs:
            each.result()
        assert client.progress(random_trajectory(0, 4), timeout_s=1e9).last_progress > 0


def test_a_cancelled_future_disturbs_no_other(served: Served) -> None:
    with served.client("grpc") as client:
        plugged = [client.submit(sample) for sample in plug()]
        waiting = client.submit(ProgressSample(random_trajectory(0, 4)))
        assert waiting.cancel()
        with pytest.raises(CancelledError):
            waiting.result()
        for future in plugged:
            future.result()


def test_samples_of_a_model_that_is_not_served_fail_and_the_others_are_scored(served: Served) -> None:
    video = ProgressSample(Trajectory(frames=np.zeros((1, 8, 8, 3), np.uint8), task="none"))
    with served.client("grpc") as client:  # MODEL has no encoders
        outcomes = client.evaluate([video, ProgressSample(random_trajectory(0, 2)), video], return_errors=True)
    assert [type(outcome) for outcome in outcomes] == [ModelNotFoundError, ProgressResult, ModelNotFoundError]


def test_requests_in_flight_are_bounded(served: Served) -> None:
    class Counting(Connection):
        now = most = 0

        async def infer(self, *arguments: object, **options: object) -> Answer:
            self.now += 1
            self.most = max(self.most, self.now)
            try:
                return await super().infer(*arguments, **options)  # type: ignore[arg-type]
            finally:
                self.now -= 1

    transport = Counting(served.url("grpc"))
    with RewardClient("", transports=[transport], model=MODEL, max_in_flight=3) as client:
        for future in [client.submit(sample) for sample in mixed_samples(30)]:
            future.result()
    assert transport.most == 3


def test_model_info_tells_what_the_checkpoint_takes(served: Served, protocol: str) -> None:
    with served.client(protocol, FRAMES_MODEL) as client:
        info, frames = client.model_info(), client.model_info(frames=True)
    assert (info.name, info.versions, info.max_batch_size) == (FRAMES_MODEL, ("1",), 64)
    assert (info.max_frames, info.frame_size, info.progress_bins) == (16, None, 10)
    assert (info.video_dim, info.text_dim) == WIDTHS
    assert (frames.max_frames, str(frames.frame_size), frames.progress_bins) == (16, "shortest 64", 10)
    assert (frames.video_dim, frames.text_dim) == (None, None)


def test_what_is_not_served_is_told(served: Served, protocol: str) -> None:
    with served.client(protocol, "not_served") as client:
        with pytest.raises(ModelNotFoundError, match=f"not_served.*served: .*{MODEL}"):
            client.model_info()
        with pytest.raises(DeadlineExceededError, match=r"not_served and not_served_frames: not ready within 0\.3 s"):
            client.wait_ready(0.3)


def test_a_long_trajectory_is_subsampled_when_asked(served: Served) -> None:
    long, short = random_trajectory(1, 40), random_trajectory(2, 5)
    kept = np.rint(np.linspace(0, 39, 16)).astype(int)
    cut = replace(long, video_embeddings=long.positions[kept])
    with served.client("grpc") as client:
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


def test_both_orders_are_asked_under_the_task_of_the_first(served: Served) -> None:
    first, second = random_trajectory(1, 40), random_trajectory(2, 5)
    back = replace(second, text_embedding=first.text_embedding)
    with served.client("grpc") as client:
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


def test_each_trajectory_is_resized_by_its_own_size_when_asked(served: Served) -> None:
    random = np.random.default_rng(4)
    wide, tall = (
        Trajectory(frames=random.integers(0, 256, (num_frames, *size, 3), np.uint8), task="open the drawer")
        for num_frames, size in ((4, (120, 160)), (3, (200, 90)))
    )
    with served.client("grpc", FRAMES_MODEL) as client:
        size = client.model_info(frames=True).frame_size
        assert size is not None
        smaller = [replace(t, frames=resize_frames(t.positions, size)) for t in (wide, tall)]
        assert smaller[0].positions.shape[1:] != smaller[1].positions.shape[1:]
        assert_same(client.preference(wide, tall, resize=True), client.preference(*smaller))
        resized = client.progress(wide, resize=True)
        np.testing.assert_allclose(resized.progress, client.progress(wide).progress, rtol=0, atol=5e-4)


def test_pairs_of_two_frame_sizes_are_scored(served: Served) -> None:
    random = np.random.default_rng(5)
    videos = [
        Trajectory(frames=random.integers(0, 256, (num_frames, *size, 3), np.uint8), task="open the drawer")
        for num_frames, size in ((4, (48, 60)), (3, (90, 61)), (2, (48, 60)))
    ]
    samples = [PreferenceSample(a, b) if a is videos[0] else SimilaritySample(a, b) for a in videos for b in videos]
    with served.client("grpc", FRAMES_MODEL) as client:
        answers = client.evaluate(samples)
    for result, expected in zip(answers, load_engine(FRAMES_MODEL).evaluate(samples), strict=True):
        assert_same(result, expected)


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


def test_timing_and_logits_come_when_asked(served: Served) -> None:
    with served.client("grpc") as client:
        plain = client.progress(random_trajectory(0, 3))
        full = client.progress(random_trajectory(0, 3), logits=True, timing=True)
    assert (plain.timing, plain.progress_logits) == (None, None)
    assert full.progress_logits is not None and full.timing is not None
    assert full.progress_logits.shape == (3, 10)
    assert full.timing.forward_ms > 0


TOKENS = "q3_tok_disc10"  # trained on at most 8 frames, takes more
MORE = "trajectory: expected at most 8 frames, as in the training of "


def filmed(num_frames: int) -> Trajectory:
    frames = np.random.default_rng(num_frames).integers(0, 256, (num_frames, 32, 32, 3), np.uint8)
    return Trajectory(frames=frames, task="stack the cups")


def test_a_client_tells_once_of_more_frames_than_in_training(
    served: Served, caplog: pytest.LogCaptureFixture, protocol: str
) -> None:
    with served.client(protocol, TOKENS) as client:
        client.progress(filmed(8))
        client.progress(filmed(9), subsample=True)
        client.progress(filmed(9), frame_steps=4)
        assert caplog.messages == []
        for num_frames in (10, 12):
            client.progress(filmed(num_frames))
    (told,) = caplog.messages
    assert told.startswith(MORE)
    assert "got 10: score 8 of them (subsample=True), or each frame on its prefix" in told


CALLS: dict[str, Callable[[RewardClient], object]] = {
    "evaluate": lambda client: client.evaluate([ProgressSample(filmed(3)), ProgressSample(filmed(9))]),
    "submit": lambda client: client.submit(ProgressSample(filmed(9))).result(),
    "preference": lambda client: client.preference(filmed(3), filmed(9)),
    "a step of an episode": lambda client: [
        client.episode("stack", sampling="linspace_round", frames=9).add(frame) for frame in filmed(1).positions
    ],
}


@pytest.mark.parametrize("ask", CALLS.values(), ids=CALLS)
def test_every_call_tells_of_more_frames_than_in_training(
    served: Served, caplog: pytest.LogCaptureFixture, ask: Callable[[RewardClient], object]
) -> None:
    with served.client("grpc", TOKENS) as client:
        ask(client)
    assert [message.startswith(MORE) for message in caplog.messages] == [True]


def test_an_async_client_tells_once_of_more_frames_than_in_training(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    async def asked() -> None:
        async with AsyncRewardClient(served.url("grpc"), model=TOKENS) as client:
            await asyncio.gather(*(client.progress(filmed(9)) for _ in range(3)))

    asyncio.run(asked())
    assert [message.startswith(MORE) for message in caplog.messages] == [True]


class Described(Shelf):
    """Counts the questions about the model. lacks_description: answers none"""

    num_described = 0
    lacks_description = False
    more: Mapping[str, Any] = MappingProxyType({})

    async def model_info(self, model: str, timeout_s: float) -> ModelInfo:
        self.num_described += 1
        if self.lacks_description:
            raise ModelNotFoundError(model)
        return replace(await super().model_info(model, timeout_s), **self.more)


def test_the_model_is_described_once_however_many_calls_follow() -> None:
    shelf = Described(has_encoder=False)
    with RewardClient("", transports=[shelf]) as client:
        client.progress(filmed(1))
        for future in [client.submit(ProgressSample(filmed(2))) for _ in range(20)]:
            future.result()
        for _ in range(20):
            client.progress(filmed(2))
    assert shelf.num_described == 1


def test_a_model_without_a_description_is_scored() -> None:
    shelf = Described(has_encoder=False)
    shelf.lacks_description = True
    with RewardClient("", transports=[shelf]) as client:
        assert client.progress(filmed(2)).unclear is None


def test_a_step_has_each_score_that_the_checkpoint_gives_unasked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(FRAME_SCORES, "log_prob", replace(FRAME_SCORES["log_prob"], asked="if given"))  # type: ignore[arg-type]
    names = [name for name, score in FRAME_SCORES.items() if score.asked == "if given"]
    shelf = Described(has_encoder=False)
    shelf.more = {"more_scores": tuple(names)}
    (frame,) = filmed(1).positions
    with RewardClient("", transports=[shelf]) as client:
        step = client.episode("stack", cameras=("front", "wrist")).add({"front": frame, "wrist": frame})
        steps = client.episodes(2, "stack").add([frame, frame], mask=[False, True])
    expected = {name: True if FRAME_SCORES[name].mark else pytest.approx(0.1) for name in names}
    assert step.more_scores == steps.of(1).more_scores == expected
    assert names == [*step.more_scores]
    np.testing.assert_allclose(steps.more_scores["log_prob"], [np.nan, 0.1])
    assert steps.unclear.tolist() == [False, True]


@pytest.mark.parametrize(
    "more", [{"trained_frames": None}, {"needs_whole_episode": True}], ids=["unknown", "whole episodes"]
)
def test_a_checkpoint_without_a_limit_of_training_gets_no_line(
    caplog: pytest.LogCaptureFixture, more: dict[str, Any]
) -> None:
    shelf = Described(has_encoder=False)
    shelf.more = more
    with RewardClient("", transports=[shelf]) as client:
        client.progress(filmed(40))
    assert caplog.messages == []
