# SPDX-License-Identifier: MIT
"""LoRA adapters: PEFT says which modules have factors, of which rank and scaling.

A module is the name of its weight without ``.weight``, under VlmRewardModel's names.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rfm.files import (
    ADAPTER_CONFIG,
    ADAPTER_WEIGHTS,
    NETWORK_CONFIG,
    WEIGHTS,
    WEIGHTS_INDEX,
    CheckpointError,
    cut,
    expecting,
    is_there,
    listed,
    local_copy,
    read_json,
    read_tensors,
    shown,
)
from rfm.published.qwen import (
    ADAPTER_NAMES,
    NF4,
    QWEN_NAMES,
    UNQUANTIZED,
    backbone_config,
    check_not_quantized,
    quantization,
    renamed,
)
from rfm.published.rounding import dequantize
from rfm.published.weights import read_weights, refuse_pickles
from rfm.qwen.lora import BASE_LAYER, LORA_NAME, MERGE, module_of
from rfm.qwen.network import BackboneConfig, build_backbone

WHOLE, TEXT = "model.", "model.language_model."  # what PEFT wraps
# Factor initialisations that do not change the base model's weights.
_PLAIN_INITS = (True, False, "gaussian", "orthogonal")
# Fields of a LoRA configuration with which a weight is W + scaling * B A. Any other field, if set, may change this.
_PLAIN = {
    "alpha_pattern", "auto_mapping", "base_model_name_or_path", "bias", "ensure_weight_tying", "exclude_modules",
    "inference_mode", "init_lora_weights", "layers_pattern", "layers_to_transform", "lora_alpha", "lora_dropout",
    "megatron_core", "modules_to_save", "peft_type", "peft_version", "qalora_group_size", "r", "rank_pattern",
    "revision", "runtime_config", "target_modules", "task_type", "use_rslora",
}  # fmt: skip
_OF_UPSTREAM = {"peft_vision_encoder"}  # upstream's field in config.yaml


def scaled(
    tensors: Mapping[str, Tensor], file: Path, config: Mapping[str, Any], backbone: dict[str, Any], root: str = WHOLE
) -> dict[str, Tensor]:
    """Return the tensors, with PEFT's scaling of each module in its LoRA factor B.

    file: states ``config``, the adapter's configuration
    root: prefix for the modules that PEFT wrapped
    Raises CheckpointError unless the factors are those of the modules that the configuration names.
    """
    factors = {name: tensor for name, tensor in tensors.items() if LORA_NAME.fullmatch(name)}
    present = set(map(module_of, factors))
    layers = _layers(file, config, backbone, root)
    check_none_lost(file, layers.keys() - present)
    if more := sorted(present - layers.keys()):
        raise CheckpointError.at(file, "the modules with LoRA factors", f"a configuration without {listed(more)}")
    found = {**tensors}
    for name, factor in factors.items():
        layer = layers[module_of(name)]
        rank, scale = layer.r["default"], layer.scaling["default"]
        if name.endswith(("lora_A.weight", "lora_A.default.weight")):
            if len(factor) != rank:
                where, remedy = f"{file}: r", "put in r and lora_alpha of the run that trained these factors"
                raise CheckpointError.at(where, f"{len(factor)}, the rows of {module_of(name)}.lora_A", rank, remedy)
        elif scale != 1:
            found[name] = scale * factor.float()
    return found


def _layers(file: Path, config: Mapping[str, Any], backbone: dict[str, Any], root: str) -> dict[str, Any]:
    """Return PEFT's layers by module, without weights. Raises CheckpointError for another kind than LoRA."""
    check_adapter(file, config)
    try:
        from peft import LoraConfig, inject_adapter_in_model
        from peft.tuners.lora import LoraLayer
    except ImportError as error:
        raise ImportError('LoRA needs PEFT: pip install ".[vlm]"') from error
    unread = {"init_lora_weights", "runtime_config"} | _OF_UPSTREAM
    fields = {
        name: value for name, value in config.items() if name not in unread and not (value is None or value is False)
    }
    with expecting("a configuration that PEFT applies", file):
        with torch.device("meta"):
            network: Any = build_backbone(BackboneConfig(backbone, "bfloat16"), torch.bfloat16)
        wrapped = network if root == WHOLE else network.language_model
        inject_adapter_in_model(LoraConfig(**fields), wrapped, low_cpu_mem_usage=True)
    return {root + name: module for name, module in wrapped.named_modules() if isinstance(module, LoraLayer)}


