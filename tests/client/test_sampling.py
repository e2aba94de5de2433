# SPDX-License-Identifier: MIT
"""The sampling rules, against the frames that the original functions took; frames as small as the checkpoint reads them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch

import goldens
from every_score import assert_same_scores, every_score
from paths import GOLDEN
from rfm.engine.layers import Normalisation
from rfm.families.rewind.encoders import ImagePreprocessor
from rfm.qwen.images import QwenImages, fitted_size
from rfm_client import FrameScores, FrameSize, ProgressResult, ProgressSample, Trajectory, UInt8Array
from rfm_client.frames import Rule, Sampling, resize_frames
from rfm_client.frames.fit_to_checkpoint import fitted, snapshot
from rfm_client.frames.sampling import thinned

VECTORS = GOLDEN / "sampling-vectors.json"
ELSEWHERE = goldens.ROOT.parent / VECTORS.name  # beside the further reference cases, where there are some
READINGS = {"rewind_pad16": ("rewind_pad16_online", "rewind_pad16_offline")}  # two arguments of the same function


def cases(file: Path) -> Iterator[tuple[Sampling, int, list[int]]]:
    """A rule with a number of frames, the newest frame, and the frames that the original picks."""
    for frames, lengths in json.loads(file.read_text()).items():
        for length, rules in lengths.items():
            for name, indices in rules.items():
                for rule in READINGS.get(name, (name,)):
                    yield Sampling(rule, int(frames)), int(length) - 1, indices


@pytest.mark.parametrize(
    "file",
    [
        VECTORS,
        pytest.param(
            ELSEWHERE,
            marks=[pytest.mark.reference, pytest.mark.skipif(not ELSEWHERE.exists(), reason="RFM_GOLDENS names none")],
        ),
    ],
    ids=["here", "elsewhere"],
)
def test_each_rule_shows_the_frames_that_the_original_takes(file: Path) -> None:
    seen = set()
    for sampling, t, indices in cases(file):
        prefix = sampling.prefix(t)
        assert prefix.indices.dtype == np.int64
        assert prefix.indices.tolist() == indices, (sampling, t)
        seen.add((sampling.rule, sampling.frames))
        if sampling.rule == "rint_pad":
            unpadded = Sampling("rint", sampling.frames).prefix(t).indices
            assert unpadded.tolist() == indices[: min(t + 1, sampling.frames or 0)], (sampling, t)
    assert {rule for rule, _ in seen} == set(get_args(Rule)) - {"all", "rint"}
    assert len(seen) == 3 * 6 + 2


@pytest.mark.parametrize("rule", get_args(Rule))
def test_the_scores_of_prefixes_keep_all_that_the_model_gives(rule: Rule) -> None:
    sampling = Sampling(rule, None if rule in ("all", "rewind_pad16_online", "rewind_pad16_offline") else 3)
    prefixes = [sampling.prefix(t) for t in range(20)]
    results = [every_score(t, len(prefix.indices)) for t, prefix in enumerate(prefixes)]
    whole = sampling.joined([ProgressResult(**vars(result), model_version="1") for result in results])
    newest = [result.at(np.array([prefix.read])) for result, prefix in zip(results, prefixes, strict=True)]
    assert_same_scores(whole, FrameScores.joined(newest))


READ = {
    "linspace_trunc repeats frames and pads none": (Sampling("linspace_trunc", 4), 1, [0, 0, 0, 1], 3),
    "linspace_trunc of one frame shows the first": (Sampling("linspace_trunc", 1), 9, [0], 0),
    "rint of one frame shows the newest": (Sampling("rint", 1), 9, [9], 0),
    "rint_pad reads a padded slot": (Sampling("rint_pad", 4), 1, [0, 1, 1, 1], 3),
    "rewind online reads a padded slot": (Sampling("rewind_pad16_online"), 2, [0, 1, *[2] * 14], 15),
    "rewind offline reads the frame's own": (Sampling("rewind_pad16_offline"), 2, [0, 1, *[2] * 14], 2),
    "all": (Sampling("all"), 3, [0, 1, 2, 3], 3),
}


@pytest.mark.parametrize(("sampling", "t", "indices", "read"), READ.values(), ids=READ)
def test_a_rule_says_which_slot_counts(sampling: Sampling, t: int, indices: list[int], read: int) -> None:
    prefix = sampling.prefix(t)
    assert (prefix.indices.tolist(), prefix.read) == (indices, read)
    assert prefix.indices[prefix.read] == t or sampling.frames == 1
    slots = prefix.frame_slots
    assert prefix.indices[slots].tolist() == sorted(set(indices))
    assert slots[-1] == read


def test_a_long_clip_is_cut_as_in_training() -> None:
    cut = {(10, 1): [9], (10, 4): [0, 3, 6, 9], (6, 3): [0, 2, 5], (10, 10): None, (10, None): None}
    for asked, expected in cut.items():
        kept = thinned(*asked)
        assert (None if kept is None else kept.tolist()) == expected


REFUSED: dict[str, tuple[Any, ...]] = {
    "another rule": ("evenly", 4, "sampling: expected one of linspace_trunc, linspace_round, .*, all, got 'evenly'"),
    "a number with all": ("all", 4, "frames: expected none with the rule all, got 4"),
    "another number than 16": (
        "rewind_pad16_online",
        8,
        "frames: expected 16 with the rule rewind_pad16_online, got 8",
    ),
    "no number": ("rint_pad", None, "frames: expected at least 1 with the rule rint_pad, got None"),
}


@pytest.mark.parametrize(("rule", "frames", "message"), REFUSED.values(), ids=REFUSED)
def test_invalid_sampling_rules_and_frame_counts_are_refused(rule: Any, frames: int | None, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}$"):
        Sampling(rule, frames)


def test_the_checkpoint_says_how_many_frames_if_the_caller_does_not() -> None:
    assert Sampling.of("rint_pad", 4, 8) == Sampling("rint_pad", 4)
    assert Sampling.of("all", None, 8) == Sampling("all")
    assert Sampling.of("rewind_pad16_offline", None, 8).frames == 16
    assert Sampling.of(None, None, 8) == Sampling("rint_pad", 8)
    assert Sampling.of(None, 4, 8, trained_padding=False) == Sampling("rint", 4)
    with pytest.raises(
        ValueError, match="frames: expected how many frames the rule rint_pad shows the model, got none"
    ):
        Sampling.of("rint_pad", None, None)


def test_a_frame_size_is_read_and_written_or_refused() -> None:
    for text, size in {"shortest 256": ("shortest", (256,)), "exact 224x320": ("exact", (224, 320))}.items():
        assert (FrameSize.parse(text), str(FrameSize(*size))) == (FrameSize(*size), text)  # type: ignore[arg-type]
    for text in ("", "256", "shortest 0", "shortest -1", "shortest 2x3", "exact 224", "longest 512", "exact ٣x٣"):
        with pytest.raises(ValueError) as refused:
            FrameSize.parse(text)
        forms = "'shortest PX' or 'exact HEIGHTxWIDTH'"
        assert str(refused.value) == f"frame_size: expected {forms}, got {text!r}"


FITTED = {
    "landscape": ("shortest 256", (480, 640), (256, 341)),
    "portrait": ("shortest 256", (640, 480), (341, 256)),
    "small enough": ("shortest 256", (256, 4000), (256, 4000)),
    "exact": ("exact 224x320", (480, 640), (224, 320)),
    "exact of a longer edge": ("exact 224x320", (200, 640), (200, 320)),
}


@pytest.mark.parametrize(("text", "size", "expected"), FITTED.values(), ids=FITTED)
def test_frames_are_only_ever_made_smaller(text: str, size: tuple[int, int], expected: tuple[int, int]) -> None:
    frames = np.zeros((1, *size, 3), np.uint8)
    resized = resize_frames(frames, FrameSize.parse(text))
    assert (resized.shape, resized.dtype) == ((1, *expected, 3), np.uint8)
    assert (resized is frames) == (size == expected)


def test_views_and_goal_are_fitted_as_the_frames_and_nothing_is_lost() -> None:
    frames = np.arange(6, dtype=np.uint8).repeat(48 * 64 * 3).reshape(6, 48, 64, 3)
    given = Trajectory(frames=frames, task="lift", views=(frames + 10, frames[:, :, :40]), goal=frames[5])
    (fit,) = fitted(snapshot(ProgressSample(given)), 2, FrameSize("exact", (24, 32))).sample.trajectories
    assert [array.shape for array in (fit.positions, *fit.views)] == [(2, 24, 32, 3)] * 3
    assert [array[:, 0, 0, 0].tolist() for array in (fit.positions, *fit.views)] == [[0, 5], [10, 15], [0, 5]]
    assert fit.goal is not None
    assert fit.goal.shape == (24, 32, 3)
    assert fit.task == given.task


NO_COLOURS = Normalisation((0.0,) * 3, (1 / 255,) * 3)  # so that the network reads grey levels
SIZES = [(300, 401), (401, 300)]


def large(height: int, width: int) -> UInt8Array:
    """A picture with edges, text-like detail and noise: uint8 [2, H, W, 3]."""
    rows, columns = np.mgrid[:height, :width]
    waves = 127 * (1 + np.sin(rows * columns / 900))
    noise = np.random.default_rng(1).integers(0, 256, (height, width))
    frames = np.stack([waves, 255 * (columns // 40 % 2), noise], axis=-1)
    return np.stack([frames, frames[::-1]]).astype(np.uint8)


@pytest.mark.parametrize("size", SIZES)
def test_resized_frames_reach_rewind_s_encoder_within_one_grey_level_of_the_originals(size: tuple[int, int]) -> None:
    frames = large(*size)
    read = ImagePreprocessor(256, (256, 256), (0.0,) * 3, (1 / 255,) * 3)
    resized = resize_frames(frames, FrameSize.parse("shortest 256"))
    differences = (read(torch.from_numpy(frames)) - read(torch.from_numpy(resized))).abs()
    assert differences.max() <= 1
    assert differences.mean() < 0.01


def test_qwen_reads_the_very_pixels_that_it_would_have_read() -> None:
    frames, size = large(300, 401), FrameSize("exact", fitted_size(224, 320, 28))
    images = QwenImages(14, NO_COLOURS, (224, 320))
    assert torch.equal(images.images_to_size(frames), images.images_to_size(resize_frames(frames, size)))
