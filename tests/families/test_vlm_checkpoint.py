# SPDX-License-Identifier: MIT
"""Vision-language checkpoints: the source of each setting, and refusals."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file

import goldens
import rfm_export
import spoilt
from engines import load_engine, serve_config
from repositories import description_of
from rfm import families
from rfm.engine import Engine
from rfm.families import CheckpointError
from rfm_client import ProgressSample, Result, RewardError
from spoilt import Spoil, in_json, settings, text, text_settings, weights
from vlm import PLAIN, assert_close, load, video

ADAPTER = "q25_peft_adapter_disc10"
LORA_INSIDE = "q3_lora_full_disc10"
SAMPLE = ProgressSample(video(0, 3, 60, 84))
TWICE = ("use_multi_image", "use_per_frame_progress_token")


@pytest.fixture
def copied(tmp_path: Path) -> Callable[[str], Path]:
    return lambda name: spoilt.copied(goldens.config(name), tmp_path / name)


@pytest.fixture
def base(tmp_path: Path) -> Path:
    """A copy of a reference's base model."""
    return shutil.copytree(
        goldens.config(PLAIN).sources["base_model"], tmp_path / "base", copy_function=shutil.copyfile
    )


def in_yaml(change: Callable[[dict[str, Any]], object]) -> Spoil:
    """Changes config.yaml."""

    def spoil(folder: Path) -> None:
        content = yaml.safe_load((folder / "config.yaml").read_text())
        change(content)
        (folder / "config.yaml").write_text(yaml.safe_dump(content))

    return spoil


def run(section: str, **changes: Any) -> Spoil:
    """Changes a section of config.yaml."""
    return in_yaml(lambda content: content[section].update(changes))


def scores(folder: Path, name: str, **sources: str) -> Result:
    (result,) = Engine.of(families.load(folder, **goldens.config(name).sources | sources)).evaluate([SAMPLE])
    assert not isinstance(result, RewardError), result
    return result


def test_saving_and_loading_changes_nothing(tmp_path: Path) -> None:
    original = load(LORA_INSIDE)
    original.save(tmp_path / "saved")
    copy = families.load(tmp_path / "saved")
    assert copy.config == original.config
    assert original.factors
    for got, wanted in ((copy.weights, original.weights), (copy.factors, original.factors)):
        assert got.keys() == wanted.keys()
        assert all(torch.equal(got[name], wanted[name]) for name in wanted)


def test_updates_too_small_for_bfloat16_are_not_lost(copied: Callable[[str], Path], tmp_path: Path) -> None:
    folder = copied(LORA_INSIDE)
    tensors = {}
    for name, tensor in load_file(folder / "model.safetensors").items():
        is_of_lora = ".lora_" in name
        tensors[name.replace(".base_model.model.", ".")] = tensor * 3e-3 if is_of_lora else tensor.bfloat16()
    save_file(tensors, folder / "model.safetensors")
    load(LORA_INSIDE, folder).save(tmp_path / "saved")
    built = load(LORA_INSIDE, tmp_path / "saved").build(torch.float32).state_dict()
    modules = [name.removesuffix(".base_layer.weight") for name in tensors if ".base_layer." in name]
    for module in modules:
        base = tensors[f"{module}.base_layer.weight"].double()
        factor_a, factor_b = (tensors[f"{module}.lora_{side}.default.weight"].double() for side in "AB")
        update = 8 / 4 * factor_b @ factor_a  # lora_alpha / r of the run
        assert ((base + update).bfloat16() == base).double().mean() > 0.9  # a sum in bfloat16 is the base alone
        torch.testing.assert_close(built[f"{module}.weight"].double() - base, update, rtol=1e-2, atol=1e-7)
    assert len(modules) == 14


def test_lora_of_weights_that_make_text_is_not_needed(copied: Callable[[str], Path]) -> None:
    folder = copied(LORA_INSIDE)
    of_head = {"base_layer": (32, 32), "lora_A.default": (4, 32), "lora_B.default": (32, 4)}
    more = {f"model.lm_head.{name}.weight": torch.ones(shape) for name, shape in of_head.items()}
    weights(lambda tensors: tensors.update(more))(folder)
    with_head, original = load(LORA_INSIDE, folder), load(LORA_INSIDE)
    assert with_head.weights.keys() == original.weights.keys()
    assert with_head.factors.keys() == original.factors.keys()