def check_adapter(file: Path, config: Mapping[str, Any]) -> None:
    """Raise CheckpointError for an adapter that is no plain LoRA, or may have changed weights that it lacks."""
    kind, init, bias = (
        config.get(*each) for each in (("peft_type", "LORA"), ("init_lora_weights", True), ("bias", "none"))
    )
    if kind != "LORA":
        raise CheckpointError.at(f"{file}: peft_type", "LORA", shown(kind), MERGE)
    rank, alpha = config.get("r"), config.get("lora_alpha")
    if not (rank and alpha):  # PEFT has defaults
        raise CheckpointError.at(file, "lora_alpha and r of the LoRA weights", f"{shown(alpha)} and {shown(rank)}")
    if unsupported := sorted(name for name, value in config.items() if value and name not in _PLAIN | _OF_UPSTREAM):
        raise CheckpointError.at(file, "plain LoRA", cut(", ".join(unsupported)), MERGE)
    if init not in _PLAIN_INITS:
        got = f"{shown(init)}, which may change the base model's weights before training"
        raise CheckpointError.at(f"{file}: init_lora_weights", "true", got, MERGE)
    if (bias := config.get("bias", "none")) != "none":
        raise CheckpointError.at(f"{file}: bias", "none", f"{shown(bias)}, which PEFT does not always save", MERGE)


def scaled_inside(
    tensors: Mapping[str, Tensor], folder: Path, backbone: dict[str, Any], file: Path, config: Mapping[str, Any]
) -> dict[str, Tensor]:
    """Return whole weights, with scaled LoRA factors if there are any among them.

    file, config: the run's LoRA configuration, for a folder without PEFT's own
    Raises CheckpointError for a base layer whose factors are missing.
    """
    wrapped = {name.partition(BASE_LAYER)[0] for name in tensors if BASE_LAYER in name}
    present = {module_of(name) for name in tensors if LORA_NAME.fullmatch(name)}
    check_none_lost(folder / WEIGHTS, wrapped - present)
    if not present:
        return {**tensors}
    if is_there(folder / ADAPTER_CONFIG):
        file, config = folder / ADAPTER_CONFIG, read_json(folder / ADAPTER_CONFIG)
    targets = [module.removeprefix(WHOLE) for module in present if module.startswith(_PARTS)]
    used = {name: tensor for name, tensor in tensors.items() if not name.startswith(_UNUSED_HEAD)}
    return scaled(used, file, {**config, "target_modules": targets}, backbone)


CUSTOM_HEADS = "custom_heads.safetensors"
ADAPTER_TARGET = "peft_target_module.json"  # from upstream, if it saves an adapter beside the whole model
EMBEDDING = "model.language_model.embed_tokens.weight"
_NO_EMBEDDING = (
    "expected the embedding of the special tokens, got none: their rows are drawn at random when a run begins, and are "
    "lost with the run; save the whole model where it was trained (save_model() of the trainer), or the adapter with "
    "save_pretrained(..., save_embedding_layers=True)"
)
# In the names of embedding LoRA factors, and of an embedding that PEFT saves in two ways at once.
_OTHER = re.compile(r"\.(lora_embedding_[AB]|modules_to_save|original_module)(\.|$)")
_BASE_NAMES = ((r"^language_model\.", "model.language_model."), *QWEN_NAMES)  # the first: saved without a head
_PARTS = ("model.language_model.", "model.visual.")  # prefixes if the adapter wraps the whole model
_UNUSED_HEAD = "model.lm_head."


def has_adapter(folder: Path) -> bool:
    """True if the folder's weights are only an adapter; also False if upstream saved the whole model beside it.

    Raises CheckpointError for an adapter beside other whole weights.
    """
    adapter = [name for name in (ADAPTER_CONFIG, ADAPTER_WEIGHTS, CUSTOM_HEADS) if is_there(folder / name)]
    whole = [name for name in (WEIGHTS, WEIGHTS_INDEX) if is_there(folder / name)]
    if adapter and whole:
        if is_there(folder / ADAPTER_TARGET):
            return False
        remedy = "name a copy of the folder without the one that is not meant"
        raise CheckpointError.at(folder, f"an adapter ({adapter[0]}) or whole weights ({whole[0]})", "both", remedy)
    return bool(adapter)


