# SPDX-License-Identifier: MIT
"""Vision-language checkpoints: what decides each setting, and what is refused."""

from __future__ import annotations

import importlib.metadata
import json
import re
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from google.protobuf import text_format
from safetensors.torch import load_file, save_file
from tritonclient.grpc import model_config_pb2 as pb

import goldens
import rfm_export
import spoilt
from engines import load_engine
from rfm import families
from rfm.checkpoint.content import CheckpointError
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm.vlm import lora
from rfm.vlm.checkpoint import VlmCheckpoint
from rfm_client import (
    ProgressSample,
)
from rfm_client.contract.model_info import FRAME_SIZE_PARAMETER
from spoilt import in_json, settings, text_settings, weights
from vlm import PLAIN, assert_close, film, load

ADAPTER = "q25_peft_adapter_disc10"


LORA_INSIDE = "q3_lora_full_disc10"


@pytest.fixture
def copied(tmp_path: Path) -> Callable[[str], Path]:
    return lambda name: spoilt.copied(goldens.config(name), tmp_path / name)


def test_saving_and_loading_changes_nothing(tmp_path: Path) -> None:
    original = load(LORA_INSIDE)
    original.save(tmp_path / "saved")
    copy = families.load(tmp_path / "saved")
    assert isinstance(copy, VlmCheckpoint)
    assert copy.config == original.config
    assert all(torch.equal(copy.weights[name], original.weights[name]) for name in original.weights)
    assert original.factors
    assert copy.factors.keys() == original.factors.keys()
    assert all(torch.equal(copy.factors[name], original.factors[name]) for name in original.factors)


def test_updates_too_small_for_bfloat16_are_not_lost(copied: Callable[[str], Path], tmp_path: Path) -> None:
    folder = copied(LORA_INSIDE)
    tensors = {}
    for name, tensor in load_file(folder / "model.safetensors").items():
        is_of_lora = ".lora_" in name
        tensors[name.replace(".base_model.model.", ".")] = tensor * 3e-3 if is_of_lora else tensor.bfloat16()
    save_file(tensors, folder / "model.safetensors")
    load(LORA_INSIDE, folder).save(tmp_path / "saved")
    exported = families.load(tmp_path / "saved")
    assert isinstance(exported, VlmCheckpoint)
    built = exported.build(torch.float32).state_dict()
    modules = [name.removesuffix(".base_layer.weight") for name in tensors if ".base_layer." in name]
    for module in modules:
        base = tensors[f"{module}.base_layer.weight"].double()
        factor_a, factor_b = (tensors[f"{module}.lora_{side}.default.weight"].double() for side in "AB")
        update = 8 / 4 * factor_b @ factor_a  # lora_alpha / r of the run
        assert ((base + update).bfloat16() == base).double().mean() > 0.9  # a sum in bfloat16 is the base alone
        torch.testing.assert_close(built[f"{module}.weight"].double() - base, update, rtol=1e-2, atol=1e-7)
    assert len(modules) == 14


def test_factors_that_need_no_scale_stay_as_they_are() -> None:
    """So an export of an export is the same, and as large."""
    factors = {f"layer.lora_{side}.weight": torch.ones(2, 2, dtype=torch.bfloat16) for side in "AB"}
    _, split = lora.split({"layer.weight": torch.zeros(2, 2)} | factors)
    assert {name: tensor.dtype for name, tensor in split.items()} == dict.fromkeys(factors, torch.bfloat16)


def test_lora_of_weights_that_make_text_is_not_needed(copied: Callable[[str], Path]) -> None:
    folder = copied(LORA_INSIDE)
    tensors = load_file(folder / "model.safetensors")
    of_head = {"base_layer": (32, 32), "lora_A.default": (4, 32), "lora_B.default": (32, 4)}
    tensors |= {f"model.lm_head.{name}.weight": torch.ones(shape) for name, shape in of_head.items()}
    save_file(tensors, folder / "model.safetensors")
    with_head, original = load(LORA_INSIDE, folder), load(LORA_INSIDE)
    assert with_head.weights.keys() == original.weights.keys()
    assert with_head.factors.keys() == original.factors.keys()


