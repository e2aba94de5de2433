# SPDX-License-Identifier: MIT
"""Weights of 8 and 4 bits: scores depend on the rounded values alone, which bitsandbytes' NF4 gives unchanged."""

from __future__ import annotations

import gc
import json
import shutil
import sys
import weakref
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn.functional import pad

import goldens
import rfm_export
from engines import load_engine, serve_config
from few_bits import LORA_INSIDE, TOLERANCES, as_bytes, case, change_config, in_both_forms
from few_bits import rounded as in_nf4
from reward_models import ROOT
from rfm import published
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm.published import CheckpointError, rounding
from rfm.published.rounding import dequantize
from rfm.qwen.rounded import NF4_CODES, Int8Linear, Nf4Linear, RoundedLinear, fit, rounded
from rfm_client import ModelInfo, ProgressSample
from rfm_commands.engine_scorer import EngineScorer
from rfm_export.errors import ExportError
from rfm_export.pbtxt import parse
from vlm import PLAIN, assert_close, load, video

KINDS = {"int8": Int8Linear, "nf4": Nf4Linear}
SAMPLES = [
    ProgressSample(video(0, 3, 60, 84)),
    ProgressSample(video(1, 4, 84, 60)),
    ProgressSample(video(2, 2, 64, 64)),
]
RYNNVALUE = ROOT / "rynnvalue" / "linear_2heads_nometa_fp32" / "checkpoint"
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
def test_nf4_rounds_to_the_nearest_code_and_decodes_as_bitsandbytes(shape: tuple[int, int]) -> None:
    weight = torch.randn(shape, generator=torch.Generator().manual_seed(1)) * 0.02
    own = rounded("layer.weight", weight, "nf4", torch.float32)
    blocks = pad(weight.flatten(), (0, -weight.numel() % 64)).view(-1, 64)
    assert torch.equal(own["layer.scale"], blocks.abs().amax(1))
    nearest = (blocks[..., None] / own["layer.scale"][:, None, None] - torch.tensor(NF4_CODES)).abs().argmin(-1)
    nearest = nearest.flatten()[: weight.numel()]
    assert torch.equal(own["layer.weight"].flatten(), (nearest[0::2] << 4 | nearest[1::2]).to(torch.uint8))
    parts, values = in_nf4("layer.weight", weight)
    assert torch.equal(layer_with(weight, "nf4", torch.bfloat16).values(torch.bfloat16), values)
    assert dequantize(parts) == 1
    assert torch.equal(parts["layer.weight"], values)
    assert not rounded("layer.weight", torch.zeros(2, 32), "nf4", torch.float32)["layer.scale"].any()


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
    second = replace(serve_config(config), base_model=None)
    rfm_export.export(folder / "1" / "checkpoint", tmp_path / "second", second)
    exported_again = info_of(tmp_path / "second" / "rfm_frames")
    assert (exported_again.weights, exported_again.weights_difference) == (kind, info.weights_difference)
    assert rfm_export.check(tmp_path / "second", second) == []


def info_of(model: Path) -> ModelInfo:
    from google.protobuf.json_format import MessageToDict

    config = parse((model / "config.pbtxt").read_text())
    return ModelInfo.from_config(MessageToDict(config, preserving_proto_field_name=True), ["1"])


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


def with_layers_in_nf4(source: Path, folder: Path) -> Path:
    """A copy of the checkpoint with its layers in NF4, as bitsandbytes saves them."""
    shutil.copytree(source, folder, copy_function=shutil.copyfile)
    few_bits = {}
    for key, tensor in load_file(folder / "model.safetensors").items():
        is_linear = key.endswith(".weight") and (".layers." in key or ".blocks." in key) and tensor.ndim == 2
        few_bits |= in_nf4(key, tensor)[0] if is_linear else {key: tensor}
    save_file(few_bits, folder / "model.safetensors", {"format": "pt"})
    change_config(folder, "nf4")
    return folder


