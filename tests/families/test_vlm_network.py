# SPDX-License-Identifier: MIT
"""Pooling, image sizes and patches."""

from __future__ import annotations

import inspect
import warnings
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from tokenizers.processors import TemplateProcessing
from torch.utils._python_dispatch import TorchDispatchMode
from transformers.models.qwen2_5_vl.configuration_qwen2_5_vl import Qwen2_5_VLVisionConfig

import goldens
from engines import TRANSFORMERS, load_engine
from rfm.engine import Engine
from rfm.engine.execution import Execution
from rfm.vlm.backbone import QWEN_2_5
from rfm.vlm.collator import QwenCollator
from rfm.vlm.film import VlmFilm
from rfm.vlm.images import Normalisation, QwenImages, fitted_size
from rfm_client import PreferenceSample, ProgressSample, Sample
from vlm import BFLOAT16, PLAIN, assert_close, film, predictor_of, upstream_inputs


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
        together = network._frame_states(hidden, spans, long + 2 * short)
    assert largest.elements <= (long + 2 * short) * width
    with torch.inference_mode():
        for index in (0, 1, short):
            one = spans[index : index + 1]
            alone = network._frame_states(hidden, one, int(one[0, 2] - one[0, 1]))
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
    patches = images.patches(images.images_to_size(frame), None)
    assert patches.shape == (16, 3 * 2 * 2 * 2)
    first = patches[0].reshape(3, 2, 2, 2)  # C, frame of the group, rows, columns
    np.testing.assert_allclose(first[:, 0].permute(1, 2, 0).numpy(), frame[0, :2, :2], atol=1e-4)
    assert sorted(patches.round().int().flatten().tolist()) == sorted(frame.flatten().tolist() * 2)


QWEN = [config.name for config in goldens.VLM if not config.name.startswith("smol")]