def adapter(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    return weights(change, "adapter_model.safetensors")


def change_yaml(old: str, new: str) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        text = (folder / "config.yaml").read_text()
        assert old in text
        (folder / "config.yaml").write_text(text.replace(old, new))

    return spoil


def as_transformers_5_writes(backbone: dict[str, Any]) -> None:
    text = backbone["text_config"]
    text["rope_parameters"] = {"rope_type": "default"} | (text.pop("rope_scaling") or {})
    text["rope_parameters"]["rope_theta"] = text.pop("rope_theta")
    text["pad_token_id"] = None
    if backbone["model_type"] != "smolvlm":
        backbone["vision_config"]["rope_parameters"] = {"rope_theta": 10000.0, "rope_type": "axial"}
        backbone["vision_config"]["model_type"] += "_vision"


def as_before_text_config(backbone: dict[str, Any]) -> None:
    text = backbone.pop("text_config")
    sections = text["rope_scaling"]["mrope_section"]
    for name, value in (text | {"rope_scaling": {"type": "mrope", "mrope_section": sections}}).items():
        backbone.setdefault(name, value)


def rename(
    pattern: str, replacement: str | Callable[[re.Match[str]], str], file: str = "model.safetensors"
) -> Callable[[Path], None]:
    def change(weights: dict[str, Any]) -> None:
        for name in [*weights]:
            weights[re.sub(pattern, replacement, name)] = weights.pop(name)

    return weights(change, file)


def beside_another_adapter(folder: Path) -> None:
    beside_its_adapter(folder)
    settings("adapter_config.json", lora_alpha=16)(folder)


def beside_its_adapter(folder: Path) -> None:
    """What upstream writes of a LoRA run since its pull request 25."""
    weights = load_file(folder / "model.safetensors")
    adapter = {
        f"base_model.model.{name.split('.base_model.model.')[1].replace('.default.', '.')}": tensor
        for name, tensor in weights.items()
        if ".lora_" in name
    }
    save_file(adapter, folder / "adapter_model.safetensors")
    heads = {name: tensor for name, tensor in weights.items() if not name.startswith("model.")}
    save_file(heads, folder / "custom_heads.safetensors")
    shutil.copy(goldens.config(ADAPTER).checkpoint / "adapter_config.json", folder)
    (folder / "peft_target_module.json").write_text('{"target_module": "language_model", "adapter_dir": "."}')


FORMS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "Qwen2.5-VL of transformers 5": ("q25_mean_l2", in_json("config.json", as_transformers_5_writes)),
    "Qwen3-VL of transformers 5": (PLAIN, in_json("config.json", as_transformers_5_writes)),
    "SmolVLM of transformers 5": ("smol_mean_disc10", in_json("config.json", as_transformers_5_writes)),
    "Qwen2.5-VL without text_config": ("q25_mean_l2", in_json("config.json", as_before_text_config)),
    "layers right under the model": (
        "q25_mean_l2",
        rename(r"^model\.(language_model|visual)\b", lambda found: "visual" if found[1] == "visual" else "model"),
    ),
    "with rotary frequencies": (
        "q25_mean_l2",
        weights(
            lambda w: w.update(
                {
                    "model.language_model.rotary_emb.inv_freq": torch.ones(8),
                    "model.visual.rotary_pos_emb.inv_freq": torch.ones(4),
                }
            ),
        ),
    ),
    "a whole model beside its adapter": (LORA_INSIDE, beside_its_adapter),
    "an adapter around the language model": (
        ADAPTER,
        rename(r"^base_model\.model\.language_model\.", "base_model.model.", "adapter_model.safetensors"),
    ),
    "LoRA around the whole model": (
        LORA_INSIDE,
        rename(r"^model\.language_model\.base_model\.model\.", "model.base_model.model.language_model."),
    ),
}