def test_an_ordinary_qwen_in_nf4_is_read(tmp_path: Path) -> None:
    as_published = published.load(with_layers_in_nf4(ROBOREWARD, tmp_path / "4bit"), reward_model="roboreward-expected")
    rounded_here = published.load(ROBOREWARD, reward_model="roboreward-expected", weights="nf4")
    assert as_published.config.weights == "nf4"
    scores = [Engine.of(each).evaluate(SAMPLES) for each in (as_published, rounded_here)]
    for result, expected in zip(*scores, strict=True):
        assert_close(result, expected, 1e-6)


def test_a_rynnvalue_in_nf4_is_not_rounded_again(tmp_path: Path) -> None:
    folder = with_layers_in_nf4(RYNNVALUE, tmp_path / "4bit")
    assert published.load(folder).config.weights == "nf4"
    with pytest.raises(CheckpointError, match=r"^--weights: expected .* whose weights are not rounded"):
        published.load(folder, weights="int8")


def test_weights_that_are_rounded_are_not_rounded_in_another_way(tmp_path: Path) -> None:
    few_bits, _ = in_both_forms(PLAIN, tmp_path)
    options = goldens.config(PLAIN).sources
    expected = "^--weights: expected a vision-language checkpoint whose weights are not rounded .*; leave it out"
    with pytest.raises(CheckpointError, match=expected):
        published.load(few_bits, weights="int8", **options)
    assert published.load(few_bits, weights="nf4", **options).config.weights == "nf4"


def test_a_missing_bitsandbytes_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bitsandbytes", None)
    expected = r'^weights: expected bitsandbytes, which decodes .* got none; pip install "\.\[quantized\]"$'
    with pytest.raises(CheckpointError, match=expected):
        published.load(**sources(PLAIN), weights="nf4")
    Engine.of(published.load(**sources(PLAIN), weights="int8"))  # which PyTorch decodes


