# SPDX-License-Identifier: MIT
"""LoRA adapters: which are taken and score as PEFT merges them, and which are refused."""

from __future__ import annotations

import json
import math
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from safetensors.torch import load_file, save_file

import few_bits
import goldens
from paths import GOLDEN
from rfm import published
from rfm.files import CheckpointError
from spoilt import Spoil, beside, both, in_yaml, renamed, run_settings, settings, weights, with_sources
from vlm import PLAIN, load

ADAPTER = "q25_peft_adapter_disc10"
LORA_INSIDE = "q3_lora_full_disc10"
CONFIG, FACTORS = "adapter_config.json", "adapter_model.safetensors"
WRITTEN: dict[str, dict[str, Any]] = json.loads((GOLDEN / "peft-configs.json").read_text())
EMBEDDING = "base_model.model.language_model.embed_tokens"
Tensors = dict[str, Any]


def written(name: str) -> Spoil:
    """Gives an adapter the configuration that PEFT wrote."""
    return lambda folder: (folder / CONFIG).write_text(json.dumps(WRITTEN[name]))


def in_adapter(change: Callable[[Tensors], object]) -> Spoil:
    return weights(change, FACTORS)


def lost(pattern: str, file: str = FACTORS, **config: Any) -> Spoil:
    """Removes the factors of modules with matching names. config: changes of the adapter's configuration"""

    def lose(tensors: Tensors) -> None:
        for name in [*tensors]:
            if ".lora_" in name and re.search(pattern, name):
                del tensors[name]

    return both(weights(lose, file), settings(CONFIG, **config)) if config else weights(lose, file)


def factors_twice(tensors: Tensors) -> None:
    """Write PiSSA factors as PEFT does, beside the initial factors, which are 0 here."""
    for name in [name for name in tensors if ".lora_A." in name]:
        other = name.replace("lora_A", "lora_B")
        tensors[name] = torch.cat([tensors[name], tensors[name]])
        tensors[other] = torch.cat([tensors[other], 0 * tensors[other]], 1)


def beside_its_adapter(folder: Path) -> None:
    """Write a LoRA run as upstream does since pull request 25."""
    tensors = load_file(folder / "model.safetensors")
    adapter = {
        f"base_model.model.{name.split('.base_model.model.')[1].replace('.default.', '.')}": tensor
        for name, tensor in tensors.items()
        if ".lora_" in name
    }
    save_file(adapter, folder / FACTORS)
    heads = {name: tensor for name, tensor in tensors.items() if not name.startswith("model.")}
    save_file(heads, folder / "custom_heads.safetensors")
    shutil.copy(goldens.config(ADAPTER).checkpoint / CONFIG, folder)
    (folder / "peft_target_module.json").write_text('{"target_module": "language_model", "adapter_dir": "."}')


def on_a_published_base(names: tuple[str, str]) -> Spoil:
    """Divides a run into an adapter and a base model. names: pattern and replacement for those of the base model"""

    def divide(folder: Path) -> None:
        beside_its_adapter(folder)
        tensors = load_file(folder / "model.safetensors")
        base = {
            re.sub(*names, name.replace(".base_model.model.", ".").replace(".base_layer.", ".")): tensor
            for name, tensor in tensors.items()
            if name.startswith("model.") and ".lora_" not in name
        }
        save_file(base, folder.parent / "base_model" / "model.safetensors", {"format": "pt"})
        embedding = tensors["model.language_model.base_model.model.embed_tokens.weight"]
        in_adapter(lambda adapter: adapter.update({"base_model.model.embed_tokens.weight": embedding}))(folder)
        for name in ("model.safetensors", "config.json", "peft_target_module.json"):
            (folder / name).unlink()

    return divide


def with_lora_of_the_language_head(folder: Path) -> None:
    shapes = {"base_layer": (32, 32), "lora_A.default": (4, 32), "lora_B.default": (32, 4)}
    more = {f"model.lm_head.{name}.weight": torch.ones(shape) for name, shape in shapes.items()}
    weights(lambda tensors: tensors.update(more))(folder)


def in_the_newest_form(folder: Path) -> None:
    """Fields that no PEFT of this environment knows, without effect."""
    unset = {"velora_2": None, "later_config": {}, "later_pattern": [], "use_later": False}
    settings(CONFIG, **unset, peft_version="9.0", ensure_weight_tying=True)(folder)


