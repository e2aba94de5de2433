# SPDX-License-Identifier: MIT
"""Pooling, image sizes and patches."""

from __future__ import annotations

import inspect
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image
from tokenizers.processors import TemplateProcessing
from transformers.models.qwen2_5_vl.configuration_qwen2_5_vl import Qwen2_5_VLVisionConfig

import goldens
from engines import TRANSFORMERS
from rfm.engine import Execution
from rfm.engine.pixels import Normalisation
from rfm.families.robometer.collator import VlmCollator
from rfm.qwen.backbone import embedded
from rfm.qwen.images import QwenImages, fitted_size
from rfm.qwen.network import QWEN_2_5
from rfm_client import PreferenceSample, ProgressSample
from vlm import PLAIN, predictor_of, upstream_inputs, video

SIZES = {
    "rounded": ((60, 90), (56, 84)),
    "at least four tokens": ((1, 1), (56, 56)),
    "at most 16384 tokens": ((4000, 5000), (3192, 4004)),
    "two hundred times as long as wide": ((28, 5600), (28, 5600)),
}


@pytest.mark.parametrize(("size", "expected"), SIZES.values(), ids=SIZES)
def test_images_are_fitted(size: tuple[int, int], expected: tuple[int, int]) -> None:
    assert fitted_size(*size, 28) == expected
    with pytest.raises(ValueError, match="at most 200 times as long as wide"):
        fitted_size(28, 5601, 28)


QWEN = [config.name for config in goldens.VLM]
HALVES = Normalisation((0.5,) * 3, (0.5,) * 3)


