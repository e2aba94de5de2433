# SPDX-License-Identifier: MIT
"""RFM and Robometer: scores against the original's, alone and in any company; sizes, patches and positions."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import partial
from itertools import groupby
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image
from tokenizers.processors import TemplateProcessing
from transformers.models.qwen2_5_vl.configuration_qwen2_5_vl import Qwen2_5_VLVisionConfig

import goldens
from engines import TRANSFORMERS, load_engine
from rfm import published
from rfm.engine import Engine, Execution
from rfm.engine.layers import Normalisation, progress_from_logits
from rfm.families.robometer.checkpoint import VlmPredictor
from rfm.families.robometer.prompts import VlmCollator
from rfm.qwen.backbone import embedded
from rfm.qwen.collator import Chat, QwenCollator
from rfm.qwen.images import QwenImages, fitted_size
from rfm.qwen.language import LanguageCollator
from rfm.qwen.network import QWEN_2_5
from rfm_client import (
    PreferenceResult,
    PreferenceSample,
    ProgressResult,
    ProgressSample,
    Sample,
    SimilaritySample,
    Trajectory,
)
from tolerances import TOLERANCE
from vlm import BFLOAT16, PLAIN, assert_close, load, predictor_of, upstream_inputs, video

PIXEL_TOLERANCE = 1e-6  # relative, of a sum over all pixels


ON_VIDEOS = f"{PLAIN} on videos"
MIXED_TOLERANCE = 5e-6  # seen: 1e-6


BATCHED = [case for case in goldens.VLM_CASES if not case.is_refused and case.content["kind"] != "ragg"]


@pytest.mark.reference
@pytest.mark.parametrize("case", BATCHED, ids=str)
def test_token_ids_and_pixels_are_those_of_the_original(case: goldens.Case) -> None:
    predictor, arrays = predictor_of(case.config.name), case.arrays
    for kind, samples in groupby(sorted(case.samples(), key=goldens.sample_type), goldens.sample_type):
        if f"{kind}.collated.input_ids" not in arrays:  # evaluated one by one
            continue
        inputs = upstream_inputs(predictor, [row for sample in samples for row in predictor.collator.rows(sample)])
        for name in ("input_ids", "attention_mask", "image_grid_thw", "video_grid_thw"):
            if f"{kind}.collated.{name}" in arrays:
                np.testing.assert_array_equal(inputs[name].numpy(), arrays[f"{kind}.collated.{name}"])
        pixels = case.content["pixels"][kind]
        made = inputs[pixels["key"]].double()
        if f"{kind}.collated.{pixels['key']}" in arrays:
            whole = arrays[f"{kind}.collated.{pixels['key']}"]
            np.testing.assert_allclose(made.numpy(), whole, rtol=0, atol=1e-6)
        assert list(made.shape) == pixels["shape"]
        assert abs(float(made.sum()) - pixels["sum"]) <= PIXEL_TOLERANCE * pixels["abs_sum"]
        assert abs(float(made.abs().sum()) - pixels["abs_sum"]) <= PIXEL_TOLERANCE * pixels["abs_sum"]


@pytest.mark.reference
@pytest.mark.parametrize("case", goldens.VLM_CASES, ids=str)
def test_the_engine_gives_every_reference_answer(case: goldens.Case) -> None:
    outcomes = load_engine(case.config.name).evaluate(case.samples())
    results = [outcome for outcome in outcomes if not isinstance(outcome, Exception)]
    for result, expected in zip(results, case.expected(), strict=True):
        goldens.check(result, expected, case.tolerances)
    case.check_response(results)


BFLOAT16_CASES = goldens.config(BFLOAT16).cases()


def engine_in_bfloat16() -> tuple[Engine, VlmPredictor]:
    config = goldens.config(BFLOAT16)
    engine = Engine.of(published.load(config.checkpoint, **config.sources), dtype=torch.bfloat16)
    assert isinstance(engine.predictor, VlmPredictor)
    return engine, engine.predictor


def round_frequencies(network: torch.nn.Module) -> None:
    """The fault of casting a whole network: the rotary frequencies are rounded with it."""
    buffers = [(m, name) for m in network.modules() for name, _ in m.named_buffers(recurse=False) if name == "inv_freq"]
    for module, name in buffers:
        module.register_buffer(name, getattr(module, name).to(torch.bfloat16), persistent=False)
    assert len(buffers) == 2  # of images and of text


def excesses(engine: Engine, case: goldens.Case, *, bfloat16: bool, tolerances: tuple[float, float]) -> list[float]:
    """Return each sample's largest difference divided by the tolerance."""
    results = [outcome for outcome in engine.evaluate(case.samples()) if not isinstance(outcome, Exception)]
    pairs = zip(results, case.expected(bfloat16=bfloat16), strict=True)
    each = (goldens.differences(result, expected) for result, expected in pairs)
    return [max(raw / tolerances[0], probability / tolerances[1]) for raw, probability in each]


