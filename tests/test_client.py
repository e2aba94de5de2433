# SPDX-License-Identifier: MIT
"""The client's calls: sync, asyncio and futures, over gRPC and HTTP, against a real server."""

from __future__ import annotations

import asyncio
import shutil
import subprocess
import sys
import sysconfig
import urllib.request
import venv
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Served, load_engine, random_trajectory
from prometheus_client.parser import text_string_to_metric_families
from test_serving import FRAMES_MODEL, MODEL, assert_same, mixed_samples, plug

from rfm_client import (
    AsyncRewardClient,
    DeadlineExceededError,
    FrameScores,
    InferenceFailedError,
    InvalidSampleError,
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
from rfm_client.batching import MAX_REQUEST_BYTES
from rfm_client.contract import wire
from rfm_client.data.fitting import evenly_spaced
from rfm_client.transport.access import Access
from rfm_client.transport.calls import Answer, GrpcTransport
from rfm_client.transport.deadline import Deadline
from rfm_client.transport.in_flight import MAX_BYTES, InFlight

NOBODY = "grpc://127.0.0.1:1"  # a port where nothing listens


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


def futures(url: str, samples: list[Sample]) -> list[Result]:
    with RewardClient(url, model=MODEL) as client:
        submitted: list[Future[Result]] = [client.submit(sample) for sample in samples]
        return [future.result() for future in submitted]


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
            InvalidSampleError, match=r"^samples\[5\]\.num_frames: expected at most 16 .*, got 20 \(request \S+\)$"
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
    """Triton 2.51 does not hear every cancellation, so there are several rounds."""
    before = metric(served, "nv_inference_request_failure", reason="CANCELED")
    with served.client("grpc") as client, ThreadPoolExecutor(3) as pool:
        for _ in range(10):
            plugs = [pool.submit(client.evaluate, full_batch()) for _ in range(3)]
            next(as_completed(plugs))  # so the next one runs, and what is asked now has to wait
            late = [client.submit(ProgressSample(random_trajectory(0, 4)), timeout_s=0.2) for _ in range(5)]
            assert {type(future.exception()) for future in late} <= {DeadlineExceededError, type(None)}
            for plug in plugs:
                plug.result()
            if metric(served, "nv_inference_request_failure", reason="CANCELED") > before:
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
                async with room(2**20, Deadline(0.05)):
                    pytest.fail("there was no room")
        async with room(3 * MAX_BYTES, Deadline(1)):
            with pytest.raises(DeadlineExceededError):
                async with room(0, Deadline(0.05)):
                    pytest.fail("there was no room")
        async with room(most, Deadline(1)):  # what was given up was given back
            pass

    asyncio.run(ask())


def test_large_samples_are_sent_in_several_requests(served: Served) -> None:
    from test_serving import counts

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
    kept = np.linspace(0, 39, 16).astype(int)
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
    with RewardClient(NOBODY, timeout_s=0.5) as client, pytest.raises(ServerUnavailableError, match="refused"):
        client.progress(random_trajectory(0, 2))
    assert [record.message.partition(": trying again")[0] for record in caplog.records] == [NOBODY]


def test_wait_ready_returns_or_says_what_is_not_ready(served: Served, protocol: str) -> None:
    with served.client(protocol) as client:
        client.wait_ready(10)
    with served.client(protocol, "not_served") as client:
        expected = r"not_served and not_served_frames: not ready within 0\.3 s"
        with pytest.raises(DeadlineExceededError, match=expected):
            client.wait_ready(0.3)


def test_a_closed_client_says_so(served: Served) -> None:
    client = served.client("grpc")
    client.close()
    client.close()
    with pytest.raises(RuntimeError, match="is closed"):
        client.progress(random_trajectory(0, 2))


def test_closing_cancels_what_is_under_way(served: Served) -> None:
    with served.client("grpc") as client:
        pending = [client.submit(sample) for sample in plug()]
    assert all(future.done() for future in pending)
    assert any(future.cancelled() for future in pending)


def test_a_fork_is_told_to_make_its_own_client() -> None:
    code = """
import os
from rfm_client import ProgressSample, RewardClient, Trajectory
import numpy as np
trajectory = Trajectory(video_embeddings=np.ones((1, 2)), text_embedding=np.ones(2))
client = RewardClient("grpc://127.0.0.1:1")
if os.fork() == 0:
    try:
        client.progress(trajectory)
    except RuntimeError as error:
        print(error, flush=True)
        client.close()
        os._exit(0)
    os._exit(1)
raise SystemExit(os.waitstatus_to_exitcode(os.wait()[1]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "which forked this one: make one in each process" in done.stdout


def test_a_fork_of_what_used_grpc_is_told_so(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a fork: gRPC's own handlers may crash one."""
    monkeypatch.setattr(GrpcTransport, "_first_process", 1)
    expected = "gRPC was used in process 1, which forked this one: .* by spawn or forkserver"
    with served.client("grpc") as client, pytest.raises(RuntimeError, match=expected):
        client.is_ready()
    with served.client("http") as client:
        assert client.is_ready()


def test_submitting_while_it_is_closed_leaves_no_future_open(served: Served) -> None:
    for _ in range(20):
        client = served.client("grpc")
        futures: list[Future[ProgressResult]] = []

        def submit(client: RewardClient = client, futures: list[Future[ProgressResult]] = futures) -> None:
            with pytest.raises(RuntimeError, match="is closed"):
                while True:
                    futures.append(client.submit(ProgressSample(random_trajectory(0, 1))))

        with ThreadPoolExecutor(2) as pool:
            submitting = [pool.submit(submit) for _ in range(2)]
            client.close()
            for thread in submitting:
                thread.result()
        assert all(future.done() for future in futures)


def test_embeddings_of_another_width_are_told_in_our_words(served: Served, protocol: str) -> None:
    with served.client(protocol) as client:
        with pytest.raises(
            InvalidSampleError, match=r"^video_embeddings: expected \[-1,768\], got \[2,5\] \(request \S+\)$"
        ):
            client.progress(random_trajectory(0, 2, 5, 384))
        with pytest.raises(InvalidSampleError, match=r"^text_embedding: expected \[384\], got \[7\] \(request \S+\)$"):
            client.progress(random_trajectory(0, 2, 768, 7))


def test_a_sample_is_shown_by_its_shapes() -> None:
    shown = repr(ProgressSample(Trajectory(frames=np.zeros((2, 8, 8, 3), np.uint8), task="stack")))
    assert shown == "ProgressSample(trajectory=Trajectory(frames=uint8 [2, 8, 8, 3], task='stack'), frame_steps=0)"


def test_what_makes_the_samples_may_ask_the_client(served: Served) -> None:
    with served.client("grpc") as client:
        samples = (ProgressSample(random_trajectory(0, 2)) for _ in range(2) if client.is_ready())
        assert len(client.evaluate(samples)) == 2


def test_a_call_in_a_future_s_callback_is_refused_rather_than_waiting_for_itself(served: Served) -> None:
    told: Future[str] = Future()
    with served.client("grpc") as client:

        def ask(_done: Future[ProgressResult]) -> None:
            try:
                client.is_ready()
            except RuntimeError as error:
                told.set_result(str(error))

        client.submit(ProgressSample(random_trajectory(0, 2))).add_done_callback(ask)
        assert "use submit" in told.result(timeout=30)


def test_what_is_submitted_may_be_written_over(served: Served) -> None:
    trajectory = random_trajectory(0, 8)
    assert trajectory.video_embeddings is not None
    with served.client("grpc") as client:
        expected = client.progress(trajectory)
        plugged = [client.submit(sample) for sample in plug()]
        future = client.submit(ProgressSample(trajectory))
        trajectory.video_embeddings[:] = 0
        assert_same(future.result(), expected)
        for other in plugged:
            other.result()


def test_a_future_keeps_its_client(served: Served) -> None:
    assert served.client("grpc").submit(ProgressSample(random_trajectory(0, 2))).result().last_progress > 0


def test_an_asyncio_client_that_is_closed_says_so(served: Served) -> None:
    async def ask() -> None:
        client = AsyncRewardClient(served.url("grpc"), model=MODEL)
        await client.close()
        await client.progress(random_trajectory(0, 2))

    with pytest.raises(RuntimeError, match="this AsyncRewardClient is closed"):
        asyncio.run(ask())


def test_of_one_frame_the_newest_is_scored() -> None:
    assert evenly_spaced(10, 1) == [9]
    assert evenly_spaced(10, 2).tolist() == [0, 9]  # type: ignore[union-attr]
    assert evenly_spaced(10, 10) is None


def test_a_score_that_is_missing_fails_alone(served: Served) -> None:
    class Losing(GrpcTransport):
        """A real transport that loses the progress of one sample in answers to several."""

        async def infer(self, model: str, inputs: wire.Tensors, *rest: Any, **options: Any) -> Answer:
            answer = await super().infer(model, inputs, *rest, **options)
            lost = inputs[wire.VIDEO_EMBEDDINGS].sum(axis=(1, 2)) == marked
            progress = np.where(lost[:, None], np.nan, answer.tensors[wire.PROGRESS])
            return replace(answer, tensors={**answer.tensors, wire.PROGRESS: progress})

    url = served.url("grpc")
    samples = [ProgressSample(random_trajectory(seed, 3)) for seed in range(4)]
    marked = wire.encode_samples(samples[2:3])[wire.VIDEO_EMBEDDINGS].sum(axis=(1, 2))[0]
    transport = Losing(url, Access(), shared_memory=False)
    with RewardClient("", transports=[transport], model=MODEL) as client:
        outcomes = client.evaluate(samples, return_errors=True)
    assert [type(outcome) for outcome in outcomes] == [ProgressResult] * 2 + [InferenceFailedError, ProgressResult]


def test_samples_that_fail_together_have_errors_of_their_own() -> None:
    samples = mixed_samples(3)
    with RewardClient(NOBODY, retry=False) as client:
        outcomes = client.evaluate([samples[0], samples[0], samples[0]], return_errors=True)
    assert len({id(outcome) for outcome in outcomes}) == 3
    assert {type(outcome) for outcome in outcomes} == {ServerUnavailableError}


def test_an_http_client_at_the_grpc_port_is_told_at_once(served: Served) -> None:
    url = served.url("grpc").replace("grpc://", "http://")
    with RewardClient(url) as client, pytest.raises(InferenceFailedError, match="no answer of an HTTP server"):
        client.progress(random_trajectory(0, 2))


def test_a_client_that_is_not_closed_does_not_keep_the_interpreter(served: Served) -> None:
    code = f"""
from rfm_client import RewardClient
assert RewardClient({served.url("grpc")!r}, model={MODEL!r}).is_ready()
client = RewardClient({served.url("http")!r}, model={MODEL!r})
assert client.is_ready()
"""
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("urls", "message"),
    [
        (
            "localhost:8001",
            "url: expected grpc://host:port or http://host:port, or grpcs:// or https://, got 'localhost:8001'",
        ),
        (
            "grpc://localhost",
            "url: expected grpc://host:port or http://host:port, or grpcs:// or https://, got 'grpc://localhost'",
        ),
        (
            ["grpc://a:1", "ftp://b:2"],
            "url: expected grpc://host:port or http://host:port, or grpcs:// or https://, got 'ftp://b:2'",
        ),
        ([], "url: expected at least one, got none"),
    ],
    ids=str,
)
def test_a_wrong_url_is_refused_when_the_client_is_made(urls: str | list[str], message: str) -> None:
    with pytest.raises(ValueError, match="url") as raised:
        RewardClient(urls)
    assert str(raised.value) == message