PLAIN_LORA = [name for name in WRITTEN if name.startswith("LoRA")]
SAME: dict[str, tuple[str, Spoil]] = {
    **{name: (ADAPTER, written(name)) for name in PLAIN_LORA},
    "with fields of another PEFT": (ADAPTER, in_the_newest_form),
    "PiSSA converted to LoRA": (ADAPTER, both(in_adapter(factors_twice), written("PiSSA converted to LoRA"))),
    "around the language model": (ADAPTER, renamed(r"^base_model\.model\.language_model\.", "base_model.model.", FACTORS)),
    "around the whole model": (LORA_INSIDE, renamed(r"^model\.language_model\.base_model\.model\.", "model.base_model.model.language_model.")),
    "beside the whole model": (LORA_INSIDE, beside_its_adapter),
    "on a Qwen3-VL with a language head": (LORA_INSIDE, on_a_published_base(("^$", ""))),
    "on a Qwen3-VL without a language head": (LORA_INSIDE, on_a_published_base((r"^model\.", ""))),
    "of the language head, too": (LORA_INSIDE, with_lora_of_the_language_head),
}  # fmt: skip


@pytest.mark.parametrize(("name", "change"), SAME.values(), ids=SAME)
def test_lora_in_another_form_gives_the_same_weights(tmp_path: Path, name: str, change: Spoil) -> None:
    known = load(name).build(torch.float32).state_dict()
    folder, options = with_sources(name, tmp_path)
    change(folder)
    same = load(name, folder, options["base_model"]).build(torch.float32).state_dict()
    assert same.keys() == known.keys()
    for key, weight in same.items():
        torch.testing.assert_close(weight, known[key], rtol=0, atol=1e-7)


def test_a_base_model_in_nf4_is_decoded(tmp_path: Path) -> None:
    built = []
    for form in ("nf4", "decoded"):
        folder, options = with_sources(ADAPTER, tmp_path / form)
        base = Path(options["base_model"])
        tensors = {}
        for name, tensor in load_file(base / "model.safetensors").items():
            parts, values = few_bits.rounded(name, tensor) if "_proj.weight" in name else ({name: tensor}, tensor)
            tensors |= parts if form == "nf4" else {name: values.to(tensor.dtype)}
        save_file(tensors, base / "model.safetensors", {"format": "pt"})
        if form == "nf4":
            few_bits.change_config(base, "nf4")
        built.append(load(ADAPTER, folder, str(base)).build(torch.float32).state_dict())
    assert all(torch.equal(weight, built[1][name]) for name, weight in built[0].items())


def test_updates_too_small_for_bfloat16_are_not_lost(tmp_path: Path) -> None:
    folder, _ = with_sources(LORA_INSIDE, tmp_path)
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


def test_factors_in_bfloat16_are_scaled_in_float32(tmp_path: Path) -> None:
    folder, options = with_sources(ADAPTER, tmp_path)
    in_adapter(
        lambda tensors: tensors.update({name: each.bfloat16() for name, each in tensors.items() if ".lora_" in name})
    )(folder)
    settings(CONFIG, lora_alpha=1.2)(folder)
    (name,) = [
        name
        for name in load_file(folder / FACTORS)
        if re.search(r"language_model\.layers\.1\.self_attn\.q_proj\.lora_B", name)
    ]
    written = load_file(folder / FACTORS)[name]
    read = load(ADAPTER, folder, options["base_model"]).factors[
        "model.language_model.layers.1.self_attn.q_proj.lora_B.weight"
    ]
    torch.testing.assert_close(read, 1.2 / 4 * written.float(), rtol=1e-6, atol=0)


def test_the_scaling_of_each_module_is_peft_s(tmp_path: Path) -> None:
    built = []
    for name in ("LoRA", "rsLoRA", "alphas of modules"):
        folder, options = with_sources(ADAPTER, tmp_path / name)
        written(name)(folder)
        built.append(load(ADAPTER, folder, options["base_model"]).factors)
    plain, root, alphas = built
    for name, factor in plain.items():
        is_b = "lora_B" in name
        torch.testing.assert_close(root[name], factor * (2 if is_b else 1), rtol=1e-6, atol=0)  # 8 / sqrt(4), not 8 / 4
        torch.testing.assert_close(alphas[name], factor * (2 if is_b and "q_proj" in name else 1), rtol=1e-6, atol=0)


