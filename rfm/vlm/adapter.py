# SPDX-License-Identifier: MIT
"""LoRA adapters as PEFT saves them, and the base models that they change."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from torch import Tensor

from rfm.checkpoint.content import CheckpointError, cut, is_there, listed, read_json, read_tensors, shown
from rfm.checkpoint.files import ADAPTER_CONFIG, NETWORK_CONFIG, WEIGHTS, WEIGHTS_INDEX, check_one_form
from rfm.checkpoint.pickles import refuse_pickles
from rfm.vlm.backbone import BACKBONES, DEQUANTIZED, backbone_config, check_not_quantized
from rfm.vlm.lora import LORA_NAME, MERGE, Scaling, check_adapter
from rfm.vlm.names import ADAPTER_NAMES, QWEN_NAMES, renamed
from rfm.vlm.run_config import RunConfig

ADAPTER_WEIGHTS = "adapter_model.safetensors"
CUSTOM_HEADS = "custom_heads.safetensors"
ADAPTER_TARGET = "peft_target_module.json"  # upstream writes it where it saves an adapter beside the whole model
EMBEDDING = "model.language_model.embed_tokens.weight"

_NO_EMBEDDING = (
    "expected the embedding of the special tokens, got none: their rows are drawn at random when a run begins, and are "
    "lost with the run; save the whole model where it was trained (save_model() of the trainer), or the adapter with "
    "save_pretrained(..., save_embedding_layers=True)"
)
# In names of SmolVLM's weights, of LoRA of an embedding, and of an embedding that PEFT saves in two ways at once.
_OTHER = re.compile(r"\.(text_model|lora_embedding_[AB]|modules_to_save|original_module)(\.|$)")
_VARIANT = re.compile(r"-unsloth$")  # of one model, which Unsloth puts in the place of a base model
_FEW_BITS = re.compile(r"-bnb-\dbit/?$")  # how Unsloth names a base model of fewer bits, which it trains on


def has_adapter(folder: Path) -> bool:
    """Whether the folder's weights are an adapter alone. Of one beside the whole model that upstream saved with it, the
    whole model is read. Raises CheckpointError for one beside weights of which nothing is known.
    """
    adapter = [name for name in (ADAPTER_CONFIG, ADAPTER_WEIGHTS, CUSTOM_HEADS) if is_there(folder / name)]
    whole = [name for name in (WEIGHTS, WEIGHTS_INDEX) if is_there(folder / name)]
    if adapter and whole:
        if is_there(folder / ADAPTER_TARGET):
            return False
        raise CheckpointError(
            f"{folder}: expected an adapter ({adapter[0]}) or whole weights ({whole[0]}), got both; move away the one "
            "that is not meant"
        )
    return bool(adapter)


def base_of_adapter(folder: Path, run: RunConfig) -> str:
    """The base model that the run names. Raises CheckpointError if the adapter names another, or the run began with a
    checkpoint, whose weights its adapter may change in place of the base model's.
    """
    base = run.get("model.base_model_id", "")
    if not base:
        raise CheckpointError(f"{run.file}: expected model.base_model_id (or --base-model), got none")
    named = read_json(folder / ADAPTER_CONFIG).get("base_model_name_or_path")
    if isinstance(named, str) and _FEW_BITS.search(named):
        expected = f"base_model_name_or_path: expected weights in full precision, got {shown(named)}"
        raise CheckpointError(f"{folder / ADAPTER_CONFIG}: {expected}; {DEQUANTIZED.format(base=named)}")
    if named and model_name(str(named)) != model_name(base):
        raise CheckpointError(
            f"{folder / ADAPTER_CONFIG}: base_model_name_or_path: expected {cut(base)}, the model.base_model_id of "
            f"{run.file}, got {shown(named)}; name the one that the adapter was trained on with --base-model"
        )
    began_with = run.get("training.load_from_checkpoint", "")
    if began_with:
        raise CheckpointError(
            f"{run.file}: training.load_from_checkpoint: expected none beside an adapter, got {shown(began_with)}: the "
            f"adapter may change its weights in place of those of {cut(base)}; {MERGE}; if it does change those of "
            f"{cut(base)}, name them with --base-model"
        )
    return base


def model_name(base: str) -> str:
    """What is left of a base model's id or path where the same model may have several."""
    return _VARIANT.sub("", base.rstrip("/").rpartition("/")[2].lower())


def adapted(folder: Path, base_model: str) -> tuple[dict[str, Any], dict[str, Tensor], Scaling]:
    """Configuration of the base model's backbone; its weights with those of the adapter; what its factors are scaled
    with.
    """
    file = folder / ADAPTER_CONFIG
    adapter_config = read_json(file)
    scaling = Scaling.of(file, adapter_config)
    check_adapter(file, adapter_config)
    if not is_there(folder / ADAPTER_WEIGHTS):
        refuse_pickles(folder, ADAPTER_WEIGHTS, Path(ADAPTER_WEIGHTS).stem)
    adapter = renamed(renamed(read_tensors(folder / ADAPTER_WEIGHTS), ADAPTER_NAMES), QWEN_NAMES)
    other = next((name for name in adapter if _OTHER.search(name)), None)
    if other is not None:
        expected = "LoRA factors of linear layers of a Qwen backbone"
        raise CheckpointError(f"{folder / ADAPTER_WEIGHTS}: expected {expected}, got {shown(other)}; {MERGE}")
    if EMBEDDING not in adapter:
        raise CheckpointError(f"{folder / ADAPTER_WEIGHTS}: {_NO_EMBEDDING}")
    config, base = _read_base(base_model)
    factors = {name: tensor for name, tensor in adapter.items() if LORA_NAME.fullmatch(name)}
    replaced = {name: tensor for name, tensor in adapter.items() if name not in factors}
    unknown = sorted(replaced.keys() - base.keys())
    if unknown:
        raise CheckpointError(
            f"{folder / ADAPTER_WEIGHTS}: expected weights of {base_model}, got also {listed(unknown)}"
        )
    config["text_config"]["vocab_size"] = len(replaced[EMBEDDING])
    return config, base | replaced | factors | read_tensors(folder / CUSTOM_HEADS), scaling


def _read_base(base_model: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The backbone of a base model: its configuration and its weights, named as in VlmRewardModel."""
    import transformers

    if Path(base_model).is_dir():
        check_one_form(Path(base_model))
    try:
        content = transformers.PretrainedConfig.get_config_dict(base_model)[0]
        file = f"base model {base_model}: {NETWORK_CONFIG}"
        backbone = backbone_config(content, file)
        check_not_quantized(backbone, file, DEQUANTIZED.format(base=base_model))
        network_class = getattr(transformers, BACKBONES[backbone["model_type"]])
        network, loaded = network_class.from_pretrained(
            base_model,
            config=network_class.config_class.from_dict(backbone),
            use_safetensors=True,
            dtype="auto",
            output_loading_info=True,
        )
    except (OSError, RecursionError, ValueError) as error:
        hint = "name its folder with --base-model"
        raise CheckpointError(f"base model {base_model}: cannot be had: {cut(str(error))} ({hint})") from error
    if loaded["missing_keys"]:
        raise CheckpointError(f"base model {base_model}: missing keys: {listed(sorted(loaded['missing_keys']))}")
    config = backbone_config(network.config.to_dict(), base_model)
    config.pop("transformers_version", None)  # the one installed here, which says nothing of the training
    return config, {f"model.{name}": tensor for name, tensor in network.state_dict().items()}
