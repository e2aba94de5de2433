# SPDX-License-Identifier: MIT
"""PEFT adapters, and which targeted modules lack factors, by PEFT's rules (``check_target_module_exists``, PEFT 0.21).

A module is the name of its weight without ``.weight``, under VlmRewardModel's names.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
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
    is_there,
    listed,
    local_copy,
    read_json,
    read_tensors,
    shown,
)
from rfm.published.nf4 import dequantize
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
from rfm.published.weights import read_weights, refuse_pickles
from rfm.qwen.lora import BASE_LAYER, LORA_NAME, MERGE, module_of

WHOLE, TEXT = "model.", "model.language_model."  # what PEFT wraps
_ALL_LINEAR = "all-linear"
_LAYER = re.compile(r"\.\d+\.")  # the first one in a name
_PATTERN_S = 5  # for a pattern from an unknown author
# Factor initialisations that do not change the base model's weights.
_PLAIN_INITS = (True, False, "gaussian", "orthogonal")
# Fields in adapter_config.json that change no score. Any other field, if set, may change the formula above.
_HARMLESS = {
    "auto_mapping", "base_model_name_or_path", "bias", "ensure_weight_tying", "exclude_modules", "inference_mode",
    "init_lora_weights", "layers_pattern", "layers_to_transform", "lora_alpha", "lora_dropout", "megatron_core",
    "modules_to_save", "peft_type", "peft_version", "qalora_group_size", "r", "revision", "runtime_config",
    "target_modules", "task_type",
    "peft_vision_encoder",  # upstream's, in config.yaml
}  # fmt: skip


@dataclass(frozen=True)
class Scaling:
    """Rank and alpha for LoRA factors, and the file that states them."""

    file: Path
    rank: int
    alpha: float

    @classmethod
    def of(cls, file: Path, config: Mapping[str, Any]) -> Scaling:
        """Read a LoRA configuration. Raises CheckpointError for another adapter type."""
        kind = config.get("peft_type", "LORA")
        if kind != "LORA":
            raise CheckpointError.at(f"{file}: peft_type", "LORA", shown(kind), MERGE)
        rank, alpha = config.get("r"), config.get("lora_alpha")
        is_number = isinstance(alpha, (int, float)) and not isinstance(alpha, bool) and math.isfinite(alpha)
        if type(rank) is not int or rank < 1 or not is_number:
            got = f"lora_alpha {shown(alpha)} and r {shown(rank)}"
            raise CheckpointError.at(file, "lora_alpha and r of the LoRA weights", got)
        unsupported = sorted(name for name, value in config.items() if value and name not in _HARMLESS)
        if unsupported:
            raise CheckpointError.at(file, "plain LoRA", cut(", ".join(unsupported)), MERGE)
        return cls(file, rank, float(config["lora_alpha"]))

    def scaled(self, factors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the factors, with alpha / r in B. Raises CheckpointError for a factor A, [r, D], with another rank."""
        scale = self.alpha / self.rank
        found = {}
        for name, factor in factors.items():
            is_a = name.endswith("lora_A.weight")
            if is_a and len(factor) != self.rank:
                where, remedy = f"{self.file}: r", "put in r and lora_alpha of the run that trained these factors"
                got = f"{len(factor)}, the rows of {module_of(name)}.lora_A"
                raise CheckpointError.at(where, got, self.rank, remedy)
            found[name] = factor if is_a or scale == 1 else scale * factor.float()
        return found

    def check_equal(self, other: Scaling) -> None:
        """Raise CheckpointError if another file has other values."""
        mine, its = (f"r {each.rank} and lora_alpha {each.alpha:g}" for each in (self, other))
        if mine != its:
            raise CheckpointError.at(other.file, f"{mine}, as {self.file} has it", its, "mend the wrong one")


def check_adapter(file: Path, config: Mapping[str, Any]) -> None:
    """Raise CheckpointError for an adapter that may have changed weights that it does not contain."""
    init, bias = config.get("init_lora_weights", True), config.get("bias", "none")
    if init not in _PLAIN_INITS:
        got = f"{shown(init)}, which may change the base model's weights before training"
        raise CheckpointError.at(f"{file}: init_lora_weights", "true", got, MERGE)
    if bias != "none":
        raise CheckpointError.at(f"{file}: bias", "none", f"{shown(bias)}, which PEFT does not always save", MERGE)


def check_inside(tensors: Mapping[str, Tensor], file: Path) -> bool:
    """Return True if ``file`` holds LoRA factors among whole weights.

    Raises CheckpointError for a base layer whose factors are missing.
    """
    wrapped = {name.partition(BASE_LAYER)[0] for name in tensors if BASE_LAYER in name}
    present = {module_of(name) for name in tensors if LORA_NAME.fullmatch(name)}
    check_none_lost(file, wrapped - present)
    return bool(present)


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