def as_transformers_5_writes(backbone: dict[str, Any]) -> None:
    text = backbone["text_config"]
    text["rope_parameters"] = {"rope_type": "default"} | (text.pop("rope_scaling") or {})
    text["rope_parameters"]["rope_theta"] = text.pop("rope_theta")
    text["pad_token_id"] = None
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
    def change(tensors: dict[str, Any]) -> None:
        for name in [*tensors]:
            tensors[re.sub(pattern, replacement, name)] = tensors.pop(name)

    return weights(change, file)


def beside_its_adapter(folder: Path) -> None:
    """Write a LoRA run as upstream does since pull request 25."""
    tensors = load_file(folder / "model.safetensors")
    adapter = {
        f"base_model.model.{name.split('.base_model.model.')[1].replace('.default.', '.')}": tensor
        for name, tensor in tensors.items()
        if ".lora_" in name
    }
    save_file(adapter, folder / "adapter_model.safetensors")
    heads = {name: tensor for name, tensor in tensors.items() if not name.startswith("model.")}
    save_file(heads, folder / "custom_heads.safetensors")
    shutil.copy(goldens.config(ADAPTER).checkpoint / "adapter_config.json", folder)
    (folder / "peft_target_module.json").write_text('{"target_module": "language_model", "adapter_dir": "."}')


FORMS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "Qwen2.5-VL of transformers 5": ("q25_mean_l2", in_json("config.json", as_transformers_5_writes)),
    "Qwen3-VL of transformers 5": (PLAIN, in_json("config.json", as_transformers_5_writes)),
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
    folder = copied(name)
    change(folder)
    (expected,) = load_engine(name).evaluate([SAMPLE])
    assert_close(scores(folder, name), expected, 1e-6)  # sums differ with where weights lie in memory


def drop_first(part: str) -> Callable[[dict[str, Any]], object]:
    return lambda weights: weights.pop(next(name for name in weights if part in name))