@pytest.mark.parametrize("timeout_s", [float("inf"), float("nan"), 0, -1, 2e9])
def test_a_deadline_must_lie_ahead_and_within_reach(timeout_s: float) -> None:
    wanted = f"timeout_s: expected a number of seconds above 0 and at most 1e+09, got {timeout_s}"
    with RewardClient(NOBODY) as client:
        calls: list[Callable[[], object]] = [
            lambda: RewardClient(NOBODY, timeout_s=timeout_s),
            lambda: client.progress(random_trajectory(0, 1), timeout_s=timeout_s),
            lambda: client.submit(ProgressSample(random_trajectory(0, 1)), timeout_s=timeout_s).result(),
            lambda: client.model_info(timeout_s=timeout_s),
            lambda: client.is_ready(timeout_s=timeout_s),
            lambda: client.wait_ready(timeout_s),
        ]
        for call in calls:
            with pytest.raises(ValueError, match="timeout_s") as caught:
                call()
            assert str(caught.value) == wanted


def test_a_call_may_take_very_long(served: Served, protocol: str) -> None:
    with served.client(protocol) as client:
        assert client.progress(random_trajectory(0, 1), timeout_s=1e9).progress.shape == (1,)


@dataclass(frozen=True)
class Voting:
    """A vote over success probabilities, and what it should say."""

    success: list[float]
    last: int
    threshold: float
    expected: bool