def adapted(folder: Path, base_model: str) -> tuple[dict[str, Any], dict[str, Tensor], Scaling]:
    """Load an adapter and its base model: the backbone's configuration, all weights, and the factors' scaling.

    Raises CheckpointError.
    """
    file = folder / ADAPTER_CONFIG
    adapter_config = read_json(file)
    scaling = Scaling.of(file, adapter_config)
    check_adapter(file, adapter_config)
    if not is_there(folder / ADAPTER_WEIGHTS):
        refuse_pickles(folder, ADAPTER_WEIGHTS, [path.name for path in folder.iterdir()])
    tensors = renamed(read_tensors(folder / ADAPTER_WEIGHTS), ADAPTER_NAMES)
    root = WHOLE if any(name.startswith(_PARTS) for name in tensors) else TEXT
    adapter = renamed(tensors, QWEN_NAMES)
    other = next((name for name in adapter if _OTHER.search(name)), None)
    if other is not None:
        expected = "LoRA factors of linear layers of a Qwen backbone"
        raise CheckpointError.at(folder / ADAPTER_WEIGHTS, expected, shown(other), MERGE)
    if EMBEDDING not in adapter:
        raise CheckpointError(f"{folder / ADAPTER_WEIGHTS}: {_NO_EMBEDDING}")
    config, base = _read_base(base_model)
    factors = {name: tensor for name, tensor in adapter.items() if LORA_NAME.fullmatch(name)}
    replaced = {name: tensor for name, tensor in adapter.items() if name not in factors}
    unknown = sorted(replaced.keys() - base.keys())
    if unknown:
        raise CheckpointError.at(folder / ADAPTER_WEIGHTS, f"weights of {base_model}", f"also {listed(unknown)}")
    check_factors(file, adapter_config, set(map(module_of, factors)), base, root)
    check_replaced(file, adapter_config, replaced, base)
    config["text_config"]["vocab_size"] = len(replaced[EMBEDDING])
    return config, base | replaced | factors | read_tensors(folder / CUSTOM_HEADS), scaling


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


def check_factors(
    file: Path, config: Mapping[str, Any], present: set[str], weights: Mapping[str, Tensor], root: str
) -> None:
    """Raise CheckpointError if an adapter trained modules whose factors are missing.

    file: states ``config``, the adapter's configuration
    present: modules with factors
    weights: weights of the whole network
    root: prefix for the modules that PEFT wrapped
    """
    check_none_lost(file, _targeted(file, config, present, weights, root) - present)


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


def _targeted(
    file: Path, config: Mapping[str, Any], present: set[str], weights: Mapping[str, Tensor], root: str
) -> set[str]:
    """Return the modules that ``config`` targets; if ``present`` has others, its module kinds in all layers."""
    axes = {name.removesuffix(".weight"): tensor.dim() for name, tensor in weights.items() if name.endswith(".weight")}
    modules = [module for module, dim in axes.items() if module.startswith(root) and dim > 1]
    for prefix in (root, WHOLE, ""):
        keys = {module.removeprefix(prefix): axes[module] for module in modules}
        matched = _matched(file, config, keys)
        found = {module for module in modules if module.removeprefix(prefix) in matched}
        if found and present <= found:
            return found
    kinds = {_LAYER.sub(".*.", module, count=1) for module in present}
    return {module for module in modules if _LAYER.sub(".*.", module, count=1) in kinds}


def _matched(file: Path, config: Mapping[str, Any], keys: Mapping[str, int]) -> set[str]:
    """Return the keys that ``target_modules`` names, minus its exceptions. keys: how many axes each weight has."""
    wanted = config.get("target_modules") or []
    linear = {key for key, dim in keys.items() if dim == 2 and "embed" not in key.rpartition(".")[2]}
    found = linear if wanted == _ALL_LINEAR else _named(file, "target_modules", wanted, keys)
    layers = config.get("layers_to_transform")
    if isinstance(wanted, list) and layers not in (None, []):
        numbers = layers if isinstance(layers, list) else [layers]
        found = {key for key in found if key in wanted or _layer_of(key, config.get("layers_pattern")) in numbers}
    saved = config.get("modules_to_save") or ()
    found = {key for key in found if not any(f".{name}." in f".{key}." for name in saved)}
    return found - _named(file, "exclude_modules", config.get("exclude_modules") or [], keys)


def _named(file: Path, field: str, names: list[str] | str, keys: Iterable[str]) -> set[str]:
    """Return the keys that end with one of ``names``, or that match it as a pattern."""
    if not isinstance(names, str):
        return {key for key in keys if any(f".{key}".endswith(f".{name}") for name in names)}
    import regex  # a dependency of transformers; Python's own has no time limit

    try:
        return {key for key in keys if regex.fullmatch(names, key, timeout=_PATTERN_S)}
    except (TimeoutError, regex.error) as error:
        raise CheckpointError.at(f"{file}: {field}", "a pattern of names", f"{shown(names)}: {error}") from error


def _layer_of(key: str, patterns: list[str] | str | None) -> int | None:
    """Return the layer number in a key, behind one of the names ``patterns`` (none: behind any name)."""
    names = [patterns] if isinstance(patterns, str) else patterns or [r"[^.]*"]
    for name in names:
        escaped = name if name == r"[^.]*" else re.escape(name)
        if (found := re.match(rf"(?:^|.*?\.){escaped}\.(\d+)\.", key)) is not None:
            return int(found[1])
    return None
