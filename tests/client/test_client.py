# SPDX-License-Identifier: MIT
"""Calls of the client: answers, errors, deadlines, what is asked of a served model."""

from __future__ import annotations

import asyncio
import time
import urllib.request
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from dataclasses import replace

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from client_calls import NOBODY, futures
from engines import load_engine
from mixtures import FRAMES_MODEL, MODEL, TOLERANCE, assert_same, mixed_samples, plug
from reference_server import Served
from rfm_client import (
    AsyncRewardClient,
    DeadlineExceededError,
    FrameScores,
    InferenceFailedError,
    InvalidSampleError,
    ModelNotFoundError,
    PreferenceResult,
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
from rfm_client.scoring.batching import MAX_REQUEST_BYTES
from rfm_client.transport.deadline import Deadline
from rfm_client.transport.in_flight import MAX_BYTES, InFlight
from shelves import Shelf
from trajectories import random_trajectory


def sync_calls(url: str, samples: list[Sample]) -> list[Result]:
    with RewardClient(url, model=MODEL) as client:
        return client.evaluate(samples)


def sync_single_calls(url: str, samples: list[Sample]) -> list[Result]:
    with RewardClient(url, model=MODEL) as client:
        calls: dict[type, Callable[[Sample], Result]] = {
            ProgressSample: lambda sample: client.progress(*sample.trajectories),
            PreferenceSample: lambda sample: client.preference(*sample.trajectories),
            SimilaritySample: lambda sample: client.similarity(*sample.trajectories),
        }
        return [calls[type(sample)](sample) for sample in samples]


def asyncio_calls(url: str, samples: list[Sample]) -> list[Result]:
    async def ask() -> list[Result]:
        async with AsyncRewardClient(url, model=MODEL) as client:
            calls: dict[type, Callable[[Sample], object]] = {
                ProgressSample: lambda sample: client.progress(*sample.trajectories),
                PreferenceSample: lambda sample: client.preference(*sample.trajectories),
                SimilaritySample: lambda sample: client.similarity(*sample.trajectories),
            }
            return await asyncio.gather(*(calls[type(sample)](sample) for sample in samples))  # type: ignore[call-overload]

    return asyncio.run(ask())


def asyncio_batch(url: str, samples: list[Sample]) -> list[Result]:
    async def ask() -> list[Result]:
        async with AsyncRewardClient(url, model=MODEL) as client:
            return await client.evaluate(iter(samples))

    return asyncio.run(ask())


STYLES = [sync_calls, sync_single_calls, futures, asyncio_calls, asyncio_batch]


@pytest.mark.parametrize("style", STYLES, ids=lambda style: str(style.__name__))
def test_every_style_of_call_gives_the_engine_s_answers(
    served: Served, protocol: str, style: Callable[[str, list[Sample]], list[Result]]
) -> None:
    samples = mixed_samples(12)
    answers = style(served.url(protocol), samples)
    for answer, expected in zip(answers, load_engine(MODEL).evaluate(samples), strict=True):
        assert_same(answer, expected)
        assert answer.model_version == "1"  # type: ignore[union-attr]


def test_a_thousand_samples_of_any_kind_come_back_in_order(served: Served, protocol: str) -> None:
    embeddings = mixed_samples(997)
    frames = np.random.default_rng(0).integers(0, 256, (3, 24, 32, 3), np.uint8)
    films = [Trajectory(frames=frames[:length], task="stack the cups") for length in (1, 3)]
    with served.client(protocol, FRAMES_MODEL) as client:
        wide, deep = client.model_info().video_dim, client.model_info().text_dim
        assert wide is not None
        assert deep is not None
        samples: list[Sample] = [narrowed(sample, wide, deep) for sample in embeddings]
        samples[500:500] = [ProgressSample(films[0]), PreferenceSample(*films), ProgressSample(films[1])]
        answers = client.evaluate(samples)
    assert len(answers) == 1000
    expected = load_engine(FRAMES_MODEL).evaluate(samples)
    for answer, alone in zip(answers, expected, strict=True):
        assert_same(answer, alone)


def narrowed(sample: Sample, video_dim: int, text_dim: int) -> Sample:
    """The sample with embeddings of other widths."""

    def cut(trajectory: Trajectory) -> Trajectory:
        video, text = trajectory.video_embeddings, trajectory.text_embedding
        assert video is not None
        assert text is not None
        return replace(trajectory, video_embeddings=video[:, :video_dim], text_embedding=text[:text_dim])

    trajectories = [cut(trajectory) for trajectory in sample.trajectories]
    return ProgressSample(trajectories[0]) if isinstance(sample, ProgressSample) else type(sample)(*trajectories)


def test_a_bad_sample_fails_alone_or_is_raised_with_its_place(served: Served, protocol: str) -> None:
    samples = mixed_samples(5)
    too_long = ProgressSample(random_trajectory(0, 20))
    with served.client(protocol) as client:
        outcomes = client.evaluate([*samples, too_long, "a string"], return_errors=True)  # type: ignore[list-item]
        good = client.evaluate(samples)
        with pytest.raises(
            InvalidSampleError,
            match=r"^samples\[5\]\.num_frames: expected at most 16 .*, got 20: .*subsample=True.* \(request \S+\)$",
        ):
            client.evaluate([*samples, too_long])
    for outcome, expected in zip(outcomes[:5], good, strict=True):
        assert_same(outcome, expected)
    assert isinstance(outcomes[5], InvalidSampleError)
    assert str(outcomes[6]) == "sample: expected ProgressSample, PreferenceSample or SimilaritySample, got str"


def test_samples_of_a_model_that_is_not_served_fail_and_the_others_are_scored(served: Served, protocol: str) -> None:
    film = ProgressSample(Trajectory(frames=np.zeros((1, 8, 8, 3), np.uint8), task="none"))
    with served.client(protocol) as client:  # MODEL has no encoders
        outcomes = client.evaluate([film, film, ProgressSample(random_trajectory(0, 2)), film], return_errors=True)
    kinds = [type(outcome) for outcome in outcomes]
    assert kinds == [ModelNotFoundError, ModelNotFoundError, ProgressResult, ModelNotFoundError]


def test_a_cancelled_call_is_cancelled_on_the_server(served: Served) -> None:
    """Triton 2.51 does not hear every cancellation, so there are several rounds. In its queue it cancels them itself."""

    def num_cancelled() -> float:
        in_model = metric(served, "rfm_samples", outcome="cancelled")
        return in_model + metric(served, "nv_inference_request_failure", reason="CANCELED")

    before = num_cancelled()
    with served.client("grpc") as client, ThreadPoolExecutor(3) as pool:
        for _ in range(10):
            plugs = [pool.submit(client.evaluate, long_samples()) for _ in range(3)]
            next(as_completed(plugs))  # so the next one runs, and what is asked now has to wait
            late = [client.submit(ProgressSample(random_trajectory(0, 4)), timeout_s=0.1) for _ in range(5)]
            assert {type(future.exception()) for future in late} <= {DeadlineExceededError, type(None)}
            for plug in plugs:
                plug.result()
            time.sleep(1.0)  # for the model to tell Triton what it has counted
            if num_cancelled() > before:
                return
    pytest.fail("no cancelled call was cancelled on the server")


def metric(served: Served, name: str, **labels: str) -> float:
    """What Triton's metrics say of MODEL."""
    with urllib.request.urlopen(served.endpoints.metrics_url, timeout=10) as answer:
        families = list(text_string_to_metric_families(answer.read().decode()))
    wanted = {"model": MODEL, **labels}.items()
    return sum(
        s.value
        for family in families
        for s in family.samples
        if s.name.removesuffix("_total") == name and wanted <= s.labels.items()
    )


def long_samples() -> list[Sample]:
    """Each takes so long to score that the model asks whether those behind it have been cancelled."""
    return [ProgressSample(random_trajectory(0, 2048), frame_steps=16) for _ in range(8)]


def full_batch() -> list[Sample]:
    """One request that no other can share a batch with, and that takes a while."""
    return [ProgressSample(random_trajectory(0, 40), frame_steps=16) for _ in range(64)]


def test_a_deadline_ends_a_call(served: Served, protocol: str) -> None:
    with served.client(protocol) as client, ThreadPoolExecutor(3) as pool:
        plugs = [pool.submit(client.evaluate, full_batch()) for _ in range(3)]
        next(as_completed(plugs))  # two more are to come before what is asked now
        with pytest.raises(DeadlineExceededError, match=r"no answer within 0\.05 s"):
            client.progress(random_trajectory(0, 4), timeout_s=0.05)
        for plug in plugs:
            plug.result()
        assert client.progress(random_trajectory(0, 4)).last_progress > 0


def test_what_was_answered_in_time_is_kept(served: Served) -> None:
    with RewardClient(served.url("grpc"), model=MODEL, max_in_flight=1) as client:
        first, second = client.submit(plug()[0]), client.submit(ProgressSample(random_trajectory(0, 2)), timeout_s=0.01)
        with pytest.raises(DeadlineExceededError, match=r"no answer within 0\.01 s"):
            second.result()
        assert first.result().progress.shape == (256,)


def test_a_cancelled_future_disturbs_no_other(served: Served) -> None:
    with served.client("grpc") as client:
        plugged = [client.submit(sample) for sample in plug()]
        waiting = client.submit(ProgressSample(random_trajectory(0, 4)))
        assert waiting.cancel()
        with pytest.raises(CancelledError):
            waiting.result()
        for future in plugged:
            future.result()
        assert client.progress(random_trajectory(0, 4)).last_progress > 0


def test_requests_in_flight_are_bounded(served: Served) -> None:
    class Counting:
        """A real transport that counts."""

        def __init__(self) -> None:
            from rfm_client.transport.calls import connect

            self.inner = connect(served.url("grpc"))
            self.url = self.inner.url
            self.now = self.most = 0

        async def infer(self, *arguments: object, **options: object) -> object:
            self.now += 1
            self.most = max(self.most, self.now)
            try:
                return await self.inner.infer(*arguments, **options)  # type: ignore[arg-type]
            finally:
                self.now -= 1

        def __getattr__(self, name: str) -> object:
            return getattr(self.inner, name)

    transport = Counting()
    with RewardClient("", transports=[transport], model=MODEL, max_in_flight=3) as client:  # type: ignore[list-item]
        pending = [client.submit(sample) for sample in mixed_samples(30)]
        for future in pending:
            future.result()
    assert transport.most == 3


def test_bytes_in_flight_are_bounded_and_more_than_the_bound_goes_alone() -> None:
    async def ask() -> None:
        room = InFlight(10).room
        most = MAX_BYTES - 2**20
        async with room(most // 2, Deadline(1)), room(most // 2, Deadline(1)):
            with pytest.raises(DeadlineExceededError):
                async with room(2**20 + 1, Deadline(0.05)):
                    pytest.fail("there was no room")
        async with room(3 * MAX_BYTES, Deadline(1)):
            with pytest.raises(DeadlineExceededError):
                async with room(0, Deadline(0.05)):
                    pytest.fail("there was no room")
        async with room(most, Deadline(1)):  # what was given up was given back
            pass

    asyncio.run(ask())


def test_large_samples_are_sent_in_several_requests(served: Served) -> None:
    from mixtures import counts

    frames = np.zeros((4, 700, 1000, 3), np.uint8)
    samples = [ProgressSample(Trajectory(frames=frames, task="none")) for _ in range(3)]
    assert frames.nbytes > MAX_REQUEST_BYTES // 2
    with served.client("grpc", FRAMES_MODEL) as client:
        before = counts(served, f"{FRAMES_MODEL}_frames")[0]
        client.evaluate(samples)
        assert counts(served, f"{FRAMES_MODEL}_frames")[0] == before + 3


def test_model_info_tells_what_the_checkpoint_takes(served: Served, protocol: str) -> None:
    with served.client(protocol, FRAMES_MODEL) as client:
        info, frames = client.model_info(), client.model_info(frames=True)
    assert (info.name, info.versions, info.max_batch_size) == (FRAMES_MODEL, ("1",), 64)
    assert (info.max_frames, info.frame_size) == (16, None)
    config = load_engine(FRAMES_MODEL).predictor.network.config  # type: ignore[attr-defined]
    assert (info.video_dim, info.text_dim) == (config.video_feature_dim, config.text_feature_dim)
    assert info.progress_bins == frames.progress_bins == 10
    assert frames.max_frames == 16
    preprocessor = load_engine(FRAMES_MODEL).encoders.preprocessor  # type: ignore[attr-defined]
    assert str(frames.frame_size) == f"shortest {preprocessor.resize_px}"
    assert (frames.video_dim, frames.text_dim) == (None, None)


def test_model_info_of_what_is_not_served_says_so(served: Served, protocol: str) -> None:
    with served.client(protocol, "not_served") as client, pytest.raises(ModelNotFoundError, match="not_served"):
        client.model_info()


def test_a_long_trajectory_is_subsampled_when_asked(served: Served, protocol: str) -> None:
    long, short = random_trajectory(1, 40), random_trajectory(2, 5)
    assert long.video_embeddings is not None
    kept = np.rint(np.linspace(0, 39, 16)).astype(int)
    cut = replace(long, video_embeddings=long.video_embeddings[kept])
    with served.client(protocol) as client:
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


VERDICTS: dict[str, tuple[float, float | None, float, bool | None, str | None]] = {
    "first, asked once": (0.9, None, 0.9, None, "first"),
    "second, asked once": (0.1, None, 0.1, None, "second"),
    "even, asked once": (0.5, None, 0.5, None, None),
    "first": (0.75, 0.5 - 0.25, 0.75, True, "first"),
    "second": (0.25, 0.875, 0.1875, True, "second"),
    "disagree": (0.75, 0.75, 0.5, False, None),
    "disagree, though the mean is high": (1.0, 0.625, 0.6875, False, None),
    "one is even": (0.75, 0.5, 0.625, False, None),
    "both are even": (0.5, 0.5, 0.5, True, None),
}


@pytest.mark.parametrize(("asked", "swapped", "mean", "agree", "verdict"), VERDICTS.values(), ids=VERDICTS)
def test_there_is_a_verdict_where_the_orders_agree(
    asked: float, swapped: float | None, mean: float, agree: bool | None, verdict: str | None
) -> None:
    scores = FrameScores(progress=np.zeros(2, np.float32), success=np.zeros(2, np.float32))
    result = PreferenceResult(preference=asked, first=scores, second=scores)
    if swapped is not None:
        result = PreferenceResult.of_both_orders(
            result, PreferenceResult(preference=swapped, first=scores, second=scores)
        )
        assert result.both_orders == (asked, 1 - swapped)
    assert (result.preference, result.orders_agree, result.verdict) == (mean, agree, verdict)


def test_both_orders_are_asked_under_the_task_of_the_first(served: Served, protocol: str) -> None:
    first, second = random_trajectory(1, 40), random_trajectory(2, 5)
    back = replace(second, text_embedding=first.text_embedding)
    with served.client(protocol) as client:
        once = client.preference(first, second, subsample=True)
        swapped = client.preference(back, first, subsample=True).preference
        both = client.preference(first, second, both_orders=True, subsample=True)
        other_text = client.preference(second, first, subsample=True).preference

    async def ask() -> PreferenceResult:
        async with AsyncRewardClient(served.url(protocol), model=MODEL) as client:
            return await client.preference(
                first, replace(second, text_embedding=None), both_orders=True, subsample=True
            )

    assert other_text != pytest.approx(swapped, abs=1e-4)
    assert once.both_orders is None
    for result in (both, asyncio.run(ask())):
        assert result.both_orders == pytest.approx((once.preference, 1 - swapped), abs=TOLERANCE)
        assert_same(replace(result, preference=once.preference), once)
        assert result.first.frame_indices is not None
        assert len(result.first.frame_indices) == 16
        assert result.second.frame_indices is None


def test_orders_that_two_versions_answered_are_an_error() -> None:
    films = [Trajectory(frames=np.zeros((2, size, 8, 3), np.uint8), task="lift") for size in (8, 16)]
    with RewardClient("", transports=[Shelf(after=1)]) as client:
        with pytest.raises(InferenceFailedError, match=r"^model_version: expected one for both orders, got 1, 2: ask"):
            client.preference(*films, both_orders=True)
        assert client.preference(*films, both_orders=True).model_version == "2"


def test_an_error_of_both_orders_names_the_place_as_asked_once(served: Served) -> None:
    long, short = random_trajectory(1, 40), random_trajectory(2, 5)
    with served.client("grpc") as client:
        with pytest.raises(InvalidSampleError) as once:
            client.preference(short, long)
        with pytest.raises(InvalidSampleError) as both:
            client.preference(short, long, both_orders=True)
    assert both.value.message == once.value.message


def test_frames_are_resized_when_asked(served: Served) -> None:
    frames = np.random.default_rng(3).integers(0, 256, (4, 120, 160, 3), np.uint8)
    with served.client("grpc", FRAMES_MODEL) as client:
        size = client.model_info(frames=True).frame_size
        assert size is not None
        film = Trajectory(frames=frames, task="open the drawer")
        resized = client.progress(film, resize=True)
        from rfm_client.data.resize import resize_frames

        assert_same(resized, client.progress(replace(film, frames=resize_frames(frames, size))))
        np.testing.assert_allclose(resized.progress, client.progress(film).progress, rtol=0, atol=5e-4)


def test_each_trajectory_of_a_pair_is_resized_by_its_own_size(served: Served) -> None:
    random = np.random.default_rng(4)
    wide, tall = (
        Trajectory(frames=random.integers(0, 256, (num_frames, *size, 3), np.uint8), task="open the drawer")
        for num_frames, size in ((4, (120, 160)), (3, (200, 90)))
    )
    from rfm_client.data.resize import resize_frames

    with served.client("grpc", FRAMES_MODEL) as client:
        size = client.model_info(frames=True).frame_size
        assert size is not None
        smaller = [replace(t, frames=resize_frames(t.positions, size)) for t in (wide, tall)]
        assert smaller[0].positions.shape[1:] != smaller[1].positions.shape[1:]
        assert_same(client.preference(wide, tall, resize=True), client.preference(*smaller))


def test_pairs_of_two_frame_sizes_may_be_awaited(served: Served, protocol: str) -> None:
    random = np.random.default_rng(5)
    films = [
        Trajectory(frames=random.integers(0, 256, (num_frames, *size, 3), np.uint8), task="open the drawer")
        for num_frames, size in ((4, (48, 60)), (3, (90, 61)), (2, (48, 60)))
    ]
    samples = [PreferenceSample(a, b) if a is films[0] else SimilaritySample(a, b) for a in films for b in films]

    async def ask() -> Sequence[Result]:
        async with AsyncRewardClient(served.url(protocol), model=FRAMES_MODEL) as client:
            return await client.evaluate(samples)

    for result, expected in zip(asyncio.run(ask()), load_engine(FRAMES_MODEL).evaluate(samples), strict=True):
        assert_same(result, expected)


def test_timing_and_logits_come_when_asked(served: Served, protocol: str) -> None:
    with served.client(protocol) as client:
        plain = client.progress(random_trajectory(0, 3))
        full = client.progress(random_trajectory(0, 3), logits=True, timing=True)
    assert (plain.timing, plain.progress_logits) == (None, None)
    assert full.progress_logits is not None
    assert full.progress_logits.shape == (3, 10)
    assert full.timing is not None
    assert full.timing.forward_ms > 0


def test_nobody_there_is_an_error_at_once_without_retries() -> None:
    with RewardClient(NOBODY, retry=False) as client, pytest.raises(ServerUnavailableError, match="refused"):
        client.progress(random_trajectory(0, 2))


def test_nobody_there_is_an_error_when_the_time_is_up(caplog: pytest.LogCaptureFixture) -> None:
    with RewardClient(NOBODY, timeout_s=2) as client, pytest.raises(ServerUnavailableError, match="refused"):
        client.progress(random_trajectory(0, 2))
    assert [record.message.partition(": trying again")[0] for record in caplog.records] == [NOBODY]


def test_wait_ready_returns_or_says_what_is_not_ready(served: Served, protocol: str) -> None:
    with served.client(protocol) as client:
        client.wait_ready(10)
    with served.client(protocol, "not_served") as client:
        expected = r"not_served and not_served_frames: not ready within 0\.3 s"
        with pytest.raises(DeadlineExceededError, match=expected):
            client.wait_ready(0.3)