@pytest.mark.parametrize("name", [PLAIN, "q25_mean_l2", "q25_video_last_l2"])
def test_shots_of_one_size_are_one_call_of_attention(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    predictor = predictor_of(name)
    config = predictor.network.config.backbone
    rows = [row for seed in range(4) for row in predictor.rows(ProgressSample(video(seed, 6, 84, 112)))]
    batch = predictor.collate(rows).to(torch.device("cpu"), torch.float32)
    attention, calls = F.scaled_dot_product_attention, list[torch.Size]()

    def counted(query: torch.Tensor, *rest: Any, **more: Any) -> torch.Tensor:
        calls.append(query.shape)
        return attention(query, *rest, **more)

    monkeypatch.setattr(F, "scaled_dot_product_attention", counted)
    with torch.inference_mode():
        predictor.network(batch)
    sizes = 1 if batch.plan.windows is None else len(batch.plan.windows)
    text_layers = config["text_config"]["num_hidden_layers"]
    assert len(calls) <= config["vision_config"]["depth"] * sizes + text_layers


@pytest.mark.parametrize("name", QWEN)
def test_patches_are_embedded_without_a_convolution(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some versions of cuDNN compute the tower's Conv3d wrong in bfloat16; a matrix product is right."""
    predictor = predictor_of(name)
    batch = predictor.collate(predictor.rows(ProgressSample(video(0, 2, 84, 112)))).to(
        torch.device("cpu"), torch.float32
    )
    pixels = batch.inputs["pixel_values"]
    embed = predictor.network.model.visual.patch_embed
    expected = embed(pixels)
    np.testing.assert_allclose(embedded(embed.proj, pixels).numpy(), expected.numpy(), rtol=0, atol=1e-5)

    def refused(*arguments: Any, **more: Any) -> None:
        raise AssertionError("a convolution")

    monkeypatch.setattr(F, "conv3d", refused)
    monkeypatch.setattr(torch.nn.Conv3d, "forward", refused)
    predictor.score(predictor.rows(ProgressSample(video(0, 2, 84, 112))), batch, Execution())


# Worked out by hand from qwen-vl-utils' rules: longest side 480 px, multiples of 56 px, then multiples of 28 px within
# 128 to 768 tokens a frame, and 115,200 for all pairs of frames; at least 1.05 times 128 stay allowed.
VIDEO_SIZES = {
    "a short video keeps its size": (2, (448, 336), [], (448, 336)),
    "a long side is scaled down first": (2, (540, 960), [(270, 480), (280, 504)], (280, 504)),
    "a small one is enlarged": (2, (64, 64), [(112, 112)], (336, 336)),
    "1024 frames have 225 tokens, 15 times 15, each": (1024, (448, 448), [], (420, 420)),
    "1200 frames have 192 tokens each at most": (1200, (480, 480), [(504, 504)], (364, 364)),
    "2000 frames would have 115": (2000, (448, 336), [], (364, 280)),
}


@pytest.mark.parametrize(("count", "size", "by_pillow", "expected"), VIDEO_SIZES.values(), ids=VIDEO_SIZES)
def test_videos_are_fitted(
    count: int, size: tuple[int, int], by_pillow: list[tuple[int, int]], expected: tuple[int, int]
) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (1, *size, 3), np.uint8)
    image = Image.fromarray(frames[0])
    for height, width in by_pillow:
        image = image.resize((width, height), Image.Resampling.BICUBIC)
    wanted = torch.from_numpy(np.array(image)).movedim(-1, 0)[None].float()
    if wanted.shape[2:] != expected:
        wanted = F.interpolate(wanted, expected, mode="bicubic", antialias=True).clamp(0, 255).round()
    (made,) = QwenImages(14, HALVES).video_to_size(frames, count)
    np.testing.assert_array_equal(made, wanted[0].movedim(0, -1))


def test_black_stays_black_when_a_video_is_enlarged() -> None:
    images = QwenImages(14, HALVES)
    patches = images.patches(images.video_to_size(np.zeros((2, 64, 64, 3), np.uint8), 2), torch.tensor([[0, 1]]))
    torch.testing.assert_close(patches, torch.full_like(patches, -1.0), rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", QWEN)
def test_tokens_stand_where_transformers_puts_them(name: str) -> None:
    predictor = predictor_of(name)
    config = predictor.network.config
    if TRANSFORMERS >= 5 and config.family == QWEN_2_5 and not config.multi_image:
        pytest.skip("text behind a video stands elsewhere since transformers 5")
    samples = [
        ProgressSample(video(0, 5, 64, 64)),
        PreferenceSample(video(1, 3, 56, 140), video(2, 4, 130, 84)),
        ProgressSample(video(3, 4, 140, 56, "lift the red cup"), frame_steps=3),
    ]
    rows = [row for sample in samples for row in predictor.rows(sample)]
    inputs = upstream_inputs(predictor, rows)
    pads = [predictor.collator.tokenizer.convert_tokens_to_ids(pad) for pad in ("<|image_pad|>", "<|video_pad|>")]
    ids = inputs["input_ids"]
    inputs["mm_token_type_ids"] = (ids == pads[0]) + 2 * (ids == pads[1])
    if "video_grid_thw" in inputs:
        inputs["second_per_grid_ts"] = torch.ones(len(inputs["video_grid_thw"]))
    find = predictor.network.model.get_rope_index
    expected, _ = find(**{key: inputs[key] for key in inspect.signature(find).parameters if key in inputs})
    for index, row in enumerate(rows):
        np.testing.assert_array_equal(row.position_ids, expected[:, index, : row.num_tokens])


def test_a_configuration_without_the_tokens_of_a_second_has_those_of_transformers() -> None:
    collator = predictor_of("q25_video_last_l2").collator
    backbone = collator.config.backbone
    silent = {name: value for name, value in backbone["vision_config"].items() if name != "tokens_per_second"}
    usual = Qwen2_5_VLVisionConfig().tokens_per_second
    told, untold = (
        VlmCollator(
            replace(collator.config, backbone={**backbone, "vision_config": vision}),
            collator.tokenizer,
            collator.images,
        )
        for vision in (silent | {"tokens_per_second": usual}, silent)
    )
    sample = ProgressSample(video(0, 7, 64, 64))
    np.testing.assert_array_equal(untold.rows(sample)[0].position_ids, told.rows(sample)[0].position_ids)
    assert usual != backbone["vision_config"]["tokens_per_second"]


def test_a_tokenizer_adds_nothing_to_what_the_chat_template_says() -> None:
    """It writes all there is to be; the tokenizers of the references have nothing to add."""
    collator, sample = predictor_of(PLAIN).collator, ProgressSample(video(0, 2, 64, 64))
    (expected,) = collator.rows(sample)
    tokenizer = deepcopy(collator.tokenizer)
    end = tokenizer.eos_token
    tokenizer.backend_tokenizer.post_processor = TemplateProcessing(
        single=f"{end} $A {end}", special_tokens=[(end, tokenizer.eos_token_id)]
    )
    assert len(tokenizer(end)["input_ids"]) == 3
    (row,) = type(collator)(collator.config, tokenizer, collator.images).rows(sample)
    np.testing.assert_array_equal(row.input_ids, expected.input_ids)