KINDS = "q_proj|k_proj|v_proj|o_proj|gate_proj|up_proj|down_proj"
OF_TEXT = rf"(?:.*?(?:language|text).*?(?:self_attn|mlp).*?(?:{KINDS}).*?)"  # as Unsloth writes it
WHOLLY: dict[str, tuple[str, dict[str, Any]]] = {
    "one of two layers": (r"\.1\.", {"layers_to_transform": [0]}),
    "a layer by its number": (r"\.1\.", {"layers_to_transform": 0}),
    "one layer behind a name": (r"layers\.1|blocks", {"layers_to_transform": [0], "layers_pattern": ["layers"]}),
    "a pattern": ("visual", {"target_modules": OF_TEXT}),
    "all but some": ("visual", {"exclude_modules": r"visual\..*"}),
    "all but some by name": ("up_proj", {"exclude_modules": ["up_proj"]}),
    "modules by their whole names": (
        r"\.1\.|blocks|self_attn|(gate|down)_proj",
        {"target_modules": ["language_model.layers.0.mlp.up_proj"]},
    ),
    "an embedding saved whole": ("^$", {"modules_to_save": ["embed_tokens"]}),
}


@pytest.mark.parametrize(("pattern", "config"), WHOLLY.values(), ids=WHOLLY)
def test_an_adapter_of_some_modules_is_taken(tmp_path: Path, pattern: str, config: dict[str, Any]) -> None:
    folder, _ = with_sources(ADAPTER, tmp_path)
    lost(pattern, **config)(folder)
    taken = load(ADAPTER, folder)
    assert taken.factors
    assert not [name for name in taken.factors if re.search(pattern, name)]


def first(part: str, change: Callable[[torch.Tensor], torch.Tensor] | None) -> Callable[[Tensors], object]:
    """Changes the first tensor with ``part`` in the name. change: None removes it"""

    def spoil(tensors: Tensors) -> None:
        name = next(name for name in tensors if part in name)
        tensor = tensors.pop(name)
        tensors.update({} if change is None else {name: change(tensor).contiguous()})

    return spoil


def of_a_convolution(tensors: Tensors) -> None:
    shapes = {"A": (4, 3, 2, 14, 14), "B": (32, 4, 1, 1, 1)}
    tensors.update(
        {f"base_model.model.visual.patch_embed.proj.lora_{s}.weight": torch.ones(n) for s, n in shapes.items()}
    )


def of_the_embedding(tensors: Tensors) -> None:
    tensors[f"{EMBEDDING}.base_layer.weight"] = tensors.pop(f"{EMBEDDING}.weight")
    tensors |= {f"{EMBEDDING}.lora_embedding_A": torch.ones(4, 9), f"{EMBEDDING}.lora_embedding_B": torch.ones(9, 4)}


def with_the_embedding_twice(tensors: Tensors) -> None:
    """Write what PEFT's save_embedding_layers=True gives if modules_to_save names the embedding."""
    tensors.update({f"{EMBEDDING}.{name}.weight": torch.ones(9, 9) for name in ("original_module", "modules_to_save")})


def widen(tensors: Tensors) -> None:
    """Make a product that would take terabytes."""
    name = next(name for name in tensors if ".lora_A." in name)
    tensors |= {name: torch.zeros(4, 2**20), name.replace("lora_A", "lora_B"): torch.zeros(2**20, 4)}


def of_another_rank(tensors: Tensors) -> None:
    names = [name for name in tensors if "layers.1.mlp.up_proj.lora_" in name]
    tensors.update({name: torch.cat([tensors[name]] * 2, 0 if "_A" in name else 1) for name in names})


def empty(name: str) -> Spoil:
    return lambda folder: save_file({"any": torch.zeros(1)}, folder / name)