VOTES = {
    "the last frame": Voting([0.1, 0.9], 1, 0.5, True),
    "reaching is enough": Voting([0.5], 1, 0.5, True),
    "two of three": Voting([0.9, 0.2, 0.9], 3, 0.5, True),
    "half is no majority": Voting([0.9, 0.2], 2, 0.5, False),
    "fewer frames than asked": Voting([0.9], 5, 0.5, True),
    "a higher threshold": Voting([0.9], 1, 0.95, False),
    "only the last count": Voting([0.9, 0.9, 0.1], 1, 0.5, False),
}


@pytest.mark.parametrize("vote", VOTES.values(), ids=VOTES)
def test_success_is_voted_over_the_last_frames(vote: Voting) -> None:
    scores = FrameScores(progress=np.zeros(1, np.float32), success=np.array(vote.success, np.float32))
    assert scores.succeeded(last=vote.last, threshold=vote.threshold) is vote.expected


def test_progress_becomes_a_reward() -> None:
    progress = np.array([0.25, 0.5, 0.375], np.float32)
    scores = FrameScores(progress=progress, success=progress)
    assert scores.last_progress == 0.375
    np.testing.assert_array_equal(scores.progress_deltas, np.array([0, 0.25, -0.125], np.float32))
    with pytest.raises(ValueError, match="last: expected at least one frame, got 0"):
        scores.succeeded(last=0)