@pytest.mark.parametrize(("name", "change"), FORMS.values(), ids=FORMS)
def test_a_checkpoint_in_another_form_scores_the_same(
    copied: Callable[[str], Path], name: str, change: Callable[[Path], None]
) -> None:
    known, folder = load_engine(name), copied(name)
    change(folder)
    engine = Engine.from_checkpoint(folder, base_model=str(goldens.config(name).base_model))
    (result,), (expected,) = (each.evaluate([ProgressSample(film(0, 3, 60, 84))]) for each in (engine, known))
    assert_close(result, expected, 1e-6)  # sums differ with where weights lie in memory


def drop_first(part: str) -> Callable[[dict[str, Any]], object]:
    return lambda weights: weights.pop(next(name for name in weights if part in name))


def cut_first(part: str) -> Callable[[dict[str, Any]], object]:
    """Takes the last column of the first tensor whose name has ``part``."""

    def cut(weights: dict[str, Any]) -> None:
        name = next(name for name in weights if part in name)
        weights[name] = weights[name][:, :-1].contiguous()

    return cut


SPOILED: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "no reward heads": (
        PLAIN,
        weights(lambda w: w.pop("progress_head.4.weight")),
        r"expected reward heads, got no progress_head.4.weight",
    ),
    "a video whose size is not told": (
        "q25_video_last_l2",
        change_yaml("  resized_height: 56\n", ""),
        r"data\.resized_height: expected a number or null, got no such key",
    ),
    "a size that is none": ("q25_video_last_l2", change_yaml("resized_width: 84", "resized_width: wide"), r"data\.resized_width: expected a whole number"),
    "a run of nothing": (PLAIN, lambda folder: (folder / "config.yaml").write_text("{}") and None, r"config\.yaml: model: expected the settings"),
    "text for a truth": (PLAIN, change_yaml("average_temporal_patches: false", "average_temporal_patches: 'false'"), r"average_temporal_patches: expected bool, got 'false'"),
    "a temperature of zero": (PLAIN, change_yaml("attn_temperature: 1.0", "attn_temperature: 0.0"), r"temperature: expected a number above 0, got 0.0"),
    "a temperature in words": (PLAIN, change_yaml("attn_temperature: 1.0", "attn_temperature: warm"), r"temperature: expected float, got 'warm'"),
    "pairwise progress": (PLAIN, change_yaml("  model_type: default", "  pairwise_progress: true"), r"model\.pairwise_progress: expected false .*, got true"),
    "a pooling that is none": (PLAIN, change_yaml("frame_pooling: mean", "frame_pooling: max"), r"frame_pooling: expected"),
    "tokens without images": (PLAIN, change_yaml("use_multi_image: true", "use_multi_image: false"), r"use_multi_image with per-frame progress tokens: expected true"),
    "answers in generated text": (
        PLAIN,
        change_yaml("model_type: default", "model_type: vqa"),
        r"model\.model_type: expected default, got 'vqa': .* upstream's successor dropped the type",
    ),
    "another model type": (PLAIN, change_yaml("model_type: default", "model_type: dpo"), r"model_type: expected default, got 'dpo'$"),
    "layers that see few tokens": (
        "q25_mean_l2",
        text_settings(layer_types=["sliding_attention", "full_attention"]),
        r"text_config\.layer_types: expected full_attention alone, got \['full_attention', 'sliding_attention'\]",
    ),
    "rotary positions without a base": (
        "smol_mean_disc10",
        in_json("config.json", lambda backbone: backbone["text_config"].pop("rope_theta")),
        r"config\.json: text_config\.rope_theta: expected a number above 0, got None; copy it from config\.json of the base",
    ),
    "rotary positions without sections": (PLAIN, text_settings(rope_scaling=None), r"rope_scaling\.mrope_section: expected a list of numbers, got None"),
    "two bases of rotary positions": (PLAIN, text_settings(rope_parameters={"rope_theta": 1e4}), r"expected one value of rope_theta in text_config, got 10000\.0 and 5000000\.0"),
    "two types of rotary positions": (PLAIN, text_settings(rope_parameters={"rope_type": "linear"}), r"expected one value of rope_type in rope_scaling, got 'linear' and 'default'"),
    "pairs of a head rotated": (PLAIN, text_settings(rope_interleaved=True), r"text_config\.rope_interleaved: expected false, got True"),
    **{
        f"no {name} of the {part}": (
            checkpoint,
            in_json("config.json", lambda backbone, part=part, name=name: backbone[part].pop(name)),
            rf"config\.json: {part}\.{name}: expected a value, got none; copy it",
        )
        for checkpoint, part, name in [
            (PLAIN, "text_config", "rms_norm_eps"),
            ("q25_mean_l2", "text_config", "num_attention_heads"),
            ("q25_mean_l2", "vision_config", "fullatt_block_indexes"),
            (PLAIN, "vision_config", "deepstack_visual_indexes"),
            ("smol_mean_disc10", "vision_config", "num_attention_heads"),
        ]
    },
    "a vision tower with other rotary positions": (
        PLAIN,
        in_json("config.json", lambda backbone: backbone["vision_config"].update(rope_parameters={"rope_theta": 100.0})),
        r"vision_config\.rope_parameters: expected axial with a rope_theta of 10000, got {'rope_theta': 100\.0}",
    ),
    **{
        f"weights of {method}": (
            PLAIN,
            in_json("config.json", lambda backbone, method=method: backbone.update(quantization_config={"quant_method": method})),
            rf"config\.json: quantization_config: expected none, got '{method}'; export the checkpoint that was quantized",
        )
        for method in ("bitsandbytes", "gptq", "awq", "fp8", "compressed-tensors")
    },
    **{
        f"weights with {part}": (
            PLAIN,
            weights(lambda w, part=part: w.update({f"model.language_model.layers.0.mlp.up_proj{part}": torch.ones(1)})),
            rf"expected weights in full precision, got '.*{part}'; export the checkpoint that was quantized",
        )
        for part in (".weight.absmax", ".weight.quant_state.bitsandbytes__fp4", ".SCB", ".qweight", ".weight_scale_inv")
    },
    "a weight under two names": (
        "q25_mean_l2",
        weights(lambda w: w.update({"model.norm.weight": torch.ones(32)})),
        r"model\.language_model\.norm\.weight: expected one weight, got .*'model\.norm\.weight'.*; remove the one",
    ),
    "LoRA without alpha": (LORA_INSIDE, change_yaml("lora_alpha: 8", "lora_beta: 8"), r"expected lora_alpha and r of the LoRA weights"),
    "half a LoRA pair": (LORA_INSIDE, weights(drop_first("lora_B")), r"expected a weight and LoRA factors A and B, got \['A'\]"),
    "LoRA factors of two ranks": (
        LORA_INSIDE,
        weights(cut_first("lora_B")),
        r"expected LoRA factors of one rank, got \[\d+, 3\] and \[4, \d+\]",
    ),
    "LoRA with a field of the future": (ADAPTER, settings("adapter_config.json", use_newlora=True), r"expected plain LoRA, got use_newlora"),
    "an adapter that is no LoRA": (ADAPTER, settings("adapter_config.json", peft_type="IA3", r=None), r"peft_type: expected LORA, got 'IA3'"),
    **{
        f"LoRA that begins by {init}": (ADAPTER, settings("adapter_config.json", init_lora_weights=init), rf"init_lora_weights: expected true, got '{init}', .* merge it")
        for init in ("pissa", "pissa_niter_16", "olora", "corda", "eva", "loftq", "lora_ga")
    },
    "a run of another rank": (LORA_INSIDE, change_yaml("  r: 4", "  r: 32"), r"config\.yaml: r: expected 4, the rows of .*lora_A, got 32; put in r"),
    "a module of another rank": (
        LORA_INSIDE,
        weights(lambda w: w.update({n: torch.cat([t, t], 0 if "_A" in n else 1) for n, t in w.items() if "layers.1.mlp.up_proj.lora_" in n})),
        r"r: expected 8, the rows of model\.language_model\.layers\.1\.mlp\.up_proj\.lora_A, got 4",
    ),
    "a run and an adapter that disagree": (
        LORA_INSIDE,
        beside_another_adapter,
        r"adapter_config\.json: expected r 4 and lora_alpha 8, as .*config\.yaml has it, got r 4 and lora_alpha 16",
    ),
    "a run of before 2026-01-21": (
        PLAIN,
        weights(lambda w: w.pop("frame_pool_attn.weight")),
        r"expected frame_pool_attn\.weight, got none: .* before that day was trained with 8 special tokens",
    ),
    "an adapter and whole weights": (
        ADAPTER,
        lambda folder: save_file({"any": torch.zeros(1)}, folder / "model.safetensors"),
        r"expected an adapter \(adapter_config\.json\) or whole weights \(model\.safetensors\), got both",
    ),
    "whole weights and an adapter without its configuration": (
        PLAIN,
        lambda folder: save_file({"any": torch.zeros(1)}, folder / "adapter_model.safetensors"),
        r"expected an adapter \(adapter_model\.safetensors\) or whole weights \(model\.safetensors\), got both",
    ),
    "an adapter without its embedding": (
        ADAPTER,
        adapter(drop_first("embed_tokens")),
        r"expected the embedding of the special tokens, got none: their rows .* are lost .*save_embedding_layers=True",
    ),
    "an adapter of another model": (
        ADAPTER,
        adapter(lambda w: w.update({"base_model.model.other.weight": torch.zeros(1)})),
        r"got also \['model.other.weight'\]",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("name", "spoil", "message"), SPOILED.values(), ids=SPOILED)
