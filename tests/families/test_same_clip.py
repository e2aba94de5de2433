# SPDX-License-Identifier: MIT
"""A clip has one score: alone, in a batch, and in a process that has just started (docs/reference/contract.md)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import goldens
from rfm import published
from rfm.engine import Engine
from rfm_client import Float32Array, ProgressResult, ProgressSample, Sample
from vlm import BFLOAT16, video

CLIP = ProgressSample(video(0, 5, 84, 112))
OTHERS: list[Sample] = [
    ProgressSample(video(seed, num_frames, *size))
    for seed, num_frames, size in ((1, 8, (140, 56)), (2, 2, (64, 64)), (3, 3, (84, 112)), (4, 16, (56, 56)))
]
BOUNDS = {"float32": 1e-5, "bfloat16": 2e-3}
COLD = (
    "import json, torch; torch.set_num_threads(1); from test_same_clip import *;"
    "print(json.dumps({dtype: progress(engine(dtype), [CLIP]).tolist() for dtype in BOUNDS}))"
)


def engine(dtype: str) -> Engine:
    config = goldens.config(BFLOAT16)
    return Engine.of(published.load(config.checkpoint, **config.sources), dtype=getattr(torch, dtype))


def progress(engine: Engine, samples: list[Sample]) -> Float32Array:
    result = engine.evaluate(samples)[0]
    assert isinstance(result, ProgressResult), result
    return result.progress


@pytest.fixture(scope="module")
def cold() -> dict[str, list[float]]:
    """Return the first pass's scores of another process by dtype."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [str(Path(__file__).parent), *sys.path]))}
    done = subprocess.run([sys.executable, "-c", COLD], env=environment, check=True, capture_output=True, text=True)
    return dict(json.loads(done.stdout))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", BOUNDS)
def test_a_clip_has_one_score_alone_in_a_batch_and_in_a_fresh_process(dtype: str, cold: dict[str, list[float]]) -> None:
    warm, bound = engine(dtype), BOUNDS[dtype]
    alone = progress(warm, [CLIP])
    np.testing.assert_array_equal(progress(warm, [CLIP]), alone)
    np.testing.assert_allclose(progress(warm, [CLIP, *OTHERS]), alone, rtol=0, atol=bound)
    np.testing.assert_allclose(progress(warm, [CLIP] * 7), alone, rtol=0, atol=bound)
    np.testing.assert_allclose(cold[dtype], alone, rtol=0, atol=bound)