@pytest.mark.reference
@pytest.mark.parametrize("case", BFLOAT16_CASES, ids=str)
def test_bfloat16_is_the_original_s_bfloat16(case: goldens.Case) -> None:
    engine, predictor = engine_in_bfloat16()
    assert max(excesses(engine, case, bfloat16=True, tolerances=goldens.BFLOAT16_TOLERANCES)) <= 1
    round_frequencies(predictor.network)
    if goldens.AS_REFERENCES:  # elsewhere the rounding of sums moves scores as far as that fault does: see below
        assert max(excesses(engine, case, bfloat16=True, tolerances=goldens.BFLOAT16_TOLERANCES)) > 1


@pytest.mark.reference
@pytest.mark.parametrize("case", [case for case in BFLOAT16_CASES if case.has_float32], ids=str)
def test_a_network_in_bfloat16_holds_the_original_s_numbers(case: goldens.Case) -> None:
    """In float32, where CPU rounding is a thousand times smaller than a rounded frequency's effect."""
    _, predictor = engine_in_bfloat16()
    engine = Engine(VlmPredictor(predictor.network.float(), predictor.collator, torch.device("cpu")))
    assert max(excesses(engine, case, bfloat16=False, tolerances=case.tolerances)) <= 1
    round_frequencies(predictor.network)
    assert min(excesses(engine, case, bfloat16=False, tolerances=case.tolerances)) > 10


def mixture(step: int = 1) -> list[Sample]:
    """T = 2, 8, 16; three image sizes, in some pairs two; all three types. step: 2 for half of them"""
    samples: list[Sample] = []
    sizes = [(count, *size) for count in (2, 8, 16) for size in ((56, 56), (64, 100), (90, 61))]
    for seed, (num_frames, height, width) in enumerate(sizes):
        samples.append(ProgressSample(video(seed, num_frames, height, width, f"task {seed}")))
        samples.append(PreferenceSample(video(seed, num_frames, height, width), video(seed + 50, 3, height, width)))
        samples.append(SimilaritySample(video(seed, 1, height, width), video(seed + 90, num_frames, height, width)))
        samples.append(PreferenceSample(video(seed, num_frames, height, width), video(seed + 70, 3, 84, 112)))
        samples.append(SimilaritySample(video(seed, 1, 60, 60), video(seed + 80, num_frames, height, width)))
    return samples[::step]


@pytest.mark.parametrize(
    ("name", "token_budget", "step"),
    [
        ("q25_peft_adapter_disc10", 4096, 1),
        ("q25_attention_disc10", 65_536, 2),
        ("q25_video_last_l2", 65_536, 2),
    ],
)
def test_a_mixture_equals_its_samples_alone(name: str, token_budget: int, step: int) -> None:
    engine = Engine(load_engine(name).predictor, token_budget=token_budget)
    lacks = load(name).description.lacks
    samples = [sample for sample in mixture(step) if goldens.sample_type(sample) not in lacks]
    order = np.random.default_rng(0).permutation(len(samples))
    together = engine.evaluate([samples[index] for index in order])
    for index, outcome in zip(order, together, strict=True):
        assert_close(outcome, engine.evaluate([samples[index]])[0], MIXED_TOLERANCE)