def test_a_spoiled_checkpoint_is_refused(
    copied: Callable[[str], Path], name: str, spoil: Callable[[Path], None], message: str
) -> None:
    folder = copied(name)
    spoil(folder)
    with pytest.raises(CheckpointError, match=message):
        load(name, folder).build()


def test_an_adapter_s_base_model_is_the_one_of_its_run() -> None:
    config = goldens.config(ADAPTER)
    run = yaml.safe_load((config.checkpoint / "config.yaml").read_text())
    with pytest.raises(CheckpointError, match=re.escape(f"base model {run['model']['base_model_id']}: ")):
        families.load(config.checkpoint)


def test_smolvlm_is_refused_where_its_scores_would_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = load("smol_mean_disc10")
    monkeypatch.setattr(importlib.metadata, "version", lambda _name: "5.0.0")
    with pytest.raises(CheckpointError, match=r"transformers: expected transformers < 5 for a SmolVLM checkpoint"):
        checkpoint.build()


@pytest.mark.parametrize(
    ("name", "version", "is_told"),
    [
        ("q25_video_last_l2", "5.5.4", True),
        ("q25_video_last_l2", "4.57.6", False),
        ("q25_mean_l2", "5.5.4", False),
        (PLAIN, "5.5.4", False),
    ],
)
def test_a_video_run_of_transformers_5_is_told_about_its_positions(
    copied: Callable[[str], Path], name: str, version: str, is_told: bool
) -> None:
    folder = copied(name)
    in_json("config.json", lambda backbone: backbone.update(transformers_version=version))(folder)
    notes = families.notes(folder, load(name, folder))
    assert any(f"transformers_version is {version}: text behind a video" in note for note in notes) == is_told


