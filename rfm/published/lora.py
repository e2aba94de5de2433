# SPDX-License-Identifier: MIT
"""LoRA adapters: PEFT says which modules have factors, of which rank and scaling.

A module is the name of its weight without ``.weight``, under VlmRewardModel's names.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterable, Mapping, Sequence
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
    LORA_INSIDE,
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
from rfm_client.contract.checks import require

WHOLE, TEXT = "model.", "model.language_model."  # what PEFT wraps
# Factor initialisations that do not change the base model's weights.
_PLAIN_INITS = (True, False, "gaussian", "orthogonal")
_PATTERN_S = 5  # for all patterns from an unknown author
# Fields of a LoRA configuration that PEFT applies, in all versions. A weight is W + scaling * B A.
_APPLIED = (
    "alpha_pattern", "exclude_modules", "layers_pattern", "layers_to_transform", "lora_alpha", "modules_to_save", "r",
    "rank_pattern", "target_modules", "use_rslora",
)  # fmt: skip
# Fields that change no score. Any other field, if set, may change the formula above.
_HARMLESS = (
    "auto_mapping", "base_model_name_or_path", "bias", "ensure_weight_tying", "inference_mode", "init_lora_weights",
    "lora_dropout", "megatron_core", "peft_type", "peft_version", "qalora_group_size", "revision", "runtime_config",
    "task_type",
    "peft_vision_encoder",  # upstream's, in config.yaml
)  # fmt: skip


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
    """Return PEFT's layers by module, without weights. Raises CheckpointError for patterns that PEFT cannot apply."""
    try:
        from peft import LoraConfig, inject_adapter_in_model
        from peft.tuners.lora import LoraLayer
    except ImportError as error:
        raise ImportError(f'LoRA needs PEFT: pip install ".[vlm]" ({error})') from error
    with expecting("a configuration that PEFT applies", file):
        with torch.device("meta"):
            network: Any = build_backbone(BackboneConfig(backbone, "bfloat16"), torch.bfloat16)
        wrapped = network if root == WHOLE else network.language_model
        fields = _without_patterns(file, config, [name for name, _ in wrapped.named_modules() if name])
        inject_adapter_in_model(LoraConfig(**fields), wrapped, low_cpu_mem_usage=True)
    return {root + name: module for name, module in wrapped.named_modules() if isinstance(module, LoraLayer)}


def _without_patterns(file: Path, config: Mapping[str, Any], modules: Sequence[str]) -> dict[str, Any]:
    """Return the fields that PEFT applies, with module names instead of patterns, in bounded time.

    Raises CheckpointError for a pattern that is invalid, takes too long, or matches no module.
    """
    import regex  # a dependency of transformers; Python's own has no time limit

    end = time.monotonic() + _PATTERN_S

    def matches(field: str, pattern: str, form: str = "{}") -> list[str]:
        try:
            compiled = regex.compile(form.format(pattern))
            return [each for each in modules if compiled.fullmatch(each, timeout=max(end - time.monotonic(), 1e-3))]
        except (TimeoutError, regex.error) as error:
            got, remedy = f"{shown(pattern)}: {error}", "write the names of the modules in its place"
            raise CheckpointError.at(f"{file}: {field}", "a pattern of names", got, remedy) from error

    fields = {name: config[name] for name in _APPLIED if config.get(name) is not None}
    for field in ("layers_pattern", "modules_to_save"):  # PEFT takes these as patterns, too
        names = [fields[field]] if isinstance(fields.get(field), str) else fields.get(field, ())
        if other := [name for name in names if not re.fullmatch(r"[\w.]*", name)]:
            raise CheckpointError.at(f"{file}: {field}", "names of modules", shown(other[0]), MERGE)
    for field in ("target_modules", "exclude_modules"):
        if isinstance(fields.get(field), str) and fields[field] != "all-linear":
            fields[field] = matches(field, fields[field])
    for field in ("alpha_pattern", "rank_pattern"):
        left, of_module = {*modules}, {}
        for pattern, value in fields.get(field, {}).items():
            if not (found := matches(field, pattern, r"(.*\.)?({})$")):
                remedy = "remove it if it changed none in training, or merge the adapter there"
                raise CheckpointError.at(f"{file}: {field}", "a pattern that matches a module", shown(pattern), remedy)
            require(f"{file}: {field}", _is_number(value), "finite numbers", shown(value), CheckpointError)
            if names := left.intersection(found):  # the first pattern counts
                of_module[f"^(?:{'|'.join(map(re.escape, sorted(names)))})"] = value
                left -= names
        fields[field] = of_module
    return fields


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def check_adapter(file: Path, config: Mapping[str, Any]) -> None:
    """Raise CheckpointError for an adapter that is no plain LoRA, or may have changed weights that it lacks."""
    kind, init, bias = (
        config.get(*each) for each in (("peft_type", "LORA"), ("init_lora_weights", True), ("bias", "none"))
    )
    if kind != "LORA":
        raise CheckpointError.at(f"{file}: peft_type", "LORA", shown(kind), MERGE)
    rank, alpha = config.get("r"), config.get("lora_alpha")
    if type(rank) is not int or rank < 1 or not _is_number(alpha):  # PEFT has defaults
        got = f"lora_alpha {shown(alpha)} and r {shown(rank)}"
        raise CheckpointError.at(file, "lora_alpha and r of the LoRA weights", got)
    if unsupported := sorted(name for name, value in config.items() if value and name not in (*_APPLIED, *_HARMLESS)):
        raise CheckpointError.at(file, "plain LoRA", cut(", ".join(unsupported)), MERGE)
    if init not in _PLAIN_INITS:
        got = f"{shown(init)}, which may change the base model's weights before training"
        raise CheckpointError.at(f"{file}: init_lora_weights", "true", got, MERGE)
    if bias != "none":
        raise CheckpointError.at(f"{file}: bias", "none", f"{shown(bias)}, which PEFT does not always save", MERGE)


def scaled_inside(
    tensors: dict[str, Tensor], folder: Path, backbone: dict[str, Any], file: Path, config: Mapping[str, Any]
) -> dict[str, Tensor]:
    """Return whole weights, renamed, with scaled LoRA factors if there are any among them.

    file, config: the run's LoRA configuration, with which PEFT's own in the folder must agree
    Raises CheckpointError for a base layer whose factors are missing.
    """
    root = TEXT if any(name.startswith(f"{TEXT}base_model.") for name in tensors) else WHOLE
    tensors = renamed(renamed(tensors, LORA_INSIDE), QWEN_NAMES)
    wrapped = {name.partition(BASE_LAYER)[0] for name in tensors if BASE_LAYER in name}
    present = {module_of(name) for name in tensors if LORA_NAME.fullmatch(name)}
    check_none_lost(folder / WEIGHTS, wrapped - present)
    if not present:
        return tensors
    check_adapter(file, config)
    if is_there(own := folder / ADAPTER_CONFIG):
        check_adapter(own, of_adapter := read_json(own))
        of_run, its = (f"r {each['r']} and lora_alpha {each['lora_alpha']:g}" for each in (config, of_adapter))
        if of_run != its:
            raise CheckpointError.at(own, f"{of_run}, as {file} has it", its, "mend the wrong one")
        file, config = own, of_adapter
    targets = [module.removeprefix(root) for module in present if module.startswith(_PARTS)]
    used = {name: tensor for name, tensor in tensors.items() if not name.startswith(_UNUSED_HEAD)}
    return scaled(used, file, {**config, "target_modules": targets}, backbone, root)


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