@pytest.mark.parametrize("name", ["last_progress", "progress_deltas", "succeeded"])
def test_what_a_checkpoint_does_not_tell_becomes_no_number(name: str) -> None:
    nothing = np.full(2, np.nan, np.float32)
    scores = FrameScores(progress=nothing, success=nothing)
    with pytest.raises(ValueError, match="got NaN: this checkpoint does not tell it"):
        getattr(scores, name)() if name == "succeeded" else getattr(scores, name)


def test_the_client_is_light_and_quick_to_import() -> None:
    code = """
import sys, time
started = time.perf_counter()
import rfm_client
seconds = time.perf_counter() - started
heavy = {"torch", "pandas", "av", "PIL", "gymnasium", "typer", "rich", "matplotlib", "grpc", "gevent", "aiohttp"}
print(seconds, *sorted(heavy & set(sys.modules)))
"""
    outputs = [
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
        for _ in range(5)
    ]
    assert min(float(seconds) for seconds, *_ in outputs) < 0.3
    assert all(len(output) == 1 for output in outputs), outputs[0]


USER_FILE = """
from concurrent.futures import Future

import numpy as np
from rfm_client import (
    AsyncRewardClient, PreferenceSample, ProgressResult, ProgressSample, Result, RewardClient, RewardError, Trajectory
)

trajectory = Trajectory(frames=np.zeros((2, 8, 8, 3), np.uint8), task="stack the cups")
with RewardClient(["grpc://a:8001", "http://b:8000"], model="rfm", timeout_s=5.0, shared_memory=True) as client:
    reward: float = client.progress(trajectory, frame_steps=4, subsample=True).last_progress
    future: Future[ProgressResult] = client.submit(ProgressSample(trajectory), timeout_s=1.0)
    some: list[Result] = client.evaluate([ProgressSample(trajectory), PreferenceSample(trajectory, trajectory)])
    each: list[Result | RewardError] = client.evaluate([ProgressSample(trajectory)], return_errors=True)
    preference: float = client.preference(trajectory, trajectory).preference


async def rewards() -> float:
    async with AsyncRewardClient("grpc://a:8001") as client:
        return (await client.similarity(trajectory, trajectory)).similarity
"""
WRONG_USES = {
    'client.progress(trajectory, timeout="5")': "timeout",
    "client.progress(trajectory, sub_sample=True)": "sub_sample",
    "client.submit(ProgressSample(trajectory)).result().preference": "preference",
}


def test_a_user_s_file_type_checks_against_the_installed_wheel(tmp_path: Path) -> None:
    source = Path(__file__).parents[1] / "client"
    wheels, environment = tmp_path / "wheels", tmp_path / "environment"
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    copied = tmp_path / "client"
    shutil.copytree(source, copied, ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__"))
    subprocess.run([*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", wheels, copied], check=True)
    venv.create(environment, with_pip=False)
    installed = next(environment.glob("lib/python*/site-packages"))
    subprocess.run([*pip, "install", "--no-deps", "--target", installed, *wheels.glob("*.whl")], check=True)
    (installed / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    user_file = tmp_path / "user.py"

    def check(text: str) -> subprocess.CompletedProcess[str]:
        user_file.write_text(text)
        options = ["--strict", "--config-file=", f"--python-executable={environment}/bin/python"]
        command = [sys.executable, "-m", "mypy", *options, user_file]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)

    good = check(USER_FILE)
    assert good.returncode == 0, good.stdout
    bad = check(USER_FILE + "\n\n" + "\n".join(WRONG_USES))
    for name in WRONG_USES.values():
        assert f'"{name}"' in bad.stdout


def test_tensors_hold_one_trajectory_without_a_copy() -> None:
    frames = np.zeros((2, 4, 4, 3), np.uint8)
    tensors = wire.encode_samples([ProgressSample(Trajectory(frames=frames, task="none"))])
    assert np.shares_memory(tensors[wire.FRAMES], frames)