@pytest.mark.parametrize("name", QWEN)
def test_shots_of_one_size_are_one_call_of_attention(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    predictor = predictor_of(name)
    config = predictor.network.config.backbone
    rows = [row for seed in range(4) for row in predictor.rows(ProgressSample(film(seed, 6, 84, 112)))]
    batch = predictor.collate(rows).to(torch.device("cpu"), torch.float32)
    attention, calls = F.scaled_dot_product_attention, list[torch.Size]()

    def counted(query: torch.Tensor, *rest: Any, **more: Any) -> torch.Tensor:
        calls.append(query.shape)
        return attention(query, *rest, **more)

    monkeypatch.setattr(F, "scaled_dot_product_attention", counted)
    with torch.inference_mode():
        predictor.network(batch)
    depth = config["vision_config"]["depth"]
    sizes = 1 if batch.plan.windows is None else len(batch.plan.windows)
    assert len(calls) <= depth * sizes + config["text_config"]["num_hidden_layers"]


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


@pytest.mark.gpu
@pytest.mark.parametrize("name", [PLAIN, "q25_video_last_l2", "smol_mean_disc10"])
def test_a_gpu_gives_the_cpu_s_numbers_in_float32(name: str) -> None:
    config = goldens.config(name)
    samples: list[Sample] = [ProgressSample(film(seed, 5, 84, 112)) for seed in range(3)]
    samples += [PreferenceSample(film(4, 2, 64, 96), film(5, 3, 64, 64)), ProgressSample(film(6, 4, 60, 60), 3)]
    on_cpu = load_engine(name).evaluate(samples)
    engine = Engine.from_checkpoint(
        config.checkpoint, base_model=str(config.base_model), device="cuda", dtype=torch.float32
    )
    for left, right in zip(on_cpu, engine.evaluate(samples), strict=True):
        assert_close(left, right, 1e-5)


@pytest.mark.gpu
def test_the_host_waits_for_a_gpu_once_a_batch() -> None:
    """PyTorch itself tells of each time that the host waits; to read the scores, it must."""
    config = goldens.config(BFLOAT16)
    engine = Engine.from_checkpoint(config.checkpoint, base_model=str(config.base_model), device="cuda")
    samples: list[Sample] = [ProgressSample(film(seed, 5, 84, 112)) for seed in range(3)]
    engine.evaluate(samples)
    prepared = [engine.prepare(sample) for sample in samples]
    for each in prepared:
        engine.work_ahead(each)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        engine.score(prepared, Execution())
        torch.cuda.set_sync_debug_mode("default")
    assert len([each for each in caught if "synchronizing CUDA operation" in str(each.message)]) == 1


# Worked out by hand from qwen-vl-utils' rules: longest side 480 px, multiples of 56 px, then multiples of 28 px within
# 128 to 768 tokens a frame, of which all pairs of frames together have 115,200; at least 1.05 times 128 stay allowed.
VIDEO_SIZES = {
    "a short film keeps its size": (2, (448, 336), [(448, 336)]),
    "a long side is scaled down first": (2, (540, 960), [(270, 480), (280, 504)]),
    "a small one is enlarged": (2, (64, 64), [(112, 112), (336, 336)]),
    "1024 frames have 225 tokens, 15 times 15, each": (1024, (448, 448), [(448, 448), (420, 420)]),
    "1200 frames have 192 tokens each at most": (1200, (480, 480), [(504, 504), (364, 364)]),
    "2000 frames would have 115": (2000, (448, 336), [(448, 336), (364, 280)]),
}


@pytest.mark.parametrize(("count", "size", "expected"), VIDEO_SIZES.values(), ids=VIDEO_SIZES)
def test_videos_are_fitted(count: int, size: tuple[int, int], expected: list[tuple[int, int]]) -> None:
    sizes = QwenImages(14, Normalisation((0.5,) * 3, (0.5,) * 3))._video_sizes(*size, count)
    assert list(dict.fromkeys(sizes)) == expected


def test_an_image_may_be_two_hundred_times_as_long_as_wide() -> None:
    assert fitted_size(28, 5600, 28) == (28, 5600)
    with pytest.raises(ValueError, match="at most 200 times as long as wide"):
        fitted_size(28, 5601, 28)


def test_black_stays_black_when_a_video_is_enlarged() -> None:
    images = QwenImages(14, Normalisation((0.5,) * 3, (0.5,) * 3))
    patches = images.patches(images.video_to_size(np.zeros((2, 64, 64, 3), np.uint8), 2), torch.tensor([[0, 1]]))
    torch.testing.assert_close(patches, torch.full_like(patches, -1.0), rtol=0, atol=1e-6)


def test_a_row_of_fewer_images_has_no_mask_behind_its_last() -> None:
    predictor = predictor_of("smol_mean_disc10")
    rows = [row for count in (1, 3) for row in predictor.rows(ProgressSample(film(0, count, 64, 64)))]
    mask = upstream_inputs(predictor, rows)["pixel_attention_mask"]
    assert mask.flatten(2).any(-1).sum(-1).tolist() == [1, 3]


@pytest.mark.parametrize("name", QWEN)
def test_tokens_stand_where_transformers_puts_them(name: str) -> None:
    predictor = predictor_of(name)
    config = predictor.network.config
    if TRANSFORMERS >= 5 and config.family == QWEN_2_5 and not config.multi_image:
        pytest.skip("text behind a video stands elsewhere since transformers 5")
    samples = [
        ProgressSample(film(0, 5, 64, 64)),
        PreferenceSample(film(1, 3, 56, 140), film(2, 4, 130, 84)),
        ProgressSample(film(3, 4, 140, 56, "lift the red cup"), frame_steps=3),
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
        QwenCollator(
            replace(collator.config, backbone={**backbone, "vision_config": vision}),
            collator.tokenizer,
            collator.images,
        )
        for vision in (silent | {"tokens_per_second": usual}, silent)
    )
    sample = ProgressSample(film(0, 7, 64, 64))
    np.testing.assert_array_equal(untold.rows(sample)[0].position_ids, told.rows(sample)[0].position_ids)
    assert usual != backbone["vision_config"]["tokens_per_second"]


@pytest.mark.parametrize("name", [PLAIN, "smol_mean_disc10"])
def test_a_tokenizer_adds_nothing_to_what_the_chat_template_says(name: str) -> None:
    """It writes all there is to be; the tokenizers of the references have nothing to add."""
    collator, sample = predictor_of(name).collator, ProgressSample(film(0, 2, 64, 64))
    (expected,) = collator.rows(sample)
    tokenizer = deepcopy(collator.tokenizer)
    end = tokenizer.eos_token
    tokenizer.backend_tokenizer.post_processor = TemplateProcessing(
        single=f"{end} $A {end}", special_tokens=[(end, tokenizer.eos_token_id)]
    )
    assert len(tokenizer(end)["input_ids"]) == 3
    (row,) = type(collator)(collator.config, tokenizer, collator.images).rows(sample)
    np.testing.assert_array_equal(row.input_ids, expected.input_ids)


@pytest.mark.parametrize("make", [np.asarray, list], ids=["an array", "named frames"])
@pytest.mark.parametrize("needed", [[], [1], [0, 2], [0, 1, 2]])
def test_a_film_gives_the_frames_that_are_needed(make: Any, needed: list[int]) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (3, 6, 4, 3), np.uint8)
    given = VlmFilm.of(make(frames), 0).stack(needed)
    assert given.dtype == np.uint8
    np.testing.assert_array_equal(given, frames[np.array(needed, int)])


def test_a_shot_that_many_conversations_show_is_there_once() -> None:
    predictor = predictor_of(BFLOAT16)
    rows = predictor.rows(ProgressSample(film(0, 6, 64, 64), frame_steps=4))
    batch = predictor.collate(rows)
    grid = predictor.collator.grid(rows[0].films[0])
    assert batch.plan.shots == ((6, grid.rows * grid.columns),)
    assert batch.inputs["visual_features"].shape == (6 * 4 * grid.tokens_per_group,)


def test_frames_that_have_the_size_are_not_copied() -> None:
    predictor = predictor_of(BFLOAT16)
    (row,) = predictor.rows(ProgressSample(film(0, 2, 96, 64)))
    predictor.work_ahead([row])
    assert row.films[0].ready.pixels.data_ptr() == row.frames[0].ctypes.data