def adapted(folder: Path, base_model: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Load an adapter and its base model: the backbone's configuration, and all weights with scaled LoRA factors.

    Raises CheckpointError.
    """
    file = folder / ADAPTER_CONFIG
    adapter_config = read_json(file)
    check_adapter(file, adapter_config)
    if not is_there(folder / ADAPTER_WEIGHTS):
        refuse_pickles(folder, ADAPTER_WEIGHTS, [path.name for path in folder.iterdir()])
    tensors = renamed(read_tensors(folder / ADAPTER_WEIGHTS), ADAPTER_NAMES)
    root = WHOLE if any(name.startswith(_PARTS) for name in tensors) else TEXT
    adapter = renamed(tensors, QWEN_NAMES)
    if other := next((name for name in adapter if _OTHER.search(name)), None):
        expected = "LoRA factors of linear layers of a Qwen backbone"
        raise CheckpointError.at(folder / ADAPTER_WEIGHTS, expected, shown(other), MERGE)
    if EMBEDDING not in adapter:
        raise CheckpointError(f"{folder / ADAPTER_WEIGHTS}: {_NO_EMBEDDING}")
    config, base = _read_base(base_model)
    replaced = {name for name in adapter if not LORA_NAME.fullmatch(name)}
    if unknown := sorted(replaced - base.keys()):
        raise CheckpointError.at(folder / ADAPTER_WEIGHTS, f"weights of {base_model}", f"also {listed(unknown)}")
    adapter = scaled(adapter, file, adapter_config, config, root)
    check_replaced(file, adapter_config, replaced, base)
    config["text_config"]["vocab_size"] = len(adapter[EMBEDDING])
    return config, base | adapter | read_tensors(folder / CUSTOM_HEADS)


def _read_base(base_model: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return a base model's backbone: its configuration, and its weights under VlmRewardModel's names.

    NF4 weights are decoded, as in training.
    """
    where = f"base model {base_model}"
    try:
        folder = local_copy(base_model, with_weights=True)
    except OSError as error:
        raise CheckpointError(
            f"{where}: cannot be had: {cut(str(error))} (name its folder with --base-model)"
        ) from error
    content = read_json(folder / NETWORK_CONFIG)
    config = backbone_config(content, f"{where}: {NETWORK_CONFIG}")
    if quantization(config) == NF4:
        del config["quantization_config"]
    check_not_quantized(config, f"{where}: {NETWORK_CONFIG}", UNQUANTIZED)
    config.pop("transformers_version", None)  # from whoever saved the base model, not from training
    weights = renamed(read_weights(folder), _BASE_NAMES)
    dequantize(weights)
    dtype = getattr(torch, str(content.get("dtype") or content.get("torch_dtype")), None)  # in which transformers loads
    return config, {n: w.to(dtype) if dtype and w.is_floating_point() else w for n, w in weights.items()}


def check_none_lost(file: Path, lost: set[str]) -> None:
    """Raise CheckpointError if factors are lost. file: the file that names their modules, for the message."""
    if lost:
        got = f"none for {listed(sorted(lost))}: these modules would score as before training"
        remedy = "copy or save the weights again where they were trained"
        raise CheckpointError.at(file, "LoRA factors of each module that was trained", got, remedy)


def check_replaced(file: Path, config: Mapping[str, Any], replaced: Iterable[str], weights: Iterable[str]) -> None:
    """Raise CheckpointError if an adapter lacks a weight in ``modules_to_save``. replaced: weights that it has."""
    names = config.get("modules_to_save") or ()
    saved = {weight for weight in weights for name in names if f".{name}." in f".{weight}"}
    if missing := sorted(saved - set(replaced)):
        where, remedy = f"{file}: modules_to_save", "copy or save the adapter again where it was trained"
        raise CheckpointError.at(where, "the weights of each module", f"none for {listed(missing)}", remedy)