def cut_first(part: str) -> Callable[[dict[str, Any]], object]:
    """Remove the last column of the first tensor with ``part`` in the name."""

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
        in_yaml(lambda content: content["data"].pop("resized_height")),
        r"data\.resized_height: expected a number or null, got no such key",
    ),
    "a size that is none": ("q25_video_last_l2", run("data", resized_width="wide"), r"data\.resized_width: expected a whole number"),
    "a run of nothing": (PLAIN, text("config.yaml", "{}"), r"config\.yaml: model: expected the settings"),
    "text for a truth": (PLAIN, run("model", average_temporal_patches="false"), r"average_temporal_patches: expected bool, got 'false'"),
    "a temperature of zero": (PLAIN, run("model", frame_pooling_attn_temperature=0.0), r"temperature: expected a number above 0, got 0.0"),
    "a temperature in words": (PLAIN, run("model", frame_pooling_attn_temperature="warm"), r"temperature: expected float, got 'warm'"),
    "pairwise progress": (PLAIN, run("model", pairwise_progress=True), r"model\.pairwise_progress: expected false .*, got true"),
    "a pooling that is none": (PLAIN, run("model", frame_pooling="max"), r"frame_pooling: expected"),
    "tokens without images": (PLAIN, in_yaml(lambda content: [content[part].update(use_multi_image=False) for part in ("model", "data")]), r"use_multi_image with per-frame progress tokens: expected true"),
    **{
        f"two words on {key}": (PLAIN, run("data", **{key: False}), rf"expected model\.{key} and data\.{key} to agree, got model\.{key} true and data\.{key} false")
        for key in TWICE
    },
    "answers in generated text": (
        PLAIN,
        run("model", model_type="vqa"),
        r"model\.model_type: expected default, got 'vqa': .* upstream's successor dropped the type",
    ),
    "another model type": (PLAIN, run("model", model_type="dpo"), r"model_type: expected default, got 'dpo'$"),
    "layers that see few tokens": (
        "q25_mean_l2",
        text_settings(layer_types=["sliding_attention", "full_attention"]),
        r"text_config\.layer_types: expected full_attention alone, got \['full_attention', 'sliding_attention'\]",
    ),
    "rotary positions without a base": (
        PLAIN,
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
            (PLAIN, "vision_config", "num_heads"),
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
    "LoRA without alpha": (LORA_INSIDE, in_yaml(lambda content: content["peft"].pop("lora_alpha")), r"expected lora_alpha and r of the LoRA weights"),
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
    "a run of another rank": (LORA_INSIDE, run("peft", r=32), r"config\.yaml: r: expected 4, the rows of .*lora_A, got 32; put in r"),
    "a module of another rank": (
        LORA_INSIDE,
        weights(lambda w: w.update({n: torch.cat([t, t], 0 if "_A" in n else 1) for n, t in w.items() if "layers.1.mlp.up_proj.lora_" in n})),
        r"r: expected 8, the rows of model\.language_model\.layers\.1\.mlp\.up_proj\.lora_A, got 4",
    ),
    "a run and an adapter that disagree": (
        LORA_INSIDE,
        lambda folder: [beside_its_adapter(folder), settings("adapter_config.json", lora_alpha=16)(folder)],
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
        weights(drop_first("embed_tokens"), "adapter_model.safetensors"),
        r"expected the embedding of the special tokens, got none: their rows .* are lost .*save_embedding_layers=True",
    ),
    "an adapter of another model": (
        ADAPTER,
        weights(lambda w: w.update({"base_model.model.other.weight": torch.zeros(1)}), "adapter_model.safetensors"),
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
        Engine.of(families.load(goldens.config(PLAIN).checkpoint, base_model=other))


def test_eight_special_tokens_tell_an_old_run(copied: Callable[[str], Path]) -> None:
    folder = copied(PLAIN)
    weights(lambda w: w.update({n: torch.cat([t, t[-3:]]) for n, t in w.items() if "embed_tokens" in n}))(folder)
    text_settings(vocab_size=454)(folder)
    expected = r"tokens .*, got 451 \(with 8 special tokens, as upstream before 2026-01-21"
    with pytest.raises(CheckpointError, match=expected):
        _ = load(PLAIN, folder).collator


def test_a_preprocessor_file_as_qwen_publishes_it_is_read(base: Path) -> None:
    """With few fields, where the references have all that transformers writes."""
    few = ("size", "patch_size", "temporal_patch_size", "merge_size", "image_mean", "image_std")
    in_json("preprocessor_config.json", lambda all: [all.pop(name) for name in [*all] if name not in few])(base)
    (expected,) = load_engine(PLAIN).evaluate([SAMPLE])
    assert_close(scores(goldens.config(PLAIN).checkpoint, PLAIN, base_model=str(base)), expected, 1e-6)


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


@pytest.mark.parametrize("name", ["q25_mean_l2", PLAIN])
def test_a_processor_of_transformers_5_reads_the_same(tmp_path: Path, name: str) -> None:
    config, base = goldens.config(name), tmp_path / "base"
    shutil.copytree(config.sources["base_model"], base, copy_function=shutil.copyfile)
    as_transformers_5_saves(base)
    load(name, base=str(base)).save(tmp_path / "saved")
    (expected,) = load_engine(name).evaluate([SAMPLE])
    for folder in (config.checkpoint, tmp_path / "saved"):
        assert_close(scores(folder, name, base_model=str(base)), expected, 1e-6)
    (base / "processor_config.json").write_text("{}")
    expected_told = (
        r"expected preprocessor_config\.json, or image_processor in processor_config\.json, got none .*--base-model"
    )
    with pytest.raises(CheckpointError, match=expected_told):
        _ = load(name, base=str(base)).collator


def test_fields_that_an_old_upstream_did_not_have_are_what_it_did(copied: Callable[[str], Path]) -> None:
    folder = copied("q25_video_last_l2")
    (folder / "config.yaml").write_text(
        "model: {base_model_id: some/base}\ndata: {resized_height: 56, resized_width: 84}\n"
    )
    config = load("q25_video_last_l2", folder).config
    truths = (config.multi_image, config.per_frame_progress_token, config.progress_in_preference)
    assert (*truths, config.average_temporal_patches) == (False, False, False, False)
    assert (config.frame_pooling, config.pooling_temperature, config.size_px) == ("mean", 1.0, (56, 84))
    assert (config.dtype, config.trained_frames) == ("bfloat16", None)


@pytest.mark.parametrize("name", [PLAIN, ADAPTER])
def test_without_config_yaml_nothing_is_guessed(copied: Callable[[str], Path], name: str) -> None:
    folder = copied(name)
    (folder / "config.yaml").unlink()
    with pytest.raises(CheckpointError, match=r"expected config\.yaml of the training run there, in the folder above"):
        load(name, folder)


@pytest.mark.parametrize("section", ["model", "data"])
def test_either_section_tells_how_frames_are_shown(copied: Callable[[str], Path], section: str) -> None:
    folder = copied(PLAIN)
    in_yaml(lambda run: [run[section].pop(key) for key in TWICE])(folder)
    assert load(PLAIN, folder).config == load(PLAIN).config


IGNORED = {
    "a size for images": (PLAIN, run("data", resized_height=112, resized_width=84)),
    "how images are pooled, for videos": (
        "q25_video_avg_disc10",
        run("model", frame_pooling="attention", frame_pooling_attn_temperature=0.01),
    ),
}


@pytest.mark.parametrize(("name", "change"), IGNORED.values(), ids=IGNORED)
def test_what_upstream_ignores_changes_no_score(copied: Callable[[str], Path], name: str, change: Spoil) -> None:
    folder = copied(name)
    change(folder)
    (expected,) = load_engine(name).evaluate([SAMPLE])
    assert_close(scores(folder, name), expected, 1e-6)


def test_clients_are_told_no_size_that_is_ignored(copied: Callable[[str], Path], tmp_path: Path) -> None:
    folder = copied(PLAIN)
    IGNORED["a size for images"][1](folder)
    rfm_export.export(folder, tmp_path / "repository", serve_config(goldens.config(PLAIN)))
    assert description_of(tmp_path / "repository" / "rfm_frames").frame_size is None


def test_the_processor_s_chat_template_wins_over_the_tokenizer_s(
    copied: Callable[[str], Path], base: Path, tmp_path: Path
) -> None:
    """Upstream prompts by the processor."""
    folder = copied(PLAIN)
    run("model", base_model_id="org/own-qwen3-vl")(folder)
    of_tokenizer = "{% for message in messages %}of the tokenizer{% endfor %}"
    settings("tokenizer_config.json", chat_template=of_tokenizer)(base)

    def prompt(to: str) -> str:
        template = str(load(PLAIN, folder, str(base)).collator.tokenizer.chat_template)
        load(PLAIN, folder, str(base)).save(tmp_path / to)
        assert families.load(tmp_path / to).collator.tokenizer.chat_template == template
        return template

    assert prompt("1") == json.loads((base / "chat_template.json").read_text())["chat_template"]
    (base / "chat_template.json").unlink()
    assert prompt("2") == of_tokenizer
    (base / "chat_template.jinja").write_text("of the processor, in its newer file")
    assert prompt("3") == "of the processor, in its newer file"


FEW_BITS = r"expected weights in full precision, got .*m\.dequantize\(\).* with --base-model$"
OTHER_BASES = {
    "Qwen/Qwen2.5-VL-7B-Instruct": r"expected Qwen/Qwen2\.5-VL-3B-Instruct, .*, got 'Qwen/Qwen2\.5-VL-7B-.*--base-model",
    "Qwen/Qwen2.5-VL-3B": r"expected Qwen/Qwen2\.5-VL-3B-Instruct, .*, got 'Qwen/Qwen2\.5-VL-3B'; .* --base-model",
    "/scratch/snapshots/66285546d2b821cf421d4f5eb2576359d3770cd3": r"expected Qwen/.*, got '/scratch/.*'; .* --base-model",
    "unsloth/qwen2.5-vl-3b-instruct-unsloth-bnb-4bit": FEW_BITS,
    "/models/Qwen2.5-VL-3B-Instruct-bnb-4bit/": FEW_BITS,
}
SAME_BASES = ("/scratch/models/Qwen2.5-VL-3B-Instruct/", "unsloth/qwen2.5-vl-3b-instruct-unsloth", None, "")


@pytest.mark.parametrize(("base_model", "message"), OTHER_BASES.items(), ids=OTHER_BASES)
def test_an_adapter_on_another_base_model_is_asked_about(
    copied: Callable[[str], Path], base_model: str, message: str
) -> None:
    folder = copied(ADAPTER)
    settings("adapter_config.json", base_model_name_or_path=base_model)(folder)
    with pytest.raises(CheckpointError, match=rf"/adapter_config\.json: base_model_name_or_path: {message}"):
        families.load(folder)
    assert load(ADAPTER, folder).config == load(ADAPTER).config  # which names --base-model


@pytest.mark.parametrize("base_model", SAME_BASES)
def test_an_adapter_s_base_model_under_another_name_is_that_of_its_run(
    copied: Callable[[str], Path], base_model: str | None
) -> None:
    folder = copied(ADAPTER)
    settings("adapter_config.json", base_model_name_or_path=base_model)(folder)
    with pytest.raises(CheckpointError, match=r"^base model Qwen/Qwen2\.5-VL-3B-Instruct: cannot be had"):
        families.load(folder)


def test_a_base_model_of_few_bits_is_refused(tmp_path: Path) -> None:
    base = shutil.copytree(
        goldens.config(ADAPTER).sources["base_model"], tmp_path / "base", copy_function=shutil.copyfile
    )
    settings("config.json", quantization_config={"quant_method": "bitsandbytes"})(base)
    expected = rf"base model {base}: config\.json: quantization_config: expected none, got 'bitsandbytes'; .*dequantize"
    with pytest.raises(CheckpointError, match=expected):
        load(ADAPTER, base=str(base))
