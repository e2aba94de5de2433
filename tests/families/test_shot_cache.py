# SPDX-License-Identifier: MIT
"""Features of a shot are computed once, cached by content, and never mixed up."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from rfm.engine import Engine, Execution
from rfm.engine.feature_cache import BYTES_PER_MIB, FeatureCache
from rfm.qwen.predictor import QwenPredictor
from rfm_client import InvalidSampleError, PreferenceSample, ProgressSample, Trajectory, UInt8Array
from rfm_client.contract import wire
from rfm_client.contract.wire import frame_digest
from rfm_client.frames import Rule, Sampling
from tolerances import TOLERANCE
from vlm import assert_close, load, video

TASK = "stack the blocks"
TAKE_A_NUMBER = ("linspace_trunc", "linspace_round", "rint", "rint_pad")
AS_VIDEO = " as video"  # no reference is a Qwen3-VL that reads videos
MODELS = ["q3_tok_disc10", f"q3_tok_disc10{AS_VIDEO}", "q25_peft_adapter_disc10", "q25_video_avg_disc10"]
IMAGES_AND_VIDEO = [MODELS[0], MODELS[3]]


def engine(name: str, cache: FeatureCache[Any] | None = None) -> Engine:
    checkpoint = load(name.removesuffix(AS_VIDEO))
    if name.endswith(AS_VIDEO):
        config = replace(checkpoint.config, multi_image=False, per_frame_progress_token=False)
        checkpoint = replace(checkpoint, config=config)
    return Engine(checkpoint.predictor(torch.device("cpu"), None, cache), cache=cache)


def of_both(name: str, cache: FeatureCache[Any] | None = None) -> tuple[Engine, Engine]:
    """Return an engine with a cache, by default large enough for all, and an engine without."""
    return engine(name, FeatureCache(64 * BYTES_PER_MIB) if cache is None else cache), engine(name)


def predictor_of(cached: Engine) -> QwenPredictor:
    assert isinstance(cached.predictor, QwenPredictor)
    return cached.predictor


def frames_of(seed: int, count: int, size: tuple[int, int] = (56, 84)) -> UInt8Array:
    return video(seed, count, *size).positions


def whole(frames: UInt8Array) -> ProgressSample:
    return ProgressSample(Trajectory(frames=frames, task=TASK))


def named(
    served: Engine, frames: Sequence[UInt8Array], sent: Sequence[UInt8Array], frame_steps: int = 0
) -> ProgressSample:
    """Return a request about frames with only some of them sent, as a model with this engine decodes it."""
    tensors = wire.encode_refs([[*map(frame_digest, frames)]], [TASK], [*sent])
    tensors[wire.FRAME_STEPS][:] = frame_steps
    assert served.cache is not None
    (sample,) = wire.decode_samples(tensors, served.cache.found)
    assert isinstance(sample, ProgressSample)
    return sample


def ask(
    served: Engine,
    frames: Sequence[UInt8Array],
    sent: Sequence[UInt8Array],
    frame_steps: int = 0,
    execution: Execution | None = None,
) -> Any:
    (outcome,) = served.score([served.prepare(named(served, frames, sent, frame_steps))], execution or Execution())
    return outcome


def assert_scored(outcome: Any, plain: Engine, frames: UInt8Array, frame_steps: int = 0) -> None:
    """The scores equal those of an engine without a cache."""
    (expected,) = plain.evaluate([ProgressSample(Trajectory(frames=frames, task=TASK), frame_steps=frame_steps)])
    assert_close(outcome, expected, TOLERANCE)


@pytest.mark.parametrize(
    ("name", "rule"), [(MODELS[0], "rewind_pad16_online"), (MODELS[0], "all"), *((name, "rint_pad") for name in MODELS)]
)
def test_an_episode_has_the_scores_of_the_whole_and_each_shot_is_encoded_once(name: str, rule: Rule) -> None:
    cached, plain = of_both(name)
    sampling = Sampling(rule, 4 if rule in TAKE_A_NUMBER else None)
    frames, execution = frames_of(0, 18 if "16" in rule else 8), Execution()  # pad16 takes 16 of more
    per_shot, shown, num_shown = predictor_of(cached).collator.frames_per_shot, set(), 0
    for step in range(len(frames)):
        window = frames[sampling.prefix(step).indices]
        assert_scored(ask(cached, window, frames[step : step + 1], 0, execution), plain, window)
        digests = [*map(frame_digest, window)]
        digests += digests[-1:] * (-len(digests) % per_shot)
        shots = {tuple(digests[i : i + per_shot]) for i in range(0, len(digests), per_shot)}
        shown, num_shown = shown | shots, num_shown + len(shots)
    assert execution.num_encoded == per_shot * len(shown)
    assert execution.num_found == per_shot * (num_shown - len(shown))


def test_a_video_has_frames_of_one_size() -> None:
    cached, kept, sent = engine(MODELS[0], FeatureCache(BYTES_PER_MIB)), frames_of(8, 1), frames_of(9, 1, (84, 56))
    ask(cached, kept, kept)
    expected = "frame_digests: expected digests of frames of one size, got sizes [(56, 84), (84, 56)]"
    with pytest.raises(InvalidSampleError, match=f"^{re.escape(expected)}$"):
        named(cached, [*kept, *sent], sent)


@pytest.mark.parametrize("name", IMAGES_AND_VIDEO)
def test_a_cache_that_evicts_at_every_step_changes_no_score(name: str) -> None:
    cache = FeatureCache[Any](3 * 56 * 84 * 3 + 2 * BYTES_PER_MIB // 100)
    frames, unknown = frames_of(2, 8), 0
    cached, plain = of_both(name, cache)
    for stop in range(4, 9):
        window = frames[stop - 4 : stop]
        try:
            outcome = ask(cached, window, window[-1:])
        except InvalidSampleError:
            unknown += 1
            outcome = ask(cached, window, window)
        assert_scored(outcome, plain, window)
        assert cache.num_bytes <= cache.limit_bytes
    assert unknown


@pytest.mark.parametrize("name", IMAGES_AND_VIDEO)
def test_whole_videos_of_other_callers_fill_the_cache(name: str) -> None:
    cached, plain = of_both(name)
    first, second = video(3, 4, 56, 84, TASK), video(4, 6, 84, 56, TASK)
    samples = [ProgressSample(first), PreferenceSample(first, second), PreferenceSample(second, first)]
    expected = plain.evaluate(samples)
    for counts in ((10, 0), (0, 10)):  # each frame of the batch once, in three samples
        execution = Execution()
        for outcome, other in zip(cached.evaluate(samples, execution), expected, strict=True):
            assert_close(outcome, other, TOLERANCE)
        assert (execution.num_encoded, execution.num_found) == counts
        assert execution.cache_bytes
    assert_scored(ask(cached, first.positions, ()), plain, first.positions)
    assert_scored(ask(cached, first.positions, (), 3), plain, first.positions, 3)


def test_cached_frames_of_one_size_are_not_used_for_another_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames of very long videos are downscaled more."""
    cached, plain = of_both(MODELS[3])
    frames = frames_of(6, 4, (448, 336))
    monkeypatch.setattr("rfm.qwen.images.VIDEO_TOTAL_TOKENS", 300.0)
    for stop in (2, 4):
        assert_scored(ask(cached, frames[:stop], frames[:stop]), plain, frames[:stop])
    rows = [predictor_of(cached).rows(whole(frames[:stop]))[0] for stop in (2, 4)]
    grid = predictor_of(cached).collator.grid  # type: ignore[attr-defined]  # of the Qwen backbones
    assert grid(rows[0].videos[0]).tokens_per_group != grid(rows[1].videos[0]).tokens_per_group


