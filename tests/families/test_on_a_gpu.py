# SPDX-License-Identifier: MIT
"""GPU tests that need only the packages of a bare GPU machine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import goldens
import rfm_export
from engines import serve_config
from rfm_client import Trajectory, as_trajectory

CAMERA = "observation.images.top"
FRAMES = np.random.default_rng(0).integers(0, 256, (4, 6, 8, 3), np.uint8)


@pytest.mark.gpu
def test_tensors_are_fetched_from_the_gpu() -> None:
    frames = Trajectory(frames=torch.from_numpy(FRAMES).cuda()).frames  # type: ignore[arg-type]
    np.testing.assert_array_equal(frames, FRAMES)
    channels_first = torch.from_numpy(FRAMES).permute(0, 3, 1, 2) / 255
    filmed = as_trajectory({CAMERA: channels_first.cuda().requires_grad_()})
    np.testing.assert_array_equal(filmed.positions, FRAMES)


@pytest.mark.gpu
def test_a_gpu_compares_an_export_with_the_checkpoint(tmp_path: Path) -> None:
    said: list[str] = []
    large = next(iter(goldens.VLM))
    settings = replace(serve_config(large), num_gpus=1, dtype="float32")
    assert rfm_export.export(large.checkpoint, tmp_path, settings, say=said.append) == 1
    assert "on cuda:0" in said[-1]