def test_a_checkpoint_that_is_rounded_reads_its_processor_once_and_frees_the_full_weights(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from rfm.families.robometer import checkpoint as robometer

    full: list[weakref.ref[Any]] = []

    def rounded_as_asked(checkpoint: Any, kind: Any) -> Any:
        full.append(weakref.ref(checkpoint))
        return rounding.rounded_as_asked(checkpoint, kind)

    processor = mock.Mock(wraps=robometer.read_processor)
    monkeypatch.setattr(robometer, "read_processor", processor)
    monkeypatch.setattr(published, "rounded_as_asked", rounded_as_asked)
    options = sources(PLAIN)
    loaded = published.read(**options, weights="int8")
    published.notes(Path(options["source"]), loaded)
    assert loaded.checkpoint.flop(SAMPLES[0]) > 0
    gc.collect()
    assert full[0]() is None
    assert processor.call_count == 1


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


# Weights in bitsandbytes' NF4: the same values, or a refusal.

CASES = ("nested", "plain", "float32", "blocks_across_rows", "odd")
STATE = "weight.quant_state.bitsandbytes__nf4"


@pytest.mark.parametrize("name", CASES)
def test_values_are_bitsandbytes_own(name: str) -> None:
    tensors = case(name)
    expected = tensors.pop("expected")
    assert dequantize(tensors) == 1
    assert tensors.keys() == {"weight"}
    assert tensors["weight"].dtype == expected.dtype
    assert torch.equal(tensors["weight"], expected)


def test_a_weight_of_millions_of_values_is_read_whole() -> None:
    """The same blocks again and again, more than are read at once."""
    tensors = case("plain")
    expected = tensors.pop("expected").flatten()
    times = 5_000_000 // len(expected)
    for part in ("weight", "weight.absmax"):
        tensors[part] = tensors[part].repeat(times, *[1] * (tensors[part].ndim - 1))
    stating(shape=[times, len(expected)])(tensors)
    assert dequantize(tensors) == 1
    assert torch.equal(tensors["weight"], expected.repeat(times, 1))


def stating(**changes: object) -> Callable[[dict[str, Tensor]], object]:
    """Changes the quant state; None takes the key out."""

    def spoil(tensors: dict[str, Tensor]) -> None:
        state = json.loads(tensors[STATE].numpy().tobytes()) | changes
        told = {key: value for key, value in state.items() if value is not None}
        tensors[STATE] = as_bytes(json.dumps(told).encode())

    return spoil


SPOILED: dict[str, tuple[Callable[[dict[str, Tensor]], object], str]] = {
    "no scales": (lambda t: t.pop("weight.absmax"), r"weight\.absmax: expected 257 numbers of torch\.uint8, got none; copy this checkpoint again, or export the full checkpoint that was rounded to NF4$"),
    "a scale too few": (lambda t: t.update({"weight.absmax": t["weight.absmax"][1:]}), r"weight\.absmax: expected 257 numbers of torch\.uint8, got 256 of"),
    "no codes": (lambda t: t.pop("weight.quant_map"), r"weight\.quant_map: expected 16 numbers"),
    "codes of another type": (lambda t: t["weight.quant_map"].mul_(0.5), r"weight\.quant_map: expected the codes of NF4, got \[-0\.5"),
    "no scales of scales": (lambda t: t.pop("weight.nested_absmax"), r"weight\.nested_absmax: expected 2 numbers of torch\.float32, got none"),
    "no weight": (lambda t: t.pop("weight"), r"^weight: expected 4112 numbers of torch\.uint8, got none"),
    "no JSON": (lambda t: t.update({STATE: as_bytes(b"{")}), r"^weight: expected quant_state.* in JSON, got "),
    "a huge state": (lambda t: t.update({STATE: as_bytes(b" " * 100_000)}), r"expected quant_state.* in JSON, got \[100000\] of torch\.uint8"),
    "no shape": (stating(shape=None), r"expected the shape of the weight in its quant_state, got None"),
    "another type of 4 bits": (stating(quant_type="fp4"), r"expected quant_type nf4 in its quant_state, got 'fp4'"),
    "a block of no size": (stating(blocksize=0), r"expected blocksize 32 or 64 or .* in its quant_state, got 0"),
    "blocks of another size": (stating(blocksize=64), r"weight\.nested_absmax: expected 1 numbers of torch\.float32, got 2 of"),
    "a type that is none": (stating(dtype="int8"), r"expected dtype bfloat16 or float16 or float32 in its quant_state, got 'int8'"),
    "an offset in words": (stating(nested_offset="none"), r"expected a number as nested_offset of its quant_state, got 'none'"),
    "scales of another type of number": (stating(nested_dtype="float16"), r"expected nested_dtype float32 in its quant_state, got 'float16'"),
    "scales without blocks": (stating(nested_blocksize=None), r"expected nested_blocksize 32 or .*, got None"),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "expected"), SPOILED.values(), ids=SPOILED)
def test_parts_that_do_not_fit_are_refused(spoil: Callable[[dict[str, Tensor]], object], expected: str) -> None:
    tensors = case("nested")
    spoil(tensors)
    with pytest.raises(CheckpointError, match=expected):
        dequantize(tensors)


@pytest.mark.parametrize("kind", ["fp4", "int8"])
def test_other_types_of_bitsandbytes_are_refused_by_name(tmp_path: Path, kind: str) -> None:
    few_bits, _ = in_both_forms(PLAIN, tmp_path)
    change_config(few_bits, kind)
    with pytest.raises(CheckpointError, match=f"quantization_config: expected none, got 'bitsandbytes {kind}'; export"):
        load(PLAIN, few_bits)


def test_config_json_may_say_nothing_of_nf4_but_nothing_wrong(tmp_path: Path) -> None:
    """A trainer that saves weights alone keeps the base model's configuration."""
    few_bits, full = in_both_forms(PLAIN, tmp_path)
    shutil.copyfile(full / "config.json", few_bits / "config.json")
    sources = goldens.config(PLAIN).sources
    for folder, is_assumed in ((few_bits, True), (full, False)):
        assumed = [each.name for each in published.read(folder, **sources).assumptions]
        assert ("rounded_weights" in assumed) == is_assumed
    change_config(full, "nf4")
    expected = (
        r"config\.json: quantization_config: expected weights in NF4, got none; if they are meant in full precision"
    )
    with pytest.raises(CheckpointError, match=expected):
        load(PLAIN, full)