def test_a_processor_of_another_model_is_refused() -> None:
    other = str(goldens.config(ADAPTER).base_model)
    with pytest.raises(CheckpointError, match=r"expected a tokenizer of 451 tokens .*, got 447"):
        Engine.from_checkpoint(goldens.config(PLAIN).checkpoint, base_model=other)


def test_eight_special_tokens_tell_an_old_run(copied: Callable[[str], Path]) -> None:
    folder = copied(PLAIN)
    three_more = lambda w: w.update({n: torch.cat([t, t[-3:]]) for n, t in w.items() if "embed_tokens" in n})  # noqa: E731
    weights(three_more)(folder)
    text_settings(vocab_size=454)(folder)
    with pytest.raises(
        CheckpointError, match=r"tokens .*, got 451 \(with 8 special tokens, as upstream before 2026-01-21"
    ):
        _ = load(PLAIN, folder).collator


def test_a_preprocessor_file_as_qwen_publishes_it_is_read(tmp_path: Path) -> None:
    """With few fields, where the references have all that transformers writes."""
    base = tmp_path / "base"
    shutil.copytree(str(goldens.config(PLAIN).base_model), base)
    file = base / "preprocessor_config.json"
    few = ("size", "patch_size", "temporal_patch_size", "merge_size", "image_mean", "image_std")
    fields = {name: value for name, value in json.loads(file.read_text()).items() if name in few}
    file.chmod(0o644)
    file.write_text(json.dumps(fields))
    Engine.from_checkpoint(goldens.config(PLAIN).checkpoint, base_model=str(base))


