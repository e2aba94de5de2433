# SPDX-License-Identifier: MIT
"""The forms in which checkpoints are saved: files as PEFT writes them, and a test for each form."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import goldens
from paths import GOLDEN
from rfm.families import CheckpointError
from spoilt import copied, settings, weights
from vlm import load

ADAPTER = "q25_peft_adapter_disc10"
LORA_INSIDE = "q3_lora_full_disc10"
WRITTEN: dict[str, dict[str, Any]] = json.loads((GOLDEN / "peft-configs.json").read_text())
MERGE = r"; merge it where it was trained \(merge_and_unload\(\) of PEFT\)"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the reference adapter."""
    return shutil.copytree(goldens.config(ADAPTER).checkpoint, tmp_path / "adapter", copy_function=shutil.copyfile)


def factors_twice(tensors: dict[str, Any]) -> None:
    """Write PiSSA factors as PEFT does, beside the initial factors, which are 0 here."""
    for name in [name for name in tensors if ".lora_A." in name]:
        other = name.replace("lora_A", "lora_B")
        tensors[name] = torch.cat([tensors[name], tensors[name]])
        tensors[other] = torch.cat([tensors[other], 0 * tensors[other]], 1)


def changed(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    weights(change, "adapter_model.safetensors")(folder)


PLAIN = [name for name in WRITTEN if name.startswith("LoRA")]
CONVERTED = "PiSSA converted to LoRA"


@pytest.mark.parametrize("name", [*PLAIN, CONVERTED])
def test_plain_lora_of_peft_is_taken(folder: Path, name: str) -> None:
    known = load(ADAPTER).build(torch.float32).state_dict()
    if name == CONVERTED:
        changed(folder, factors_twice)
    (folder / "adapter_config.json").write_text(json.dumps(WRITTEN[name]))
    taken = load(ADAPTER, folder).build(torch.float32).state_dict()
    for key, weight in taken.items():
        torch.testing.assert_close(weight, known[key], rtol=0, atol=1e-7)


REFUSED = {
    "rsLoRA": r"expected plain LoRA, got use_rslora",
    "DoRA": r"expected plain LoRA, got use_dora",
    "PiSSA": r"init_lora_weights: expected true, got 'pissa', which may change the base model's weights before training",
    "PiSSA by iteration": r"init_lora_weights: expected true, got 'pissa_niter_4'",
    "OLoRA": r"init_lora_weights: expected true, got 'olora'",
    "EVA": r"expected plain LoRA, got eva_config",
    "MiCA": r"init_lora_weights: expected true, got 'mica'",
    "ranks of modules": r"expected plain LoRA, got rank_pattern",
    "alphas of modules": r"expected plain LoRA, got alpha_pattern",
    "biases of all": r"bias: expected none, got 'all', which PEFT does not always save",
    "biases of factors": r"expected plain LoRA, got lora_bias",
    "aLoRA": r"expected plain LoRA, got alora_invocation_tokens",
    "rows of an embedding": r"expected plain LoRA, got trainable_token_indices",
    "parameters": r"expected plain LoRA, got target_parameters",
}


@pytest.mark.parametrize(("name", "message"), REFUSED.items(), ids=REFUSED)
def test_other_adapters_of_peft_are_refused(folder: Path, name: str, message: str) -> None:
    (folder / "adapter_config.json").write_text(json.dumps(WRITTEN[name]))
    with pytest.raises(CheckpointError, match=rf"adapter_config\.json: {message}.*{MERGE}"):
        load(ADAPTER, folder)


EMBEDDING = "base_model.model.language_model.embed_tokens"


def on_a_convolution(tensors: dict[str, Any]) -> None:
    shapes = {"A": (4, 3, 2, 14, 14), "B": (32, 4, 1, 1, 1)}
    tensors.update(
        {f"base_model.model.visual.patch_embed.proj.lora_{side}.weight": torch.ones(s) for side, s in shapes.items()}
    )


def on_the_embedding(tensors: dict[str, Any]) -> None:
    tensors[f"{EMBEDDING}.base_layer.weight"] = tensors.pop(f"{EMBEDDING}.weight")
    tensors |= {f"{EMBEDDING}.lora_embedding_A": torch.ones(4, 9), f"{EMBEDDING}.lora_embedding_B": torch.ones(9, 4)}


def with_the_embedding_twice(tensors: dict[str, Any]) -> None:
    """Write what PEFT's save_embedding_layers=True gives if modules_to_save names the embedding."""
    copies = {f"{EMBEDDING}.{name}.weight": torch.ones(9, 9) for name in ("original_module", "modules_to_save")}
    tensors.update(copies)


LINEAR = r"adapter_model\.safetensors: expected LoRA factors of linear layers of a Qwen backbone, got "
OTHER_LAYERS: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "an embedding": (on_the_embedding, rf"{LINEAR}'model\.language_model\.embed_tokens\.lora_embedding_A'"),
    "an embedding saved in two ways": (with_the_embedding_twice, rf"{LINEAR}'model\.language_model\.embed_tokens\."),
    "a convolution": (
        on_a_convolution,
        r"patch_embed\.proj: expected LoRA factors of \[.*\], got \[32, 4, 1, 1, 1\] and",
    ),
}


