# SPDX-License-Identifier: MIT
"""Derive ``max_batch_size``: the largest batch that still makes a GPU score more samples a second.

Small batches leave a GPU idle while the CPU launches kernels. From about SATURATING_FLOP on, each further sample adds
its full time: on an H200, 8 samples of a Robometer-4B take 16 ms each, and so do 32. A larger batch gains nothing,
makes every caller wait for its end, and leaves nothing to the other GPUs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rfm.config import ExportConfig
from rfm.family import Checkpoint
from rfm_client.contract import ProgressSample
from rfm_client.contract.synthetic import random_trajectory

SATURATING_FLOP = 20e12  # of matrix products
MOST_SAMPLES = 64  # small networks hardly gain from more
TYPICAL_FRAMES, TYPICAL_PX = 8, 224
TYPICAL_TASK = "put the red block in the bowl"
_TERA = 1e12


def with_batch_size(settings: ExportConfig, checkpoint: Checkpoint, say: Callable[[str], object]) -> ExportConfig:
    """Return the settings with a ``max_batch_size``: the user's, else the saturating one.

    say: takes a line for the user about a number below MOST_SAMPLES
    Raises CheckpointError.
    """
    if settings.max_batch_size is not None:
        return settings
    sample = typical_sample(checkpoint)
    flop = checkpoint.flop(sample)
    number = saturating_samples(flop)
    if number < MOST_SAMPLES:
        (trajectory,) = sample.trajectories
        shown = f"{trajectory.num_frames} frames of {TYPICAL_PX}x{TYPICAL_PX}"
        why = f"one sample of {shown} takes {flop / _TERA:.1f} TFLOP, and a GPU is saturated at about"
        say(f"max_batch_size is {number}: {why} {SATURATING_FLOP / _TERA:.0f} (--max-batch-size sets another number)")
    return replace(settings, max_batch_size=number)


def saturating_samples(flop: float) -> int:
    """Return the power of two, from 1 to MOST_SAMPLES, that comes nearest to SATURATING_FLOP. flop: of one sample"""
    power = round(math.log2(SATURATING_FLOP / max(flop, 1.0)))
    return int(2 ** min(max(power, 0), math.log2(MOST_SAMPLES)))


def typical_sample(checkpoint: Checkpoint) -> ProgressSample:
    """Return a progress sample with the frames of training, else TYPICAL_FRAMES."""
    description = checkpoint.description
    num_frames = description.trained_frames or TYPICAL_FRAMES
    if description.network_frames is not None:
        num_frames = min(num_frames, description.network_frames)
    size_px = (TYPICAL_PX, TYPICAL_PX)
    random = np.random.default_rng(0)
    return ProgressSample(random_trajectory(random, num_frames, description.widths, task=TYPICAL_TASK, size_px=size_px))