def as_transformers_5_saves(base: Path) -> None:
    """Rewrites a processor's files."""
    config = json.loads((base / "tokenizer_config.json").read_text())
    special = config.pop("additional_special_tokens")
    config.pop("added_tokens_decoder")
    config |= {"extra_special_tokens": special, "backend": "tokenizers", "tokenizer_class": "TokenizersBackend"}
    (base / "tokenizer_config.json").write_text(json.dumps(config))
    images = json.loads((base / "preprocessor_config.json").read_text())
    (base / "processor_config.json").write_text(json.dumps({"image_processor": images}))
    template = json.loads((base / "chat_template.json").read_text())["chat_template"]
    (base / "chat_template.jinja").write_text(template)
    for file in base.iterdir():
        if file.name not in ("tokenizer.json", "tokenizer_config.json", "processor_config.json", "chat_template.jinja"):
            file.unlink()


@pytest.mark.parametrize("name", ["q25_mean_l2", PLAIN, "smol_mean_disc10"])
def test_a_processor_of_transformers_5_reads_the_same(tmp_path: Path, name: str) -> None:
    known, config = load_engine(name), goldens.config(name)
    base = tmp_path / "base"
    shutil.copytree(str(config.base_model), base, copy_function=shutil.copyfile)
    as_transformers_5_saves(base)
    engine = Engine.from_checkpoint(config.checkpoint, base_model=str(base))
    load(name, base=str(base)).save(tmp_path / "saved")
    saved = Engine.from_checkpoint(tmp_path / "saved")
    sample = ProgressSample(film(0, 3, 60, 84))
    (expected,) = known.evaluate([sample])
    for other in (engine, saved):
        (result,) = other.evaluate([sample])
        assert_close(result, expected, 1e-6)


def test_a_processor_without_image_settings_is_refused(tmp_path: Path) -> None:
    base = tmp_path / "base"
    shutil.copytree(str(goldens.config(PLAIN).base_model), base, copy_function=shutil.copyfile)
    as_transformers_5_saves(base)
    (base / "processor_config.json").write_text("{}")
    expected = (
        r"expected preprocessor_config\.json, or image_processor in processor_config\.json, got none .*--base-model"
    )
    with pytest.raises(CheckpointError, match=expected):
        _ = load(PLAIN, base=str(base)).collator