def changed(name: str, **settings: Any) -> VlmPredictor:
    """A checkpoint as if it had been trained with other settings."""
    checkpoint = load(name)
    return replace(checkpoint, config=replace(checkpoint.config, **settings)).predictor(torch.device("cpu"))


TWO_SIZES: dict[str, Callable[[], VlmPredictor]] = {
    **{config.name: partial(predictor_of, config.name) for config in goldens.VLM if not config.is_bfloat16},
    ON_VIDEOS: lambda: changed(PLAIN, multi_image=False, per_frame_progress_token=False),
    "attention of one token": lambda: changed("q25_attention_disc10", pooling_temperature=1e-5),
}


def pooled(network: Any, states: torch.Tensor) -> torch.Tensor:
    """Return [D] from the states [N, D] of a frame's tokens."""
    if not network.config.pools_by_attention:
        return states.mean(dim=0)
    weights = (network.frame_pool_attn(states) / network.config.pooling_temperature).softmax(dim=0)
    return (weights * states).sum(dim=0)


@pytest.mark.parametrize("make", TWO_SIZES.values(), ids=TWO_SIZES)
def test_a_pair_of_two_frame_sizes_is_scored_as_transformers_reads_it(
    make: Callable[[], VlmPredictor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run the backbone's forward with each image or video as upstream does; then the heads.

    Our matrix product embeds the patches, because the convolution sums in another order.
    """
    predictor = make()
    embed = predictor.network.model.visual.patch_embed
    monkeypatch.setattr(embed, "forward", partial(embedded, embed.proj))
    network, sample = predictor.network, PreferenceSample(video(0, 3, 56, 140), video(1, 4, 130, 84))
    if TRANSFORMERS >= 5 and network.config.family == QWEN_2_5 and not network.config.multi_image:
        pytest.skip("text behind a video stands elsewhere since transformers 5")
    (row,) = predictor.rows(sample)
    inputs = upstream_inputs(predictor, [row])
    if network.config.family == QWEN_2_5 and "video_grid_thw" in inputs:
        inputs["second_per_grid_ts"] = torch.ones(2)
    (outcome,) = Engine(predictor).evaluate([sample])
    assert isinstance(outcome, PreferenceResult)
    assert row.query is not None
    # Newer kernels sum in another order. In float32 this network itself is up to 1.13e-6 from its float64 form.
    atol = 1e-6 if TRANSFORMERS < 5 else TOLERANCE
    with torch.inference_mode():
        hidden = network.model(**inputs, use_cache=False).last_hidden_state[0]
        assert outcome.preference == pytest.approx(
            network.preference_head(hidden[row.query]).sigmoid().item(), abs=atol
        )
        for scores, spans in zip((outcome.first, outcome.second), row.spans, strict=True):
            states = torch.stack([pooled(network, hidden[start:stop]) for start, stop in spans])
            places = np.arange(len(scores.progress)) // (1 if network.config.multi_image else 2)
            progress = progress_from_logits(network.progress_head(states))[places]
            np.testing.assert_allclose(scores.progress, progress, rtol=0, atol=atol)
            success = network.success_head(states).squeeze(-1).sigmoid()[places]
            np.testing.assert_allclose(scores.success, success, rtol=0, atol=atol)


def test_the_task_is_not_a_template() -> None:
    tokens = predictor_of(PLAIN).collator
    (row,) = tokens.rows(ProgressSample(video(0, 1, 56, 56, "put {task} there")))
    assert "'put {task} there'" in tokens.tokenizer.decode(row.input_ids)


ASKED_AGAIN = {name: TWO_SIZES[name] for name in (PLAIN, "q25_video_last_l2", ON_VIDEOS)}


@pytest.mark.parametrize("make", ASKED_AGAIN.values(), ids=ASKED_AGAIN)
def test_a_question_is_read_as_if_no_other_had_been_asked_before(make: Callable[[], VlmPredictor]) -> None:
    """Questions differ in one property: task, number of frames, size, dense mode, type, or order."""
    one, other = video(0, 4, 56, 56), video(1, 3, 56, 84)
    questions: list[Sample] = [
        ProgressSample(one),
        ProgressSample(video(0, 4, 56, 56, "stack the block")),
        ProgressSample(video(0, 6, 56, 56)),
        ProgressSample(video(0, 4, 84, 56)),
        ProgressSample(one, frame_steps=2),
        PreferenceSample(one, other),
        PreferenceSample(other, one),
        ProgressSample(video(0, 4, 56, 56, "image")),
    ]
    many = make().collator
    for question in questions * 2:
        fresh = type(many)(many.config, many.tokenizer, many.images)  # has kept nothing
        (alone, *_), (among, *_) = fresh.rows(question), many.rows(question)
        np.testing.assert_array_equal(among.input_ids, alone.input_ids)
        np.testing.assert_array_equal(among.position_ids, alone.position_ids)
        assert (among.spans, among.query) == (alone.spans, alone.query)


READ_AS_IMAGES = [config for config in goldens.VLM if config.frames_per_value == 1]


@pytest.mark.parametrize("config", READ_AS_IMAGES, ids=lambda config: config.name)
def test_a_network_that_reads_images_is_causal(config: goldens.Config) -> None:
    """So callers need not score each prefix of a trajectory that is read as images."""
    trajectory = video(0, 5, 56, 56)
    prefix = replace(trajectory, frames=trajectory.positions[:3])
    whole, part = load_engine(config.name).evaluate([ProgressSample(trajectory), ProgressSample(prefix)])
    assert isinstance(whole, ProgressResult)
    assert isinstance(part, ProgressResult)
    assert np.abs(whole.progress[:3] - part.progress).max() <= MIXED_TOLERANCE
    assert load(config.name).description.frames_per_value == 1


@pytest.mark.parametrize("name", ["q3_tok_disc10", "q25_video_avg_disc10"])
def test_dense_mode_encodes_each_shot_once(name: str) -> None:
    """A shot of a video is a pair of frames. 5 frames, 4 at a time, make the pairs below."""
    frames = np.random.default_rng(0).integers(0, 256, (5, 56, 84, 3), np.uint8)
    engine, execution = load_engine(name), Execution()
    (result,) = engine.evaluate([ProgressSample(Trajectory(frames=frames, task="stack"), frame_steps=4)], execution)
    assert isinstance(result, ProgressResult)
    shown = [np.linspace(0, t, 4).astype(int) for t in range(5)]
    pairs = {tuple(pair) for picked in shown for pair in picked.reshape(-1, 2).tolist()}
    assert execution.num_encoded == (5 if name.startswith("q3") else 2 * len(pairs))


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


def test_a_tokenizer_adds_no_special_tokens_to_the_chat_template_s_text() -> None:
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


@pytest.mark.parametrize(("collator", "count"), [(VlmCollator, 600), (LanguageCollator, 300)])
def test_few_texts_are_cached_whole_and_many_in_pieces(collator: type[QwenCollator], count: int) -> None:
    """The tokens of a conversation of 128 frames take a hundred kilobytes, those of a piece hardly any."""
    tokenizer = mock.Mock(return_value={"input_ids": [1]})
    chat = Chat(tokenizer, collator.kept_tokens)
    for task in [*range(300), *range(300)]:
        chat.tokens(f"task {task}")
    assert tokenizer.call_count == count
