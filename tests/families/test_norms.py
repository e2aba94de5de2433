# SPDX-License-Identifier: MIT
"""The RMSNorm for GPUs equals transformers' norms bit for bit on the CPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

import goldens
from pretended import CUDA, pretended
from rfm import families
from rfm.engine import Engine
from rfm.engine.layers import RmsNorm, is_rms_norm, speed_up
from rfm.vlm.checkpoint import VlmCheckpoint
from rfm_client import PreferenceSample, ProgressSample, Sample
from vlm import PLAIN, video

NAMES = [PLAIN, "q25_boundary_disc10"]
SAMPLES: list[Sample] = [
    ProgressSample(video(0, 3, 64, 64)),
    PreferenceSample(video(1, 2, 64, 96), video(2, 3, 64, 64)),
]


def checkpoint(name: str) -> VlmCheckpoint:
    config = goldens.config(name)
    loaded = families.load(config.checkpoint, **config.sources)
    assert isinstance(loaded, VlmCheckpoint)
    return loaded


def with_fused_norms(network: nn.Module) -> int:
    """Apply ``speed_up``'s norms on the CPU. Return the number of norms."""
    found = [
        (module, name, child)
        for module in network.modules()
        for name, child in module.named_children()
        if is_rms_norm(child)
    ]
    for module, name, child in found:
        setattr(module, name, RmsNorm(child.weight, child.variance_epsilon))
    return len(found)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=["float32", "bfloat16"])
@pytest.mark.parametrize("name", NAMES)
def test_the_norms_of_gpus_give_the_bits_of_transformers_norms(name: str, dtype: torch.dtype) -> None:
    engine = Engine.of(checkpoint(name), dtype=dtype)
    expected = engine.evaluate(SAMPLES)
    assert with_fused_norms(engine.predictor.network) > 0  # type: ignore[attr-defined]  # of this family
    for result, reference in zip(engine.evaluate(SAMPLES), expected, strict=True):
        assert not isinstance(result, Exception) and not isinstance(reference, Exception)
        for got, wanted in zip(goldens.frame_scores(result), goldens.frame_scores(reference), strict=True):
            np.testing.assert_array_equal(got.progress, wanted.progress)
            np.testing.assert_array_equal(got.progress_logits, wanted.progress_logits)
            np.testing.assert_array_equal(got.success, wanted.success)
        assert getattr(result, "preference", None) == getattr(reference, "preference", None)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=["float32", "bfloat16"])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 300.0], ids=str)
def test_a_norm_of_gpus_gives_the_bits_of_transformers_norm(scale: float, dtype: torch.dtype) -> None:
    """Return values from epsilon's root to the largest channels of trained networks."""
    network = Engine.of(checkpoint(PLAIN), dtype=dtype).predictor.network  # type: ignore[attr-defined]  # of this family
    norm = network.model.language_model.norm
    torch.manual_seed(0)
    norm.weight.normal_(1, 0.3)
    x = (torch.randn(2, 33, len(norm.weight)) * scale).to(dtype)
    with torch.inference_mode():
        assert torch.equal(RmsNorm(norm.weight, norm.variance_epsilon)(x), norm(x))


@pytest.mark.parametrize("name", NAMES)
def test_all_norms_are_replaced_on_a_device_and_none_on_the_cpu(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On CPUs, PyTorch's own RMSNorm is slower in bfloat16."""
    network = checkpoint(name).build(torch.float32)
    num_norms, names = sum(map(is_rms_norm, network.modules())), list(network.state_dict())
    speed_up(network)
    assert sum(map(is_rms_norm, network.modules())) == num_norms > 0
    with pretended(monkeypatch):
        network.to(CUDA)
        speed_up(network)
    assert sum(map(is_rms_norm, network.modules())) == 0
    assert sum(isinstance(module, RmsNorm) for module in network.modules()) == num_norms
    assert list(network.state_dict()) == names