Q_PROJ = "model.language_model.layers.{}.self_attn.q_proj"
MERGE = r".*; merge it where it was trained \(merge_and_unload\(\) of PEFT\)"
LOST = r"expected LoRA factors of each module that was trained, got none for \[.*"
LINEAR = rf"{FACTORS}: expected LoRA factors of linear layers of a Qwen backbone, got ".replace(".", r"\.")
QWEN = "Qwen/Qwen2.5-VL-3B-Instruct"
ANOTHER_BASE = rf"base_model_name_or_path: expected {re.escape(QWEN)}, .*, got 'NAME'; .* --base-model"
REFUSED: dict[str, tuple[str, Spoil, str]] = {
    **{
        name: (ADAPTER, written(name), rf"adapter_config\.json: {message}{MERGE}")
        for name, message in {
            "DoRA": r"expected plain LoRA, got use_dora",
            "PiSSA": r"init_lora_weights: expected true, got 'pissa', which may change the base model's weights before",
            "PiSSA by iteration": r"init_lora_weights: expected true, got 'pissa_niter_4'",
            "OLoRA": r"init_lora_weights: expected true, got 'olora'",
            "EVA": r"expected plain LoRA, got eva_config",
            "MiCA": r"init_lora_weights: expected true, got 'mica'",
            "biases of all": r"bias: expected none, got 'all', which PEFT does not always save",
            "biases of factors": r"expected plain LoRA, got lora_bias",
            "aLoRA": r"expected plain LoRA, got alora_invocation_tokens",
            "rows of an embedding": r"expected plain LoRA, got trainable_token_indices",
            "parameters": r"expected plain LoRA, got target_parameters",
        }.items()
    },
    "a field of the future": (ADAPTER, settings(CONFIG, use_newlora=True), r"expected plain LoRA, got use_newlora"),
    "no LoRA": (ADAPTER, settings(CONFIG, peft_type="IA3", r=None), r"peft_type: expected LORA, got 'IA3'"),
    "an embedding": (ADAPTER, in_adapter(of_the_embedding), rf"{LINEAR}'model\.language_model\.embed_tokens\.lora_embedding_A'{MERGE}"),
    "an embedding saved in two ways": (ADAPTER, in_adapter(with_the_embedding_twice), rf"{LINEAR}'model\.language_model\.embed_tokens\."),
    "a convolution": (ADAPTER, in_adapter(of_a_convolution), r"expected the modules with LoRA factors, got a configuration without \['model\.visual\.patch_embed\.proj'\]"),
    "a huge product": (ADAPTER, in_adapter(widen), r"expected LoRA factors of \[\d+, \d+\], got \[1048576, 4\] and \[4, 1048576\]"),
    "lost: a module": (ADAPTER, lost(r"layers\.1\.self_attn\.q_proj"), rf"adapter_config\.json: {LOST}'{Q_PROJ.format(1)}'\]: these modules would"),
    "lost: a kind of module": (ADAPTER, lost("q_proj"), rf"{LOST}'{Q_PROJ.format(0)}', '{Q_PROJ.format(1)}'\]"),
    "lost: the vision tower": (ADAPTER, lost("visual"), rf"{LOST}'model.visual.blocks.0.mlp.down_proj', "),
    "lost: all factors": (ADAPTER, lost(""), rf"{LOST}'model.language_model.layers.0.mlp.down_proj', "),
    "lost: a layer of those chosen": (ADAPTER, lost(r"\.1\.", layers_to_transform=[0, 1]), rf"{LOST}'{Q_PROJ.format(1)}'"),
    "lost: a module of a pattern": (ADAPTER, lost(r"visual|layers\.0.*q_proj", target_modules=OF_TEXT), rf"{LOST}'{Q_PROJ.format(0)}'\]"),
    "lost: linear layers": (ADAPTER, lost("^$", target_modules="all-linear"), rf"{LOST}'model.visual.blocks.0.attn.proj', "),
    "no module is named": (ADAPTER, settings(CONFIG, target_modules=None), r"expected a configuration that PEFT applies, got ValueError: Please specify"),
    "lost: a module saved whole": (ADAPTER, settings(CONFIG, modules_to_save=["merger"]), r"modules_to_save: expected the weights of each module, got none for \['model\.visual\.merger\.ln_q\.weight'"),
    "lost: factors among whole weights": (LORA_INSIDE, lost(r"layers\.1\.mlp\.up_proj", "model.safetensors"), rf"model\.safetensors: {LOST}layers\.1\.mlp"),
    "lost: all factors among whole weights": (LORA_INSIDE, lost("", "model.safetensors"), rf"model\.safetensors: {LOST}layers\.1\.mlp"),
    "no alpha": (LORA_INSIDE, in_yaml(lambda content: content["peft"].pop("lora_alpha")), r"expected lora_alpha and r of the LoRA weights"),
    "half a pair": (LORA_INSIDE, weights(first("lora_B", None)), r"expected a weight and LoRA factors A and B, got \['A'\]"),
    "factors of two ranks": (LORA_INSIDE, weights(first("lora_B", lambda b: b[:, :-1])), r"expected LoRA factors of one rank, got \[\d+, 3\] and \[4, \d+\]"),
    "a run of another rank": (LORA_INSIDE, run_settings("peft", r=32), r"config\.yaml: r: expected 4, the rows of .*lora_A, got 32; put in r"),
    "a module of another rank": (LORA_INSIDE, weights(of_another_rank), r"r: expected 8, the rows of model\.language_model\.layers\.1\.mlp\.up_proj\.lora_A, got 4"),
    "a run and an adapter that disagree": (LORA_INSIDE, both(beside_its_adapter, settings(CONFIG, lora_alpha=16)), r"adapter_config\.json: expected r 4 and lora_alpha 8, as .*config\.yaml has it, got r 4 and lora_alpha 16; mend the wrong one"),
    "a pattern of no module": (ADAPTER, settings(CONFIG, alpha_pattern={"^layers.0": 16}), r"adapter_config\.json: alpha_pattern: expected a pattern that matches a module, got '\^layers\.0'; remove it"),
    **{
        f"no pattern: {field}": (ADAPTER, settings(CONFIG, **{field: value}), rf"adapter_config\.json: {field}: expected a pattern of names, got '\(q_proj': .*; write the names")
        for field, value in {"target_modules": "(q_proj", "exclude_modules": "(q_proj", "rank_pattern": {"(q_proj": 4}, "alpha_pattern": {"(q_proj": 4}}.items()
    },
    **{
        f"patterns for names: {field}": (ADAPTER, settings(CONFIG, **{"layers_to_transform": [0], field: [".*"]}), rf"{field}: expected names of modules, got '\.\*'")
        for field in ("layers_pattern", "modules_to_save")
    },
    **{
        f"alpha: {alpha}": (ADAPTER, settings(CONFIG, lora_alpha=alpha), rf"adapter_config\.json: expected lora_alpha and r of the LoRA weights, got lora_alpha {re.escape(repr(alpha))} and r 4")
        for alpha in (math.inf, math.nan, True, "8")
    },
    "an alpha of a module in words": (ADAPTER, settings(CONFIG, alpha_pattern={"q_proj": "8"}), r"alpha_pattern: expected finite numbers, got '8'"),
    "a base model of 8 bits": (ADAPTER, beside("base_model", weights(first("q_proj", lambda w: w.to(torch.float8_e4m3fn)))), r"base_model/model\.safetensors: expected a safetensors file, got '.*q_proj.*' of type 'F8_E4M3', which is none of"),
    "an adapter and whole weights": (ADAPTER, empty("model.safetensors"), r"expected an adapter \(adapter_config\.json\) or whole weights \(model\.safetensors\), got both"),
    "whole weights and an adapter without its configuration": (PLAIN, empty(FACTORS), r"expected an adapter \(adapter_model\.safetensors\) or whole weights \(model\.safetensors\), got both"),
    "no embedding": (ADAPTER, in_adapter(first("embed_tokens", None)), r"expected the embedding of the special tokens, got none: their rows .* are lost .*save_embedding_layers=True"),
    "an adapter of another model": (ADAPTER, in_adapter(lambda w: w.update({"base_model.model.other.weight": torch.zeros(1)})), r"got also \['model.other.weight'\]"),
    "a base model whole and in shards": (ADAPTER, beside("base_model", lambda f: (f / "model.safetensors.index.json").write_text('{"weight_map": {}}')), r"/base_model: expected model\.safetensors or shards, got model\.safetensors and"),
    "a base model of few bits": (ADAPTER, beside("base_model", settings("config.json", quantization_config={"quant_method": "bitsandbytes"})), r"base model .*: config\.json: quantization_config: expected none, got 'bitsandbytes'; .*dequantize"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "spoil", "message"), REFUSED.values(), ids=REFUSED)
