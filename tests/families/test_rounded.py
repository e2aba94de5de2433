# SPDX-License-Identifier: MIT
"""Weights of 8 and 4 bits: scores depend on the rounded values alone."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

import goldens
import rfm_export
from engines import load_engine, serve_config
from few_bits import LORA_INSIDE, TOLERANCES, change_config, in_both_forms
from few_bits import rounded as in_nf4
from reward_models import ROOT
from rfm import published
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm.published import CheckpointError
from rfm.published.nf4 import dequantize
from rfm.qwen.rounded import Int8Linear, Nf4Linear, RoundedLinear, fit, quantize, rounded
from rfm_client import ModelInfo, ProgressSample
from rfm_commands.engine_scorer import EngineScorer
from rfm_export.errors import ExportError
from rfm_export.pbtxt import parse
from vlm import PLAIN, assert_close, video

KINDS = {"int8": Int8Linear, "nf4": Nf4Linear}
SAMPLES = [
    ProgressSample(video(0, 3, 60, 84)),
    ProgressSample(video(1, 4, 84, 60)),
    ProgressSample(video(2, 2, 64, 64)),
]
ROBOREWARD = ROOT / "roboreward" / "rr_tied_bf16" / "checkpoint"
TOPREWARD = ROOT / "topreward" / "checkpoints" / "vlm_fp32_untied"


def sources(name: str) -> dict[str, Any]:
    if name in ("roboreward-expected", "topreward"):
        return {"source": ROBOREWARD if name.startswith("robo") else TOPREWARD, "reward_model": name}
    config = goldens.config(name)
    return {"source": config.checkpoint, **config.sources}


def network_of(engine: Engine) -> nn.Module:
    network: nn.Module = engine.predictor.network  # type: ignore[attr-defined]
    return network


def layers_of(engine: Engine) -> dict[str, RoundedLinear]:
    return {name: each for name, each in network_of(engine).named_modules() if isinstance(each, RoundedLinear)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind", "dtype"),
    [
        (PLAIN, "int8", torch.float32),
        (PLAIN, "nf4", torch.bfloat16),
        ("q25_mean_l2", "int8", torch.bfloat16),
        ("roboreward-expected", "nf4", torch.float32),
        ("topreward", "int8", torch.float32),
    ],
)
def test_a_rounded_network_scores_a_sample_alone_as_in_a_batch(name: str, kind: str, dtype: torch.dtype) -> None:
    engine = Engine.of(published.load(**sources(name), weights=kind), dtype=dtype)
    assert {type(layer) for layer in layers_of(engine).values()} == {KINDS[kind]}
    together = engine.evaluate(SAMPLES)
    for sample, expected in zip(SAMPLES, together, strict=True):
        (alone,) = engine.evaluate([sample])
        assert_close(alone, expected, 1e-5 if dtype is torch.float32 else 5e-3)
    full = Engine.of(published.load(**sources(name)), dtype=dtype).evaluate(SAMPLES)
    with pytest.raises(AssertionError):
        assert_close(full[0], together[0], 1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_layers_of_the_language_model_and_the_vision_tower_are_rounded_and_nothing_else(kind: str) -> None:
    engine, full = Engine.of(published.load(**sources(PLAIN), weights=kind)), load_engine(PLAIN)
    linear = {name for name, each in network_of(full).named_modules() if isinstance(each, nn.Linear)}
    inside = {name for name in linear if ".layers." in name or ".blocks." in name}
    assert layers_of(engine).keys() == inside
    assert any("visual" in name for name in inside)
    assert {name.split(".")[0] for name in linear - inside} == {
        "frame_pool_attn", "model", "preference_head", "progress_head", "success_head",
    }  # fmt: skip
    for name, parameter in network_of(engine).named_parameters():
        assert torch.equal(parameter, network_of(full).get_parameter(name))


def layer_with(weight: torch.Tensor, kind: Any, dtype: torch.dtype = torch.float32) -> RoundedLinear:
    network = nn.ModuleDict({"layer": nn.Linear(weight.shape[1], weight.shape[0], bias=False)})
    tensors = rounded("layer.weight", weight, kind, dtype)
    fit(network, tensors)
    network.load_state_dict(tensors, assign=True)
    layer = network["layer"]
    assert isinstance(layer, RoundedLinear)
    return layer


def test_int8_takes_the_nearest_of_255_steps_of_each_row() -> None:
    weight = torch.randn(5, 40, generator=torch.Generator().manual_seed(0)) * torch.logspace(-3, 1, 5)[:, None]
    weight[2] = 0
    layer = layer_with(weight, "int8")
    steps = weight.abs().amax(1, keepdim=True) / 127
    assert ((layer.values(torch.float32) - weight).abs() <= steps * 0.5001).all()
    assert torch.equal(layer.values(torch.float32)[2], weight[2])
    assert layer.values(torch.bfloat16).dtype is torch.bfloat16
    for_bfloat16 = layer_with(weight, "int8", torch.bfloat16).values(torch.float32)
    assert ((for_bfloat16 - weight).abs() <= steps * 1.01).all()  # the scale and the products are rounded, too


@pytest.mark.parametrize("shape", [(6, 128), (5, 100), (3, 34), (1, 2)])
def test_nf4_rounds_and_decodes_as_bitsandbytes(shape: tuple[int, int]) -> None:
    weight = torch.randn(shape, generator=torch.Generator().manual_seed(1)) * 0.02
    codes, scales = quantize(weight)
    from bitsandbytes import functional as bitsandbytes  # a GPU's tests run without it

    theirs, state = bitsandbytes.quantize_4bit(weight, blocksize=64, quant_type="nf4")
    assert torch.equal(codes.flatten(), theirs.flatten())
    assert torch.equal(scales, state.absmax)
    parts, values = in_nf4("layer.weight", weight)
    assert torch.equal(layer_with(weight, "nf4", torch.bfloat16).values(torch.bfloat16), values)
    assert dequantize(parts) == 1
    assert torch.equal(parts["layer.weight"], values)
    assert not quantize(torch.zeros(2, 32))[1].any()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [(PLAIN, "nf4"), (LORA_INSIDE, "int8"), ("q25_peft_adapter_disc10", "nf4")])
def test_an_export_holds_the_rounded_weights_and_says_how_far_scores_are(tmp_path: Path, kind: Any, name: str) -> None:
    config, said = goldens.config(name), list[str]()
    settings = ExportConfig(**{**vars(serve_config(config)), "weights": kind})
    rfm_export.export(config.checkpoint, tmp_path, settings, say=said.append)
    folder = tmp_path / "rfm_frames"
    exported, memory = (
        Engine.of(published.load(folder / "1" / "checkpoint")),
        published.load(**sources(name), weights=kind),
    )
    in_memory = Engine.of(memory).evaluate(SAMPLES)
    for result, expected in zip(exported.evaluate(SAMPLES), in_memory, strict=True):
        assert_close(result, expected, 1e-6)

    info = info_of(folder)
    assert info.weights == kind
    assert info.weights_difference is not None and 1e-5 < info.weights_difference < 0.5
    (line,) = [each for each in said if each.startswith(f"--weights {kind}: ")]
    told = f"progress differs by at most {info.weights_difference:.2g} from the full checkpoint's, on noise"
    assert line.endswith(told)
    assert info.network["parameters"] == numbers_of(load_engine(name))
    assert rfm_export.check(tmp_path, settings) == []
    (other,) = {*KINDS} - {kind}
    with pytest.raises(ExportError, match=rf"expected weights in {other}, got {kind}; leave out --weights"):
        rfm_export.check(tmp_path, replace(settings, weights=other))
    stored = load_file(folder / "1" / "checkpoint" / "model.safetensors")
    assert not any("lora" in key for key in stored)
    again = published.load(folder / "1" / "checkpoint", weights=kind)  # the same may be asked for again
    assert again.config.weights == kind


def test_an_export_of_an_export_keeps_the_difference_that_was_measured(tmp_path: Path) -> None:
    config, first, second = goldens.config(PLAIN), tmp_path / "first", tmp_path / "second"
    rfm_export.export(config.checkpoint, first, ExportConfig(**{**vars(serve_config(config)), "weights": "int8"}))
    rfm_export.export(first / "rfm_frames" / "1" / "checkpoint", second, serve_config(config))
    before, after = (info_of(folder / "rfm_frames") for folder in (first, second))
    assert before.weights_difference is not None
    assert (after.weights, after.weights_difference) == (before.weights, before.weights_difference)
    assert rfm_export.check(second, serve_config(config)) == []


def info_of(model: Path) -> ModelInfo:
    from google.protobuf.json_format import MessageToDict

    config = parse((model / "config.pbtxt").read_text())
    return ModelInfo.from_config(MessageToDict(config, preserving_proto_field_name=True))


def numbers_of(engine: Engine) -> Mapping[str, int]:
    numbers: dict[str, int] = {}
    for key, parameter in network_of(engine).named_parameters():
        part = key.partition(".")[0]
        numbers[part] = numbers.get(part, 0) + parameter.numel()
    return numbers


@pytest.mark.parametrize("name", TOLERANCES)
def test_a_checkpoint_in_nf4_keeps_its_codes_and_is_labelled(tmp_path: Path, name: str) -> None:
    few_bits, full = in_both_forms(name, tmp_path)
    options = goldens.config(name).sources
    checkpoint = published.load(few_bits, **options)
    engine = Engine.of(checkpoint)
    assert {type(layer) for layer in layers_of(engine).values()} == {Nf4Linear}
    assert checkpoint.config.weights == "nf4"
    weights = load_file(few_bits / "model.safetensors")
    for path, layer in layers_of(engine).items():
        kept = [key for key in weights if key.endswith(".weight") and _is_of(key, path)]
        assert torch.equal(layer.weight.flatten(), weights[kept[0]].flatten())
    dense = Engine.of(published.load(full, **options))
    for result, expected in zip(engine.evaluate(SAMPLES), dense.evaluate(SAMPLES), strict=True):
        assert_close(result, expected, TOLERANCES[name])

    said: list[str] = []
    rfm_export.export(few_bits, tmp_path / "models", serve_config(goldens.config(name)), say=said.append)
    assert sum("in NF4 of bitsandbytes (weights, rounded in training too)" in line for line in said) == 1
    exported = tmp_path / "models" / "rfm_frames" / "1" / "checkpoint"
    assert "quantization_config" not in json.loads((exported / "config.json").read_text())
    for result, expected in zip(
        Engine.of(published.load(exported)).evaluate(SAMPLES), dense.evaluate(SAMPLES), strict=True
    ):
        assert_close(result, expected, TOLERANCES[name])
    info = info_of(tmp_path / "models" / "rfm_frames")
    assert (info.weights, info.weights_difference) == ("nf4", None)  # the weights before rounding are unknown


def _is_of(key: str, path: str) -> bool:
    return (
        key.replace("base_model.model.", "")
        .replace(".base_layer", "")
        .endswith(f"{path.partition('model.')[2]}.weight")
    )


def test_an_ordinary_qwen_in_nf4_is_read(tmp_path: Path) -> None:
    folder = tmp_path / "Qwen3-VL-bnb-4bit"
    folder.mkdir()
    for file in ROBOREWARD.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    few_bits = {}
    for key, tensor in load_file(folder / "model.safetensors").items():
        is_linear = key.endswith(".weight") and (".layers." in key or ".blocks." in key) and tensor.ndim == 2
        few_bits |= in_nf4(key, tensor)[0] if is_linear else {key: tensor}
    save_file(few_bits, folder / "model.safetensors", {"format": "pt"})
    change_config(folder, "nf4")
    as_published = published.load(folder, reward_model="roboreward-expected")
    rounded_here = published.load(ROBOREWARD, reward_model="roboreward-expected", weights="nf4")
    assert as_published.config.weights == "nf4"
    scores = [Engine.of(each).evaluate(SAMPLES) for each in (as_published, rounded_here)]
    for result, expected in zip(*scores, strict=True):
        assert_close(result, expected, 1e-6)


def test_weights_that_are_rounded_are_not_rounded_in_another_way(tmp_path: Path) -> None:
    few_bits, _ = in_both_forms(PLAIN, tmp_path)
    options = goldens.config(PLAIN).sources
    expected = "^--weights: expected a vision-language checkpoint whose weights are not rounded .*; leave it out"
    with pytest.raises(CheckpointError, match=expected):
        published.load(few_bits, weights="int8", **options)
    assert published.load(few_bits, weights="nf4", **options).config.weights == "nf4"
    rewind = goldens.config("c1_t1_disc10")
    with pytest.raises(CheckpointError, match=expected):
        published.load(rewind.checkpoint, weights="int8", **rewind.sources)


def test_a_missing_bitsandbytes_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bitsandbytes", None)
    expected = r'^weights: expected bitsandbytes, which decodes .* got none; pip install "\.\[quantized\]"$'
    with pytest.raises(CheckpointError, match=expected):
        published.load(**sources(PLAIN), weights="nf4")
    Engine.of(published.load(**sources(PLAIN), weights="int8"))  # which PyTorch decodes


@pytest.mark.parametrize("part", ["weight", "scale"])
@pytest.mark.parametrize("kind", KINDS)
def test_tensors_of_other_shapes_are_refused(tmp_path: Path, kind: Any, part: str) -> None:
    published.load(**sources(PLAIN), weights=kind).save(tmp_path / "saved")
    tensors = load_file(tmp_path / "saved" / "model.safetensors")
    name = f"model.language_model.layers.0.mlp.up_proj.{part}"
    tensors[name] = tensors[name][:-1].clone()
    save_file(tensors, tmp_path / "saved" / "model.safetensors", {"format": "pt"})
    with pytest.raises(CheckpointError, match=r"layers\.0\.mlp\.up_proj\.(weight|scale): expected \[.*\], got \["):
        published.load(tmp_path / "saved")


@pytest.mark.parametrize("kind", KINDS)
def test_labels_tell_rounded_weights(kind: str) -> None:
    source, *options = sources(PLAIN).items()
    full, few_bits = (EngineScorer(str(source[1]), **dict(options), **given) for given in ({}, {"weights": kind}))
    assert "weights" not in full.checkpoint().document()
    assert few_bits.checkpoint().document()["weights"] == kind
    assert few_bits.checkpoint().settings_digest != full.checkpoint().settings_digest
