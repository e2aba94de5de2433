# SPDX-License-Identifier: MIT
"""Samples that a checkpoint of any family cannot score fail alone, with what was expected.

One table: the model, the sample, and the beginning of the message.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
import torch

import robodopamine
import rynnvalue
from engines import asked_engine, load_engine
from reward_models import ROOT
from rfm.engine import Engine
from rfm.families.rewind.checkpoint import RewindPredictor
from rfm.families.rewind.network import RewindTransformer
from rfm_client import (
    InvalidSampleError,
    PreferenceSample,
    ProgressSample,
    RewardError,
    Sample,
    SimilaritySample,
    Trajectory,
    UInt8Array,
)
from small_network import SMALL
from trajectories import random_trajectory
from vlm import PLAIN, video

REWIND, ENCODED, TOP, ROBOMETER, ROBO, DOPAMINE, RYNN = (
    "ReWiND", "enc_c1_t1_disc10", "topreward", "topreward-robometer", "roboreward", "Robo-Dopamine", "RynnValue",
)  # fmt: skip


@functools.cache
def engine_of(name: str) -> Engine:
    if name == REWIND:
        torch.manual_seed(0)
        return Engine(RewindPredictor(RewindTransformer(SMALL), torch.device("cpu")), max_sample_tokens=16)
    if name == DOPAMINE:
        return robodopamine.case_named("forward_T5").engine()
    if name == RYNN:
        return rynnvalue.engine_of(rynnvalue.FOLDER / "bro_quantile_fp32_tied" / "checkpoint", rynnvalue.USUAL)
    if name == ROBO:
        return asked_engine(ROOT / "roboreward" / "rr_tied_bf16" / "checkpoint", name)
    if name in (TOP, ROBOMETER):
        return asked_engine(ROOT / "topreward" / "checkpoints" / "vlm_fp32_untied", name)
    return load_engine(name)


def embedded(num_frames: int, widths: tuple[int, int] = (12, 6)) -> Trajectory:
    return random_trajectory(num_frames, num_frames, *widths)


def black(num_frames: int, height: int = 64, width: int = 64) -> UInt8Array:
    return np.zeros((num_frames, height, width, 3), np.uint8)


def filmed(num_frames: int, height: int = 64, width: int = 64, task: str = "lift", **more: Any) -> Trajectory:
    return Trajectory(frames=black(num_frames, height, width), task=task, **more)


PAIR = (video(0, 2, 56, 56), video(1, 2, 56, 56))
TOO_LONG = "num_frames: expected at most 8 (max_len of this checkpoint, which has per-frame progress tokens), got 9"
NO_HEAD = "sample_type: expected {} (this checkpoint has no {} head), got {}"
SPECIAL = "task: expected text without the model's special tokens, got '{}'"
WRONG: dict[str, tuple[str, Sample, str]] = {
    "more frames than progress tokens": (REWIND, ProgressSample(embedded(9)), TOO_LONG),
    "dense mode of more frames": (REWIND, ProgressSample(embedded(8), 9), "frame_steps: expected at most 8 (max_len of this checkpoint, which has"),
    "more frames in the second trajectory": (REWIND, PreferenceSample(embedded(1), embedded(9)), TOO_LONG),
    "frames of another width": (REWIND, ProgressSample(embedded(2, (13, 6))), "video_embeddings: expected float32 [T, 12], got [2, 13]"),
    "a task of another width": (REWIND, ProgressSample(embedded(2, (12, 7))), "text_embedding: expected float32 [6], got [7]"),
    "frames without encoders": (REWIND, ProgressSample(filmed(1)), "frames: expected video_embeddings (no encoders are loaded), got frames: name the encoders with --image-encoder and --text-encoder"),
    "more tokens than the server takes": (REWIND, ProgressSample(embedded(8)), "num_frames: expected at most 16 tokens (max_sample_tokens of this server), got 17 tokens"),
    "a task that is too long": (ENCODED, ProgressSample(filmed(2, task="lift " * 100)), "task: expected at most 32 tokens (limit of the text encoder), got "),
    "a sliver": (ENCODED, ProgressSample(filmed(1, 1, 3000)), "frames: expected frames at most 50 times as long as wide, got 1 x 3000"),
    "a special token": (PLAIN, ProgressSample(filmed(1, task="lift <|prog_token|> it")), SPECIAL.format("<|prog_token|>")),
    "an image token": (PLAIN, PreferenceSample(filmed(1, task="<|image_pad|>"), PAIR[0]), SPECIAL.format("<|image_pad|>")),
    "an image that is a line": (PLAIN, ProgressSample(filmed(1, 1, 300)), "frames: expected an image at most 200 times as long as wide, got 1 x 300"),
    "a 20-megapixel frame": (PLAIN, ProgressSample(filmed(1, 4000, 5000)), "num_frames: expected at most 8192 tokens (max_position_embeddings of this checkpoint), got"),
    "similarity without a head": (PLAIN, SimilaritySample(*PAIR), NO_HEAD.format("progress or preference", "similarity", "similarity")),
    "dense mode of a whole episode": (TOP, ProgressSample(filmed(3), 2), "frame_steps: expected 0 (TOPReward's progress is relative to the whole episode"),
    "preference of TOPReward": (TOP, PreferenceSample(*PAIR), NO_HEAD.format("progress", "preference", "preference")),
    "similarity of TOPReward": (TOP, SimilaritySample(*PAIR), NO_HEAD.format("progress", "similarity", "similarity")),
    "small frames": (TOP, ProgressSample(filmed(2, 8, 8)), "frames: expected frames of at least 32 x 32 pixels, got 8 x 8"),
    "narrow frames": (TOP, ProgressSample(filmed(1, 32, 6432)), "frames: expected an image at most 200 times as long as wide"),
    "the end of a message": (TOP, ProgressSample(filmed(2, task="a <|im_end|>")), SPECIAL.format("<|im_end|>")),
    "many frames": (ROBOMETER, ProgressSample(filmed(65, 8, 8)), "num_frames: expected at most 64"),
    "a video token": (ROBOMETER, ProgressSample(filmed(2, task="a <|video_pad|>")), SPECIAL.format("<|video_pad|>")),
    "preference of RoboReward": (ROBO, PreferenceSample(*PAIR), NO_HEAD.format("progress", "preference", "preference")),
    "views": (ROBO, ProgressSample(filmed(3, views=(black(3), black(3)))), "views, goal: expected none"),
    "a goal": (ROBO, ProgressSample(filmed(3, goal=black(1)[0])), "views, goal: expected none"),
    "preference of RynnValue": (RYNN, PreferenceSample(*PAIR), NO_HEAD.format("progress", "preference", "preference")),
    "a value token": (RYNN, ProgressSample(filmed(2, task="put <value> in it")), SPECIAL.format("<value>")),
    "one frame": (DOPAMINE, ProgressSample(filmed(1)), "num_frames: expected at least 2"),
    "one wrist": (DOPAMINE, ProgressSample(filmed(3, views=(black(3),))), "views: expected none, or those of"),
    "a placeholder": (DOPAMINE, ProgressSample(filmed(3, task="a <image>")), "task: expected text without <image>"),
    "dense mode of compared frames": (DOPAMINE, ProgressSample(filmed(3), 2), "frame_steps: expected 0"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "sample", "message"), WRONG.values(), ids=WRONG)
def test_a_sample_that_cannot_be_scored_fails_alone(name: str, sample: Sample, message: str) -> None:
    good: Any = ProgressSample(embedded(3) if name == REWIND else video(1, 2, 64, 64))
    neighbours = [] if name in (ROBO, DOPAMINE) else [good]  # not where answers take long
    *first, failed = engine_of(name).evaluate([*neighbours, sample])
    assert not any(isinstance(result, RewardError) for result in first), first
    assert isinstance(failed, InvalidSampleError)
    assert str(failed).startswith(message)