def test_an_adapter_that_would_score_otherwise_is_refused(
    tmp_path: Path, name: str, spoil: Spoil, message: str
) -> None:
    folder, options = with_sources(name, tmp_path)
    spoil(folder)
    with pytest.raises(CheckpointError, match=message):
        load(name, folder, options["base_model"]).build()


def test_patterns_are_matched_in_bounded_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, options = with_sources(ADAPTER, tmp_path)
    settings(CONFIG, target_modules="(a|b|ab)*c")(folder)
    late = mock.Mock(fullmatch=mock.Mock(side_effect=TimeoutError("regex timed out")))
    monkeypatch.setattr("regex.compile", lambda pattern: late)
    expected = r"target_modules: expected a pattern of names, got '\(a\|b\|ab\)\*c': regex timed out; write the names"
    with pytest.raises(CheckpointError, match=expected):
        load(ADAPTER, folder, options["base_model"])
    assert 0 < late.fullmatch.call_args.kwargs["timeout"] <= 5


@pytest.mark.parametrize("pattern", ["^layers\\.0\\.mlp", "layers\\.0\\.mlp"])
def test_patterns_among_whole_weights_begin_where_peft_s_do(tmp_path: Path, pattern: str) -> None:
    """PEFT wrapped the language model, whose names begin with layers."""
    folder, _ = with_sources(LORA_INSIDE, tmp_path)
    beside_its_adapter(folder)
    settings(CONFIG, alpha_pattern={rf"{pattern}\.\w+": 16, r"\w+_proj": 8})(folder)
    plain, changed = load(LORA_INSIDE).factors, load(LORA_INSIDE, folder).factors
    for name, factor in plain.items():
        times = 2 if "layers.0.mlp" in name and "lora_B" in name else 1
        torch.testing.assert_close(changed[name], factor * times, rtol=1e-6, atol=0)