@pytest.mark.parametrize(("change", "message"), OTHER_LAYERS.values(), ids=OTHER_LAYERS)
def test_lora_of_other_layers_is_refused(folder: Path, change: Callable[[dict[str, Any]], None], message: str) -> None:
    changed(folder, change)
    with pytest.raises(CheckpointError, match=rf"{message}.*{MERGE}"):
        load(ADAPTER, folder)


def lost(pattern: str) -> Callable[[dict[str, Any]], None]:
    """Remove the factors of modules with matching names."""

    def lose(tensors: dict[str, Any]) -> None:
        for name in [*tensors]:
            if ".lora_" in name and re.search(pattern, name):
                del tensors[name]

    return lose


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
def test_an_adapter_of_some_modules_is_taken(folder: Path, pattern: str, config: dict[str, Any]) -> None:
    changed(folder, lost(pattern))
    settings("adapter_config.json", **config)(folder)
    taken = load(ADAPTER, folder)
    assert taken.factors
    assert not [name for name in taken.factors if re.search(pattern, name)]


Q_PROJ = "model.language_model.layers.{}.self_attn.q_proj"
LOST: dict[str, tuple[str, dict[str, Any], str]] = {
    "a module": (r"layers\.1\.self_attn\.q_proj", {}, f"got none for ['{Q_PROJ.format(1)}']: these modules would"),
    "a kind of module": ("q_proj", {}, f"got none for ['{Q_PROJ.format(0)}', '{Q_PROJ.format(1)}']"),
    "a layer": (r"layers\.1\.", {}, f"'{Q_PROJ.format(1)}', 'model.language_model.layers.1.self_attn.v_proj']"),
    "the vision tower": ("visual", {}, "got none for ['model.visual.blocks.0.mlp.down_proj', "),
    "all factors": ("", {}, "got none for ['model.language_model.layers.0.mlp.down_proj', "),
    "a layer of those chosen": (r"\.1\.", {"layers_to_transform": [0, 1]}, f"'{Q_PROJ.format(1)}'"),
    "a module of a pattern": (r"visual|layers\.0.*q_proj", {"target_modules": OF_TEXT}, f"got none for ['{Q_PROJ.format(0)}']"),
    "linear layers": ("^$", {"target_modules": "all-linear"}, "got none for ['model.visual.blocks.0.attn.proj', "),
    "a layer, if no module is named": (r"layers\.1\.self_attn\.q_proj", {"target_modules": None}, f"['{Q_PROJ.format(1)}']"),
}  # fmt: skip


@pytest.mark.parametrize(("pattern", "config", "message"), LOST.values(), ids=LOST)
def test_an_adapter_that_lost_factors_is_refused(
    folder: Path, pattern: str, config: dict[str, Any], message: str
) -> None:
    changed(folder, lost(pattern))
    settings("adapter_config.json", **config)(folder)
    expected = "adapter_config.json: expected LoRA factors of each module that was trained, got none for "
    with pytest.raises(CheckpointError, match=re.escape(expected)) as refusal:
        load(ADAPTER, folder)
    assert message in str(refusal.value)


def test_an_adapter_that_lost_a_module_saved_whole_is_refused(folder: Path) -> None:
    settings("adapter_config.json", modules_to_save=["merger"])(folder)
    expected = (
        r"modules_to_save: expected the weights of each module, got none for \['model\.visual\.merger\.ln_q\.weight'"
    )
    with pytest.raises(CheckpointError, match=expected):
        load(ADAPTER, folder)


@pytest.mark.parametrize("pattern", [r"layers\.1\.mlp\.up_proj", "up_proj", ""])
def test_whole_weights_that_lost_factors_are_refused(tmp_path: Path, pattern: str) -> None:
    folder = copied(goldens.config(LORA_INSIDE), tmp_path / "whole")
    weights(lost(pattern))(folder)
    expected = (
        r"model\.safetensors: expected LoRA factors of each module that was trained, got none for \[.*layers\.1\.mlp"
    )
    with pytest.raises(CheckpointError, match=expected):
        load(LORA_INSIDE, folder)
