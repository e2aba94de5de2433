# SPDX-License-Identifier: MIT
"""A real Triton over gRPC and over HTTP: answers, errors, deadlines, descriptions, keys and TLS are the same.

All other tests of the client ask stand-ins, engines in this process, or Triton over gRPC alone.
"""

from __future__ import annotations

import asyncio
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed

import numpy as np
import pytest

from engines import load_engine
from mixtures import FRAMES_MODEL, MODEL, assert_same, mixed_samples, plug
from rfm_client import (
    AsyncRewardClient,
    ClientClosedError,
    DeadlineExceededError,
    InvalidSampleError,
    ModelNotFoundError,
    PreferenceSample,
    ProgressSample,
    Result,
    SimilaritySample,
    Trajectory,
)
from rfm_client.frames import Sampling
from servers import Served
from tolerances import BATCHED_VLM_TOLERANCE
from trajectories import random_trajectory

KINDS: dict[type, str] = {ProgressSample: "progress", PreferenceSample: "preference", SimilaritySample: "similarity"}
IMAGES = "q3_tok_disc10"


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


@pytest.mark.slow
def test_an_episode_step_by_step_has_the_scores_of_the_whole(served: Served, protocol: str) -> None:
    frames = np.random.default_rng(1).integers(0, 256, (6, 56, 84, 3), np.uint8)
    with served.client(protocol, IMAGES) as client, client.episode("stack the cups", frames=4) as episode:
        steps = [episode.add(frame).progress for frame in frames]
        curve = client.curve(Trajectory(frames=frames, task="stack the cups"), Sampling("rint_pad", 4))
    np.testing.assert_allclose(steps, curve.progress, rtol=0, atol=BATCHED_VLM_TOLERANCE)


def test_a_bad_sample_fails_alone_or_is_raised_with_its_place_in_our_words(served: Served, protocol: str) -> None:
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
        with pytest.raises(InvalidSampleError, match=r"^video_embeddings: expected \[-1,768\], got \[2,5\] \(request "):
            client.progress(random_trajectory(0, 2, 5, 384))
        with pytest.raises(InvalidSampleError, match=r"^text_embedding: expected \[384\], got \[7\] \(request \S+\)$"):
            client.progress(random_trajectory(0, 2, 768, 7))
    for outcome, expected in zip(outcomes[:5], good, strict=True):
        assert_same(outcome, expected)
    assert isinstance(outcomes[5], InvalidSampleError)
    assert str(outcomes[6]) == "sample: expected ProgressSample, PreferenceSample or SimilaritySample, got str"


@pytest.mark.slow
def test_a_deadline_or_a_cancelled_future_ends_a_call_and_no_other(served: Served, protocol: str) -> None:
    full = [ProgressSample(random_trajectory(0, 40), frame_steps=16) for _ in range(64)]
    with served.client(protocol) as client, ThreadPoolExecutor(3) as pool:
        plugs = [pool.submit(client.evaluate, full) for _ in range(3)]
        next(as_completed(plugs))  # two more come before the next call
        assert client.submit(ProgressSample(random_trajectory(0, 4))).cancel()
        with pytest.raises(DeadlineExceededError, match=r"no answer within 0\.05 s"):
            client.progress(random_trajectory(0, 4), timeout_s=0.05)
        for each in plugs:
            each.result()
        assert client.progress(random_trajectory(0, 4), timeout_s=1e9).last_progress > 0


def test_closing_a_client_ends_its_calls_with_an_error_that_says_so(served: Served, protocol: str) -> None:
    """Also calls that have not been sent yet, of other tasks and threads."""

    async def outcomes() -> list[object]:
        client = AsyncRewardClient(served.url(protocol), model=MODEL, max_in_flight=2)
        asked = [asyncio.create_task(client.score(sample)) for sample in plug()]
        assert await client.is_ready()
        cancelled = asked.pop()
        if sys.version_info >= (3, 11):  # older versions do not tell who cancelled it
            cancelled.cancel()
        await client.close()
        if sys.version_info >= (3, 11):
            with pytest.raises(asyncio.CancelledError):
                await cancelled
        return list(await asyncio.gather(*asked, return_exceptions=True))

    told = [outcome for outcome in asyncio.run(outcomes()) if isinstance(outcome, BaseException)]
    assert {type(error) for error in told} == {ClientClosedError}
    assert any("this client was closed during the call" in str(error) for error in told)

    with served.client(protocol) as client:
        pending = [client.submit(sample) for sample in plug()]
    errors = [future.exception(timeout=30) for future in pending]
    assert {type(error) for error in errors} <= {ClientClosedError, type(None)}
    assert "this RewardClient was closed during the call" in {str(error) for error in errors}


def test_model_info_describes_a_served_model_and_refuses_one_not_served(served: Served, protocol: str) -> None:
    with served.client(protocol, FRAMES_MODEL) as client:
        info, frames = client.model_info(), client.model_info(frames=True)
    assert (info.name, info.versions, info.max_batch_size) == (FRAMES_MODEL, ("1",), 64)
    assert (info.max_frames, info.frame_size, info.progress_bins) == (16, None, 10)
    assert (info.video_dim, info.text_dim) == (48, 32)
    assert (frames.max_frames, str(frames.frame_size), frames.progress_bins) == (16, "shortest 64", 10)
    assert (frames.video_dim, frames.text_dim) == (None, None)
    with served.client(protocol, "not_served") as client:
        with pytest.raises(ModelNotFoundError, match=f"not_served.*served: .*{MODEL}"):
            client.model_info()
        with pytest.raises(DeadlineExceededError, match=r"not_served and not_served_frames: not ready within 0\.3 s"):
            client.wait_ready(0.3)
        assert not client.is_ready()