def test_missing_peft_is_named_with_the_extra_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "peft", None)
    with pytest.raises(ImportError, match=r'LoRA needs PEFT: pip install "\.\[vlm\]" \(.*peft'):
        load(ADAPTER)


BASES = {
    "Qwen/Qwen2.5-VL-7B-Instruct": ANOTHER_BASE.replace("NAME", "Qwen/Qwen2.5-VL-7B-Instruct"),
    "/scratch/snapshots/66285546d2b821cf421d4f5eb2576359d3770cd3": ANOTHER_BASE.replace("NAME", "/scratch/.*"),
    **{
        few_bits: rf"^base model {few_bits}: cannot be had"  # the adapter's, on which it was trained
        for few_bits in ("unsloth/qwen2.5-vl-3b-instruct-unsloth-bnb-4bit", "/models/Qwen2.5-VL-3B-Instruct-bnb-4bit/")
    },
    **dict.fromkeys(
        ("/scratch/models/Qwen2.5-VL-3B-Instruct/", "unsloth/qwen2.5-vl-3b-instruct-unsloth", None, ""),
        rf"^base model {re.escape(QWEN)}: cannot be had",  # the run's, without the network
    ),
}


@pytest.mark.parametrize(("base_model", "message"), BASES.items(), ids=[*map(repr, BASES)])
def test_an_adapter_on_another_base_model_needs_its_option(
    tmp_path: Path, base_model: str | None, message: str
) -> None:
    folder, _ = with_sources(ADAPTER, tmp_path)
    settings(CONFIG, base_model_name_or_path=base_model)(folder)
    with pytest.raises(CheckpointError, match=message):
        published.load(folder)
    assert load(ADAPTER, folder).config == load(ADAPTER).config


@pytest.mark.filterwarnings("ignore:.*is deprecated:FutureWarning")  # PEFT 0.21 with transformers 5.24
@pytest.mark.parametrize("targets", [["q_proj", "down_proj"], ["qkv", "v_proj"]], ids=["text", "text and tower"])
def test_an_adapter_of_the_newest_peft_is_merged_as_peft_does(tmp_path: Path, targets: list[str]) -> None:
    """With the transformers beside it. ``make test-newest`` has both."""
    peft = pytest.importorskip("peft", reason="make test-newest installs it")
    transformers = pytest.importorskip("transformers")
    config, base, adapter = goldens.config("q3_tok_disc10"), tmp_path / "base", tmp_path / "adapter"
    shutil.copytree(config.base_model, base)
    content = json.loads((base / "config.json").read_text()) | {"tie_word_embeddings": True}
    content["text_config"] |= {"tie_word_embeddings": True}
    run = load_file(config.checkpoint / "model.safetensors")
    num_tokens = next(len(rows) for name, rows in run.items() if name.endswith("embed_tokens.weight"))
    whole = transformers.Qwen3VLForConditionalGeneration(transformers.Qwen3VLConfig.from_dict(content))
    whole.save_pretrained(base)
    whole.resize_token_embeddings(num_tokens)
    settings = peft.LoraConfig(r=4, lora_alpha=8, target_modules=targets, init_lora_weights=False)
    wrapped = peft.get_peft_model(whole.model, settings)
    wrapped.save_pretrained(adapter, save_embedding_layers=True)
    shutil.copy(config.checkpoint / "config.yaml", adapter)
    save_file(
        {name: each for name, each in run.items() if not name.startswith("model.")},
        adapter / "custom_heads.safetensors",
    )
    built = published.load(adapter, base_model=str(base)).build(torch.float32).state_dict()
    merged = wrapped.merge_and_unload().state_dict()
    for name, expected in merged.items():
        torch.testing.assert_close(built[f"model.{name}"], expected, rtol=0, atol=1e-6)