@pytest.mark.parametrize("name", IMAGES_AND_VIDEO)
def test_frames_that_are_not_finite_are_not_cached_even_if_no_score_shows_it(name: str) -> None:
    """The last tokens of a video may follow all positions that are read."""
    cache, frames = FeatureCache[Any](BYTES_PER_MIB), frames_of(12, 4)
    cached = engine(name, cache)

    def spoil(_module: Any, _inputs: Any, output: torch.Tensor) -> torch.Tensor:
        return torch.cat([output[:-1], output[-1:] * torch.nan])

    predictor_of(cached).network.model.visual.merger.register_forward_hook(spoil)
    ask(cached, frames, frames)
    assert len(cache) == 0


@pytest.mark.parametrize("name", IMAGES_AND_VIDEO)
def test_a_frame_that_comes_many_times_is_brought_to_size_once(name: str) -> None:
    """Otherwise thousands of references to a large frame would take all memory."""
    cached, plain = of_both(name)
    frames = frames_of(13, 2)[[0, 1, 1, 0, 1, 1]]
    sample = named(cached, frames, frames[:2])
    assert sample.trajectory.named is not None
    assert len({id(pixels) for _, pixels in sample.trajectory.named}) == 2
    prepared = cached.prepare(sample)
    cached.work_ahead(prepared)
    (row,) = prepared.rows
    assert len(row.videos[0].ready.pixels) == 2
    assert_scored(ask(cached, frames, frames[:2]), plain, frames)


@pytest.mark.parametrize("name", IMAGES_AND_VIDEO)
def test_black_frames_with_pixels_are_always_encoded(name: str) -> None:
    """A server probes itself with them: it is to see whether the vision tower works."""
    cached, black, execution = (
        engine(name, FeatureCache(BYTES_PER_MIB)),
        np.zeros((2, 56, 84, 3), np.uint8),
        Execution(),
    )
    for _ in range(2):
        (expected,) = cached.evaluate([whole(black)], execution)
    assert_close(ask(cached, black, (), 0, execution), expected, TOLERANCE)
    assert execution.num_encoded == 2 * predictor_of(cached).collator.frames_per_shot


@pytest.mark.parametrize("name", IMAGES_AND_VIDEO)
def test_frames_that_were_evicted_are_kept_again_though_all_their_shots_are_kept(name: str) -> None:
    cache, frames, execution = FeatureCache[Any](BYTES_PER_MIB), frames_of(17, 4), Execution()
    cached, plain = of_both(name, cache)
    cached.evaluate([whole(frames)])
    (row,) = predictor_of(cached).rows(whole(frames))
    shots = cache.found(predictor_of(cached).collator.shot_keys(row.videos[0]).values())  # type: ignore[attr-defined]
    cache.clear()
    cache.keep(shots)
    (outcome,) = cached.evaluate([whole(frames)], execution)
    for scored in (outcome, ask(cached, frames, (), 0, execution)):
        assert_scored(scored, plain, frames)
    assert execution.num_encoded == 0


def test_cached_frames_keep_no_request_in_memory() -> None:
    """A cached view would keep a whole large request in memory."""
    cache, frames = FeatureCache[Any](BYTES_PER_MIB), frames_of(10, 3)
    ask(engine(MODELS[0], cache), frames, frames)
    kept = cache.found([frame_digest(frame) for frame in frames])
    assert len(kept) == 3
    assert all(frame.base is None for frame in kept.values())
