# SPDX-License-Identifier: MIT
"""Several threads prepare frames for a GPU: each once, with the same pixels as a single thread."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch

from engines import load_engine
from reward_models import ROOT
from rfm import published
from rfm.engine import Engine
from rfm.engine.feature_cache import BYTES_PER_MIB, FeatureCache
from rfm.engine.threads import IN_TURN, FrameThreads
from rfm.families.rewind.encoders import Encoders
from rfm.families.roboreward import prompts
from rfm.qwen.predictor import QwenPredictor
from rfm_client import ProgressSample, UInt8Array
from rfm_client.contract.samples import EncoderSample
from rfm_client.contract.wire import frame_digest
from servers import PATIENCE_S
from vlm import PLAIN, video

THREE = FrameThreads(3)
ASKED = ROOT / "topreward" / "checkpoints" / "vlm_fp32_untied"
MODELS = [PLAIN, "q25_video_avg_disc10", "roboreward", "topreward", "topreward-robometer"]
SIZES = [(5, 56, 84), (7, 256, 256), (3, 340, 500), (1, 64, 64)]  # frames, height, width


def predictor_of(model: str) -> QwenPredictor:
    is_asked = model.startswith(("robo", "top"))
    engine = Engine.of(published.load(str(ASKED), reward_model=model)) if is_asked else load_engine(model)
    assert isinstance(engine.predictor, QwenPredictor)
    return engine.predictor


def test_several_threads_work_at_once_and_give_the_parts_in_order() -> None:
    all_are_there = threading.Barrier(3)

    def work(part: Sequence[int]) -> Sequence[int]:
        all_are_there.wait(PATIENCE_S)
        return part

    assert THREE.parts(work, range(7)) == [range(3), range(3, 6), range(6, 7)]


def test_a_gpu_gets_all_threads_of_the_instance_and_the_cpu_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 5)
    assert [FrameThreads.of(torch.device(kind)).number for kind in ("cuda", "cpu")] == [5, 1]


@pytest.mark.parametrize("cache_mib", [0, 1])
@pytest.mark.parametrize("model", MODELS)
def test_several_threads_make_the_pixels_of_one(model: str, cache_mib: int) -> None:
    collator = predictor_of(model).collator
    for seed, size in enumerate(SIZES):
        cache = FeatureCache[Any](cache_mib * BYTES_PER_MIB) if cache_mib else None
        (one, *_), (several, *_) = (collator.rows(ProgressSample(video(seed, *size))) for _ in range(2))
        expected = collator.to_size(one.videos[0], cache, IN_TURN)
        made = collator.to_size(several.videos[0], cache, THREE)
        assert torch.equal(made.pixels, expected.pixels)
        np.testing.assert_array_equal(made.places, expected.places)
        assert several.videos[0].digests == one.videos[0].digests


@pytest.mark.parametrize("with_cache", [False, True])
def test_several_threads_make_the_embeddings_of_one(with_cache: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    encoders = load_engine("enc_c1_t1_disc10").encoders
    assert isinstance(encoders, Encoders)
    samples = [EncoderSample((video(seed, *size),)) for seed, size in enumerate([*SIZES, (60, 20, 31)])]
    made = []
    for threads in (IN_TURN, THREE):
        monkeypatch.setattr(encoders, "threads", threads)
        cache = FeatureCache[Any](BYTES_PER_MIB) if with_cache else None
        outcomes = encoders.encode(samples, None, cache)
        made.append([each.trajectories[0].positions for each in outcomes if isinstance(each, EncoderSample)])
    assert len(made[0]) == len(samples)
    for one, several in zip(*made, strict=True):
        np.testing.assert_array_equal(several, one)


def test_only_frames_that_the_model_sees_are_resized() -> None:
    collator = Engine.of(
        published.load(str(ASKED), reward_model="topreward-robometer,num_prefixes=3")
    ).predictor.collator  # type: ignore[attr-defined]
    rows = collator.rows(ProgressSample(video(0, 20, 64, 64)))
    sized = collator.to_size(rows[0].videos[0])
    seen = {int(frame) for row in rows for frame in row.picked}
    assert len(sized.pixels) == len(seen) < 20
    assert {int(frame) for frame in np.flatnonzero(sized.places >= 0)} == seen


def test_a_frame_of_several_prefixes_makes_one_round_trip_through_jpeg(monkeypatch: pytest.MonkeyPatch) -> None:
    as_jpeg, made = prompts.as_jpeg, []

    def counted(frame: UInt8Array) -> UInt8Array:
        made.append(frame_digest(frame))
        return as_jpeg(frame)

    monkeypatch.setattr(prompts, "as_jpeg", counted)
    engine = Engine.of(published.load(str(ASKED), reward_model="roboreward-expected"), feature_cache_mib=4)
    for _ in range(2):  # the second time, all features are cached
        (result,) = engine.evaluate([ProgressSample(video(0, 6, 64, 64), frame_steps=3)])
        assert not isinstance(result, Exception), result
    assert len(made) == len(set(made)) == 6
