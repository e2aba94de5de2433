# SPDX-License-Identifier: MIT
"""LoRA: a weight is W + alpha / r * B A (https://arxiv.org/abs/2106.09685); adapters in PEFT's format.

W and the factors stay separate until the dtype of the network is known. W is usually bfloat16, and many updates are
smaller than half a step of bfloat16. A sum in bfloat16 would lose them, even for a network in float32.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rfm.checkpoint.content import (
    ADAPTER_CONFIG,
    ADAPTER_WEIGHTS,
    NETWORK_CONFIG,
    WEIGHTS,
    WEIGHTS_INDEX,
    CheckpointError,
    cut,
    is_there,
    listed,
    read_json,
    read_tensors,
    shown,
)
from rfm.checkpoint.hub import local_copy
from rfm.checkpoint.weights import read_weights, refuse_pickles
from rfm.vlm.backbone import (
    ADAPTER_NAMES,
    NF4,
    QWEN_NAMES,
    UNQUANTIZED,
    backbone_config,
    check_not_quantized,
    quantization,
    renamed,
)
from rfm.vlm.lora_targets import TEXT, WHOLE, check_factors, check_none_lost, check_replaced
from rfm.vlm.nf4 import dequantize
from rfm.vlm.rounded import is_rounded, shape_of

LORA_NAME = re.compile(r"(?P<module>.+)\.lora_(?P<side>[AB])(\.default)?\.weight")
_BASE_LAYER = ".base_layer."
MERGE = "merge it where it was trained (merge_and_unload() of PEFT) and export the whole model that this makes"
# Initialisations of factors that do not change the base model's weights.
_PLAIN_INITS = (True, False, "gaussian", "orthogonal")
# Fields of adapter_config.json that change no score. Any other field, if set, may change the formula above.
_HARMLESS = {
    "auto_mapping", "base_model_name_or_path", "bias", "ensure_weight_tying", "exclude_modules", "inference_mode",
    "init_lora_weights", "layers_pattern", "layers_to_transform", "lora_alpha", "lora_dropout", "megatron_core",
    "modules_to_save", "peft_type", "peft_version", "qalora_group_size", "r", "revision", "runtime_config",
    "target_modules", "task_type",
    "peft_vision_encoder",  # upstream's, in config.yaml
}  # fmt: skip


@dataclass(frozen=True)
class Scaling:
    """Rank and alpha of LoRA factors, and the file with them."""

    file: Path
    rank: int
    alpha: float

    @classmethod
    def of(cls, file: Path, config: Mapping[str, Any]) -> Scaling:
        """Read a LoRA configuration. Raises CheckpointError for an adapter of another kind."""
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

    def check_rank(self, module: str, factor: Tensor) -> None:
        """Raise CheckpointError for a factor A, [r, D], of another rank."""
        if len(factor) != self.rank:
            where, remedy = f"{self.file}: r", "put in r and lora_alpha of the run that trained these factors"
            raise CheckpointError.at(where, f"{len(factor)}, the rows of {module}.lora_A", self.rank, remedy)

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


def split(tensors: Mapping[str, Tensor], scaling: Scaling | None = None) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Split tensors into weights and LoRA factors ``<module>.lora_A.weight`` and ``<module>.lora_B.weight``.

    scaling: B is multiplied by its alpha / r; None: B is multiplied already
    Raises CheckpointError for factors that do not fit their weight, or have another rank.
    """
    weights: dict[str, Tensor] = {}
    pairs: dict[str, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        match = LORA_NAME.fullmatch(name)
        if match:
            pairs.setdefault(match["module"], {})[match["side"]] = tensor
        else:
            weights[name.replace(_BASE_LAYER, ".")] = tensor
    factors = {}
    for module, pair in pairs.items():
        _check(module, weights.get(f"{module}.weight"), pair)
        if scaling is not None:
            scaling.check_rank(module, pair["A"])
        scale = 1.0 if scaling is None else scaling.alpha / scaling.rank
        factors[_name(module, "A")] = pair["A"]
        factors[_name(module, "B")] = pair["B"] if scale == 1 else scale * pair["B"].float()
    return weights, factors


def changed_by(factor: str) -> str:
    """Return the name of the weight that a factor changes."""
    return f"{module_of(factor)}.weight"


def module_of(factor: str) -> str:
    """Return the name of the module that a factor changes."""
    match = LORA_NAME.fullmatch(factor)
    assert match is not None
    return match["module"]


def check_inside(tensors: Mapping[str, Tensor], file: Path) -> bool:
    """Return True if there are LoRA factors among whole weights, those of ``file``.

    Raises CheckpointError for a base layer whose factors are missing.
    """
    wrapped = {name.partition(_BASE_LAYER)[0] for name in tensors if _BASE_LAYER in name}
    present = {module_of(name) for name in tensors if LORA_NAME.fullmatch(name)}
    check_none_lost(file, wrapped - present)
    return bool(present)


def merged(weights: Mapping[str, Tensor], factors: Mapping[str, Tensor], dtype: torch.dtype) -> dict[str, Tensor]:
    """Return the weights in ``dtype``, with B A of the factors added in float32; factors of rounded weights stay."""
    whole = {}
    for name, weight in weights.items():
        module = name.removesuffix(".weight")
        if is_rounded(name, weight):
            whole[name] = weight
            whole |= {each: factors[each].to(dtype) for side in "AB" if (each := _name(module, side)) in factors}
            continue
        if _name(module, "A") in factors:
            weight = weight.float() + factors[_name(module, "B")].float() @ factors[_name(module, "A")].float()
        whole[name] = weight.to(dtype)
    return whole


def _name(module: str, side: str) -> str:
    return f"{module}.lora_{side}.weight"


def _check(module: str, weight: Tensor | None, pair: Mapping[str, Tensor]) -> None:
    if weight is None or pair.keys() != {"A", "B"}:
        raise CheckpointError.at(module, "a weight and LoRA factors A and B", sorted(pair))
    shapes = [list(pair[side].shape) for side in ("B", "A")]
    if [len(shape) for shape in shapes] != [2, 2] or [shapes[0][0], shapes[1][1]] != shape_of(weight):
        got = f"{shapes[0]} and {shapes[1]}"
        raise CheckpointError.at(module, f"LoRA factors of {shape_of(weight)}", got, MERGE)
    if shapes[0][1] != shapes[1][0]:
        raise CheckpointError.at(module, "LoRA factors of one rank", f"{shapes[0]} and {shapes[1]}")


CUSTOM_HEADS = "custom_heads.safetensors"
ADAPTER_TARGET = "peft_target_module.json"  # from upstream, if it saves an adapter beside the whole model
EMBEDDING = "model.language_model.embed_tokens.weight"

_NO_EMBEDDING = (
    "expected the embedding of the special tokens, got none: their rows are drawn at random when a run begins, and are "
    "lost with the run; save the whole model where it was trained (save_model() of the trainer), or the adapter with "
    "save_pretrained(..., save_embedding_layers=True)"
)
# In names of LoRA factors of embeddings, and of an embedding that PEFT saves in two ways at once.
_OTHER = re.compile(r"\.(lora_embedding_[AB]|modules_to_save|original_module)(\.|$)")
_BASE_NAMES = ((r"^language_model\.", "model.language_model."), *QWEN_NAMES)  # the first: saved without a head
_PARTS = ("model.language_model.", "model.visual.")  # in names of an adapter around all of them


def has_adapter(folder: Path) -> bool:
    """True if the folder's weights are an adapter alone; False also if upstream saved the whole model beside it.

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
        refuse_pickles(folder, ADAPTER_WEIGHTS, Path(ADAPTER_WEIGHTS).stem)
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

    Weights in NF4 are decoded, as in training.
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
    config.pop("transformers_version", None)  # of whoever saved the base model, not that of training
    weights = renamed(read_weights(folder), _BASE_NAMES)
    dequantize(weights)
    dtype = getattr(torch, str(content.get("dtype") or content.get("torch_dtype")), None)  # in which transformers loads
    return config, {n: w.to(dtype) if dtype and w.is_floating_point() else w for n, w in weights.items()}
