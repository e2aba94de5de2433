# SPDX-License-Identifier: MIT
"""Pooling, image sizes and patches."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import goldens
from engines import load_engine
from rfm.engine import Engine
from rfm.vlm.images import Normalisation, QwenImages, fitted_size
from rfm_client import ProgressSample
from vlm import BFLOAT16, film, predictor_of


class Largest(TorchDispatchMode):
    """Remembers the most elements of a tensor that was made."""

    elements = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = func(*args, **(kwargs or {}))
        for tensor in made if isinstance(made, (tuple, list)) else [made]:
            if isinstance(tensor, torch.Tensor):
                self.elements = max(self.elements, tensor.numel())
        return made


@pytest.mark.parametrize("name", ["q25_attention_disc10", "q25_mean_l2"])
def test_a_long_span_costs_the_short_ones_no_memory(name: str) -> None:
    network = predictor_of(name).network
    width, long, short = network.config.hidden_dim, 4000, 500
    hidden = torch.randn(2, long, width, generator=torch.Generator().manual_seed(0))
    spans = torch.tensor([[0, 0, long], *([1, 2 * at, 2 * at + 2] for at in range(short))])
    with torch.inference_mode(), Largest() as largest:
        together = network._frame_states(hidden, spans)
    assert largest.elements <= (long + 2 * short) * width
    with torch.inference_mode():
        for index in (0, 1, short):
            alone = network._frame_states(hidden, spans[index : index + 1])
            torch.testing.assert_close(together[index : index + 1], alone, rtol=0, atol=1e-6)
        tokens = hidden[0]
        weights = torch.full((long, 1), 1 / long)
        if network.config.frame_pooling == "attention":
            weights = (network.frame_pool_attn(tokens) / network.config.pooling_temperature).softmax(dim=0)
        torch.testing.assert_close(together[0], (weights * tokens).sum(dim=0), rtol=0, atol=1e-6)


SIZES = {
    "rounded": ((60, 90), 28, (56, 84)),
    "at least four tokens": ((1, 1), 28, (56, 56)),
    "at most 16384 tokens": ((4000, 5000), 28, (3192, 4004)),
}


@pytest.mark.parametrize(("size", "factor", "expected"), SIZES.values(), ids=SIZES)
def test_images_are_fitted(size: tuple[int, int], factor: int, expected: tuple[int, int]) -> None:
    fitted = fitted_size(*size, factor)
    assert fitted == expected
    assert 4 <= fitted[0] * fitted[1] / factor**2 <= 16_384


def test_patches_hold_every_pixel_once() -> None:
    images = QwenImages(2, Normalisation((0.0,) * 3, (1 / 255,) * 3))
    frame = np.arange(8 * 8 * 3, dtype=np.uint8).reshape(1, 8, 8, 3)
    (pixels,) = images.images(frame)
    assert pixels.patches.shape == (16, 3 * 2 * 2 * 2)
    first = pixels.patches[0].reshape(3, 2, 2, 2)  # C, frame of the group, rows, columns
    np.testing.assert_allclose(first[:, 0].permute(1, 2, 0).numpy(), frame[0, :2, :2], atol=1e-4)
    assert sorted(pixels.patches.round().int().flatten().tolist()) == sorted(frame.flatten().tolist() * 2)


@pytest.mark.gpu
def test_bfloat16_on_a_gpu_is_near_float32_on_the_cpu() -> None:
    config = goldens.config(BFLOAT16)
    samples = [sample for case in config.cases() for sample in case.samples()]
    on_cpu = load_engine(BFLOAT16).evaluate(samples)
    on_gpu = Engine.from_checkpoint(config.checkpoint, base_model=str(config.base_model), device="cuda").evaluate(
        samples
    )
    for left, right in zip(on_cpu, on_gpu, strict=True):
        assert not isinstance(left, Exception), left
        assert not isinstance(right, Exception), right
        for a, b in zip(goldens.frame_scores(left), goldens.frame_scores(right), strict=True):
            np.testing.assert_allclose(a.progress, b.progress, rtol=0, atol=5e-3)
            np.testing.assert_allclose(a.success, b.success, rtol=0, atol=1.5e-2)


# Worked out by hand from qwen-vl-utils' rules: longest side 480 px, multiples of 56 px, then multiples of 28 px within
# 128 to 768 tokens a frame, of which all pairs of frames together have 115,200; at least 1.05 times 128 stay allowed.
VIDEO_SIZES = {
    "a short film keeps its size": (2, (448, 336), [(448, 336)]),
    "a long side is scaled down first": (2, (540, 960), [(270, 480), (280, 504)]),
    "a small one is enlarged": (2, (64, 64), [(112, 112), (336, 336)]),
    "1200 frames have 192 tokens each at most": (1200, (480, 480), [(504, 504), (364, 364)]),
    "2000 frames would have 115": (2000, (448, 336), [(448, 336), (364, 280)]),
}


@pytest.mark.parametrize(("count", "size", "expected"), VIDEO_SIZES.values(), ids=VIDEO_SIZES)
def test_videos_are_fitted(count: int, size: tuple[int, int], expected: list[tuple[int, int]]) -> None:
    frames = np.broadcast_to(np.zeros((1, 1, 1, 3), np.uint8), (count, *size, 3))
    sizes = QwenImages(14, Normalisation((0.5,) * 3, (0.5,) * 3))._video_sizes(frames)
    assert list(dict.fromkeys(sizes)) == expected


def test_an_image_may_be_two_hundred_times_as_long_as_wide() -> None:
    assert fitted_size(28, 5600, 28) == (28, 5600)
    with pytest.raises(ValueError, match="at most 200 times as long as wide"):
        fitted_size(28, 5601, 28)


def test_black_stays_black_when_a_video_is_enlarged() -> None:
    pixels = QwenImages(14, Normalisation((0.5,) * 3, (0.5,) * 3)).video(np.zeros((2, 64, 64, 3), np.uint8))
    torch.testing.assert_close(pixels.patches, torch.full_like(pixels.patches, -1.0), rtol=0, atol=1e-6)


def test_a_row_of_fewer_images_has_no_mask_behind_its_last() -> None:
    collator = predictor_of("smol_mean_disc10").collator
    rows = [row for count in (1, 3) for row in collator.rows(ProgressSample(film(0, count, 64, 64)))]
    mask = collator.collate(rows).inputs["pixel_attention_mask"]
    assert mask.flatten(2).any(-1).sum(-1).tolist() == [1, 3]


@pytest.mark.parametrize(("name", "kind"), [("q3_tok_disc10", 1), ("q25_video_last_l2", 2)])
def test_tokens_of_images_and_videos_are_told_from_text(name: str, kind: int) -> None:
    collator = predictor_of(name).collator
    inputs = collator.collate(collator.rows(ProgressSample(film(0, 2, 64, 64)))).inputs
    pads = [collator.tokenizer.convert_tokens_to_ids(token) for token in ("<|image_pad|>", "<|video_pad|>")]
    is_pad = torch.isin(inputs["input_ids"], torch.tensor(pads))
    assert is_pad.any()
    assert inputs["mm_token_type_ids"].tolist() == torch.where(is_pad, kind, 0).tolist()