def rewritten(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """The folder's config.yaml, changed."""
    file = folder / "config.yaml"
    content = yaml.safe_load(file.read_text())
    change(content)
    file.write_text(yaml.safe_dump(content))


def test_fields_that_an_old_upstream_did_not_have_are_what_it_did(copied: Callable[[str], Path]) -> None:
    folder = copied("q25_video_last_l2")
    (folder / "config.yaml").write_text(
        "model: {base_model_id: some/base}\ndata: {resized_height: 56, resized_width: 84}\n"
    )
    config = load("q25_video_last_l2", folder).config
    assert not config.multi_image
    assert not config.per_frame_progress_token
    assert not config.progress_in_preference
    assert not config.average_temporal_patches
    assert (config.frame_pooling, config.pooling_temperature, config.size_px) == ("mean", 1.0, (56, 84))
    assert (config.dtype, config.trained_frames) == ("bfloat16", None)


@pytest.mark.parametrize("name", [PLAIN, ADAPTER, "q25_mean_l2", "q25_video_avg_disc10"])
def test_without_config_yaml_nothing_is_guessed(copied: Callable[[str], Path], name: str) -> None:
    folder = copied(name)
    (folder / "config.yaml").unlink()
    with pytest.raises(CheckpointError, match=r"expected config\.yaml of the training run there, in the folder above"):
        load(name, folder)


TWICE = ("use_multi_image", "use_per_frame_progress_token")


@pytest.mark.parametrize("section", ["model", "data"])
def test_either_section_tells_how_frames_are_shown(copied: Callable[[str], Path], section: str) -> None:
    folder = copied(PLAIN)
    rewritten(folder, lambda run: [run[section].pop(key) for key in TWICE])
    assert load(PLAIN, folder).config == load(PLAIN).config


@pytest.mark.parametrize("key", TWICE)
def test_sections_that_disagree_are_refused(copied: Callable[[str], Path], key: str) -> None:
    folder = copied(PLAIN)
    rewritten(folder, lambda run: run["data"].update({key: False}))
    expected = rf"expected model\.{key} and data\.{key} to agree, got model\.{key} true and data\.{key} false"
    with pytest.raises(CheckpointError, match=expected):
        load(PLAIN, folder)


def test_a_size_for_images_is_ignored_as_upstream_does(copied: Callable[[str], Path], tmp_path: Path) -> None:
    folder = copied(PLAIN)
    rewritten(folder, lambda run: run["data"].update(resized_height=112, resized_width=84))
    base = str(goldens.config(PLAIN).base_model)
    sample = ProgressSample(film(0, 2, 48, 80))
    (result,) = Engine.from_checkpoint(folder, base_model=base).evaluate([sample])
    (expected,) = load_engine(PLAIN).evaluate([sample])
    assert_close(result, expected, 1e-6)

    rfm_export.export(folder, tmp_path / "repository", ExportConfig(num_gpus=0, torch_threads=1, base_model=base))
    text = (tmp_path / "repository" / "rfm_frames" / "config.pbtxt").read_text()
    assert text_format.Parse(text, pb.ModelConfig()).parameters[FRAME_SIZE_PARAMETER].string_value == ""
    exported = families.load(tmp_path / "repository" / "rfm_frames" / "1" / "checkpoint")
    assert isinstance(exported, VlmCheckpoint)
    assert exported.config.size_px is None


def test_videos_are_not_pooled_as_images_are(copied: Callable[[str], Path]) -> None:
    """Upstream takes the mean of a group of frames, whatever frame_pooling says."""
    folder = copied("q25_video_avg_disc10")
    rewritten(folder, lambda run: run["model"].update(frame_pooling="attention", frame_pooling_attn_temperature=0.01))
    base = str(goldens.config("q25_video_avg_disc10").base_model)
    sample = ProgressSample(film(0, 4, 48, 80))
    (result,) = Engine.from_checkpoint(folder, base_model=base).evaluate([sample])
    (expected,) = load_engine("q25_video_avg_disc10").evaluate([sample])
    assert_close(result, expected, 1e-6)


def test_the_processor_s_chat_template_wins_over_the_tokenizer_s(copied: Callable[[str], Path], tmp_path: Path) -> None:
    """Upstream prompts by the processor."""
    folder = copied(PLAIN)
    rewritten(folder, lambda run: run["model"].update(base_model_id="org/own-qwen3-vl"))
    base = tmp_path / "base"
    shutil.copytree(str(goldens.config(PLAIN).base_model), base, copy_function=shutil.copyfile)
    file = base / "tokenizer_config.json"
    other = {"chat_template": "{% for message in messages %}of the tokenizer{% endfor %}"}
    file.write_text(json.dumps(json.loads(file.read_text()) | other))

    def prompt() -> str:
        template = str(load(PLAIN, folder, str(base)).collator.tokenizer.chat_template)
        with tempfile.TemporaryDirectory() as saving:
            saved = Path(saving, "saved")
            load(PLAIN, folder, str(base)).save(saved)
            assert families.load(saved).collator.tokenizer.chat_template == template
        return template

    assert prompt() == json.loads((base / "chat_template.json").read_text())["chat_template"]
    (base / "chat_template.json").unlink()
    assert prompt() == other["chat_template"]
    (base / "chat_template.jinja").write_text("of the processor, in its newer file")
    assert prompt() == "of the processor, in its newer file"


OTHER_BASES = (
    "Qwen/Qwen2.5-VL-7B-Instruct",
    "Qwen/Qwen2.5-VL-3B",
    "/scratch/snapshots/66285546d2b821cf421d4f5eb2576359d3770cd3",
)
SAME_BASES = (
    "/scratch/models/Qwen2.5-VL-3B-Instruct/",
    "unsloth/qwen2.5-vl-3b-instruct-unsloth",
    "unsloth/Qwen2.5-VL-3B-Instruct",
    None,
    "",
)  # fmt: skip


@pytest.mark.parametrize("base", OTHER_BASES)
def test_an_adapter_on_another_base_model_is_asked_about(copied: Callable[[str], Path], base: str) -> None:
    folder = copied(ADAPTER)
    settings("adapter_config.json", base_model_name_or_path=base)(folder)
    expected = f"{folder}/adapter_config.json: base_model_name_or_path: expected Qwen/Qwen2.5-VL-3B-Instruct"
    with pytest.raises(CheckpointError, match=rf"{re.escape(expected)}, .*, got '{re.escape(base)}'; .* --base-model"):
        families.load(folder)
    assert load(ADAPTER, folder).config == load(ADAPTER).config  # which names --base-model


@pytest.mark.parametrize(
    "base", ["unsloth/qwen2.5-vl-3b-instruct-unsloth-bnb-4bit", "/models/Qwen2.5-VL-3B-Instruct-bnb-4bit/"]
)
def test_an_adapter_on_weights_of_few_bits_is_refused(copied: Callable[[str], Path], base: str) -> None:
    folder = copied(ADAPTER)
    settings("adapter_config.json", base_model_name_or_path=base)(folder)
    expected = rf"adapter_config\.json: base_model_name_or_path: expected weights in full precision, got '{re.escape(base)}'; .*"
    with pytest.raises(CheckpointError, match=expected + r"m\.dequantize\(\).* with --base-model$"):
        families.load(folder)
    assert load(ADAPTER, folder).config == load(ADAPTER).config  # which names --base-model


def test_a_base_model_of_few_bits_is_refused(tmp_path: Path) -> None:
    base = tmp_path / "base"
    shutil.copytree(str(goldens.config(ADAPTER).base_model), base, copy_function=shutil.copyfile)
    in_json("config.json", lambda config: config.update(quantization_config={"quant_method": "bitsandbytes"}))(base)
    expected = rf"base model {base}: config\.json: quantization_config: expected none, got 'bitsandbytes'; .*dequantize"
    with pytest.raises(CheckpointError, match=expected):
        load(ADAPTER, base=str(base))


@pytest.mark.parametrize("base", SAME_BASES)
def test_an_adapter_s_base_model_under_another_name_is_taken(copied: Callable[[str], Path], base: str | None) -> None:
    folder = copied(ADAPTER)
    settings("adapter_config.json", base_model_name_or_path=base)(folder)
    with pytest.raises(CheckpointError, match=r"^base model Qwen/Qwen2\.5-VL-3B-Instruct: cannot be had"):
        families.load(folder)
