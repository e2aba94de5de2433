# SPDX-License-Identifier: MIT
"""Vision-language checkpoints: full weights, or LoRA factors beside them or beside those of a base model.

Names of weights become those of VlmRewardModel, by one rename table per form.
"""

from __future__ import annotations

import importlib.metadata
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from rfm.checkpoint.content import (
    CheckpointError,
    cut,
    expecting,
    is_there,
    listed,
    read_json,
    read_tensors,
    shown,
)
from rfm.checkpoint.files import (
    NETWORK_CONFIG,
    WEIGHTS,
    WEIGHTS_INDEX,
    check_shapes,
    read_weights,
)
from rfm.checkpoint.pickles import refuse_pickles
from rfm.checkpoint.training import check_progress
from rfm.family import NETWORK, Description, Options
from rfm.feature_cache import FeatureCache
from rfm.version_folder import PROCESSOR_FOLDER
from rfm.vlm.backbone import (
    BACKBONES,
    DEQUANTIZED,
    SMOL,
    UNQUANTIZED,
    backbone_config,
    check_not_quantized,
    is_at_least,
)
from rfm.vlm.collator import VlmCollator
from rfm.vlm.images import FRAMES_PER_GROUP
from rfm.vlm.lora import LORA_NAME, Scaling, changed_by, check_adapter, merged, split
from rfm.vlm.network import VlmConfig, VlmRewardModel, build_backbone
from rfm.vlm.predictor import VlmPredictor
from rfm.vlm.processor import frame_size, load_collator, save_processor
from rfm.vlm.prompts import OF_AN_OLD_RUN
from rfm.vlm.run_config import RunConfig

ADAPTER_CONFIG = "adapter_config.json"
ADAPTER_WEIGHTS = "adapter_model.safetensors"
CUSTOM_HEADS = "custom_heads.safetensors"
ADAPTER_TARGET = "peft_target_module.json"  # upstream writes it where it saves an adapter beside the whole model
LORA = "lora"  # in VlmCheckpoint.parts: the factors that change the network's weights
SETTINGS = "rfm"  # key of our own fields in an exported config.json
EMBEDDING = "model.language_model.embed_tokens.weight"

# Renames of one form, tried in order on each name; the first that matches is applied.
_Renames = Sequence[tuple[str, str]]
_SMOL: _Renames = ((r"^model\.model\.", "model."),)
_LORA_INSIDE: _Renames = ((r"^(model(\.\w+)?)\.base_model\.model\.", r"\1."),)
_ADAPTER: _Renames = ((r"^base_model\.model\.", "model."),)
# Of a Qwen backbone as transformers had its weights before 4.52, and as it writes them since in some cases.
_OLD_QWEN: _Renames = (
    (r"^visual\.", "model.visual."),
    (r"^model\.(embed_tokens|layers|norm)\.", r"model.language_model.\1."),
)
# What makes text, which no reward head reads; the rotary frequencies, which transformers once saved, and computes.
_UNUSED = re.compile(r"(model\.)?lm_head\.weight|.*\.(rotary_emb|rotary_pos_emb)\.(original_)?inv_freq")
# What bitsandbytes, GPTQ, AWQ and FP8 write beside or in place of a weight.
_QUANTIZED = re.compile(
    r"\.(absmax|quant_map|nested_absmax|SCB|qweight|qzeros|weight_packed|weight_scale|weight_scale_inv)$|\.quant_state\."
)

_NO_EMBEDDING = (
    "expected the embedding of the special tokens, got none: their rows are drawn at random when a run begins, and are "
    "lost with the run; save the whole model where it was trained (save_model() of the trainer), or the adapter with "
    "save_pretrained(..., save_embedding_layers=True)"
)
_VARIANT = re.compile(r"-unsloth$")  # of one model, which Unsloth puts in the place of a base model
_FEW_BITS = re.compile(r"-bnb-\dbit/?$")  # how Unsloth names a base model of fewer bits, which it trains on

_LAYER_COUNTS = ("num_hidden_layers", "num_layers", "depth")
MAX_LAYERS = 1024


@dataclass(frozen=True)
class VlmCheckpoint:
    """A vision-language checkpoint in memory.

    weights: of VlmRewardModel, without LoRA
    factors: of LoRA, as ``rfm.vlm.lora.split`` names them; none: the weights are whole
    processor: folder or id with its tokenizer and image preprocessing; None: those of the base model that it names
    """

    config: VlmConfig
    weights: dict[str, Tensor]
    factors: dict[str, Tensor]
    processor: str | Path | None = None

    @property
    def description(self) -> Description:
        """What the checkpoint takes, and what it answers."""
        return Description(
            network_class=VlmRewardModel.__name__,
            widths=None,
            progress_bins=self.config.progress_bins,
            has_similarity=self.config.has_similarity,
            trained_frames=self.config.trained_frames,
            frame_size=frame_size(self.config),
            frames_per_value=1 if self.config.multi_image else FRAMES_PER_GROUP,
            keeps_features=self.config.family != SMOL,
            is_large=True,
        )

    @property
    def parts(self) -> dict[str, dict[str, Tensor]]:
        """All weights: the network's, and the LoRA factors that change them."""
        return {NETWORK: self.weights, LORA: self.factors}

    @property
    def notes(self) -> Sequence[str]:
        """Nothing that could not be checked decides its scores."""
        return ()

    @cached_property
    def collator(self) -> VlmCollator:
        """What makes batches of samples. Raises CheckpointError if the processor cannot be had or does not fit."""
        embedding = next(t for name, t in self.weights.items() if name.endswith("embed_tokens.weight"))
        return load_collator(self.config, len(embedding), self.processor or self.config.base_model_id)

    def encoders(self) -> None:
        """None: the network reads raw frames, and needs no encoders."""

    def predictor(
        self, device: torch.device, dtype: torch.dtype | None = None, cache: FeatureCache[Any] | None = None
    ) -> VlmPredictor:
        """The network on ``device``. Raises CheckpointError.

        dtype: of the network; None: float32 on the CPU, else the checkpoint's own
        cache: of what the vision tower makes of frames; None: nothing is kept. SmolVLM keeps nothing
        """
        if dtype is None and device.type == "cpu":
            dtype = torch.float32
        collator = self.collator  # first: what is missing is reported before the weights are read
        kept = cache if self.description.keeps_features else None
        return VlmPredictor(self.build(dtype), collator, device, kept)

    def save(self, folder: Path) -> None:
        """Writes weights and LoRA factors, one config.json that says all, and the processor."""
        collator = self.collator  # first: what is missing is reported before the weights are written
        folder.mkdir(parents=True)
        settings = {name: value for name, value in asdict(self.config).items() if name != "backbone"}
        config = {**self.config.backbone, SETTINGS: settings}
        (folder / NETWORK_CONFIG).write_text(json.dumps(config, indent=2) + "\n")
        tensors = {name: tensor.contiguous() for name, tensor in (self.weights | self.factors).items()}
        save_file(tensors, folder / WEIGHTS, metadata={"format": "pt"})
        save_processor(collator, folder / PROCESSOR_FOLDER)

    def build(self, dtype: torch.dtype | None = None) -> VlmRewardModel:
        """The network with these weights, on the CPU, ready to score, in ``dtype`` (None: its own)."""
        wanted = dtype or self.config.torch_dtype
        _check_transformers(self.config)
        network = self._network(wanted)
        # Parameters only: rotary frequencies stay float32, as in the original.
        network.load_state_dict(merged(self.weights, self.factors, wanted), strict=True, assign=True)
        return network.eval().requires_grad_(False)

    def check(self) -> None:
        """Raises CheckpointError unless the weights are those of the network; no memory is taken for it before."""
        _check_layers(self.config.backbone)
        with expecting("a backbone that transformers can make", NETWORK_CONFIG), torch.device("meta"):
            network = self._network(self.config.torch_dtype)
        check_shapes(network.state_dict(), self.weights)

    def _network(self, dtype: torch.dtype) -> VlmRewardModel:
        return VlmRewardModel(self.config, build_backbone(self.config, dtype))


def reads(folder: Path) -> bool:
    """Whether the folder holds an adapter, or a network on one of the known backbones."""
    if is_there(folder / ADAPTER_CONFIG):
        return True
    model_type = read_json(folder / NETWORK_CONFIG).get("model_type") if is_there(folder / NETWORK_CONFIG) else None
    return isinstance(model_type, str) and model_type in BACKBONES


def load(folder: Path, options: Options) -> VlmCheckpoint:
    """The checkpoint in a local folder. Raises CheckpointError."""
    with expecting("a vision-language checkpoint", folder):
        is_adapter = _has_adapter(folder)
        file = folder / NETWORK_CONFIG
        backbone = {} if is_adapter else backbone_config(read_json(file), file)
        check_not_quantized(backbone, file, UNQUANTIZED)
        if SETTINGS in backbone:  # written by VlmCheckpoint.save, with every setting
            config = _saved_config(backbone)
            weights, factors = _used(_renamed(read_weights(folder), _renames(config.family)))
        else:
            run = RunConfig.of(folder)
            run.check_model_type()
            check_progress(run.sections, run.file)
            scaling: Scaling | None
            if is_adapter:
                backbone, tensors, scaling = _adapted(folder, options.base_model or _base_of_adapter(folder, run))
            else:
                tensors, scaling = _whole(folder, backbone, run)
            weights, factors = _used(tensors, scaling)
            config = _trained_config(folder, backbone, run, weights, options.resize_images)
    own = folder / PROCESSOR_FOLDER
    checkpoint = VlmCheckpoint(config, weights, factors, options.base_model or (own if own.is_dir() else None))
    checkpoint.check()
    return checkpoint


def _has_adapter(folder: Path) -> bool:
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


def _base_of_adapter(folder: Path, run: RunConfig) -> str:
    """The base model that the run names. Raises CheckpointError if the adapter names another."""
    base = run.get("model.base_model_id", "")
    if not base:
        raise CheckpointError(f"{run.file}: expected model.base_model_id (or --base-model), got none")
    named = read_json(folder / ADAPTER_CONFIG).get("base_model_name_or_path")
    if isinstance(named, str) and _FEW_BITS.search(named):
        expected = f"base_model_name_or_path: expected weights in full precision, got {shown(named)}"
        raise CheckpointError(f"{folder / ADAPTER_CONFIG}: {expected}; {DEQUANTIZED.format(base=named)}")
    if named and _model_name(str(named)) != _model_name(base):
        raise CheckpointError(
            f"{folder / ADAPTER_CONFIG}: base_model_name_or_path: expected {cut(base)}, the model.base_model_id of "
            f"{run.file}, got {shown(named)}; name the one that the adapter was trained on with --base-model"
        )
    return base


def _model_name(base: str) -> str:
    """What is left of a base model's id or path where the same model may have several."""
    return _VARIANT.sub("", base.rstrip("/").rpartition("/")[2].lower())


def _saved_config(content: Mapping[str, Any]) -> VlmConfig:
    settings = {**content[SETTINGS]}
    size = settings.pop("size_px")
    rest = {name: value for name, value in content.items() if name != SETTINGS}
    return VlmConfig(backbone=rest, size_px=tuple(size) if size else None, **settings)


def _trained_config(
    folder: Path,
    backbone: dict[str, Any],
    run: RunConfig,
    weights: Mapping[str, Tensor],
    resize_images: bool | None,
) -> VlmConfig:
    family = str(backbone["model_type"])
    if "progress_head.4.weight" not in weights:
        raise CheckpointError(f"{folder}: expected reward heads, got no progress_head.4.weight")
    if "frame_pool_attn.weight" not in weights:
        raise CheckpointError(f"{folder}: expected frame_pool_attn.weight, got none: {OF_AN_OLD_RUN}")
    network = run.network()
    config = VlmConfig(
        backbone=backbone,
        progress_bins=weights["progress_head.4.weight"].shape[0],
        has_similarity="similarity_head.0.weight" in weights,
        size_px=run.size_px(family, network["multi_image"], resize_images),
        **network,
    )
    if (family == SMOL or config.per_frame_progress_token) and not config.multi_image:
        why = "SmolVLM" if family == SMOL else "per-frame progress tokens"
        raise CheckpointError(f"{run.file}: use_multi_image with {why}: expected true, got false")
    return config


def _check_transformers(config: VlmConfig) -> None:
    """Raises CheckpointError for SmolVLM on transformers 5, which computes other image features than in training."""
    if config.family != SMOL:
        return
    if is_at_least(5):
        expected = "transformers < 5 for a SmolVLM checkpoint, whose scores would differ"
        version = importlib.metadata.version("transformers")
        raise CheckpointError(f"transformers: expected {expected}, got {version}")


def _renames(family: Any) -> _Renames:
    return _SMOL if family == SMOL else _OLD_QWEN


def _renamed(weights: Mapping[str, Tensor], renames: _Renames) -> dict[str, Tensor]:
    def rename(name: str) -> str:
        for pattern, replacement in renames:
            changed, count = re.subn(pattern, replacement, name)
            if count:
                return changed
        return name

    return {rename(name): tensor for name, tensor in weights.items()}


def _whole(folder: Path, backbone: Mapping[str, Any], run: RunConfig) -> tuple[dict[str, Tensor], Scaling | None]:
    """The weights of the network by name, with LoRA factors if it has some; what these are scaled with."""
    tensors, scaling = read_weights(folder), None
    quantized = next((name for name in tensors if _QUANTIZED.search(name)), None)
    if quantized is not None:
        raise CheckpointError(f"{folder}: expected weights in full precision, got {shown(quantized)}; {UNQUANTIZED}")
    if any(LORA_NAME.fullmatch(name) for name in tensors):
        tensors, scaling = _renamed(tensors, _LORA_INSIDE), Scaling.of(run.file, run.sections["peft"])
        if is_there(folder / ADAPTER_CONFIG):
            scaling.check_equal(Scaling.of(folder / ADAPTER_CONFIG, read_json(folder / ADAPTER_CONFIG)))
    return _renamed(tensors, _renames(backbone["model_type"])), scaling


def _used(tensors: Mapping[str, Tensor], scaling: Scaling | None = None) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The weights that a reward is made with, and their LoRA factors; ``scaling``: of these."""
    weights, factors = split(tensors, scaling)
    weights = {name: tensor for name, tensor in weights.items() if not _UNUSED.fullmatch(name)}
    return weights, {name: tensor for name, tensor in factors.items() if changed_by(name) in weights}


def _check_layers(config: Any) -> None:
    """Raises CheckpointError for so many layers that making them would not end."""
    inner = config.values() if isinstance(config, dict) else config if isinstance(config, list) else ()
    for part in inner:
        _check_layers(part)
    for name in _LAYER_COUNTS if isinstance(config, dict) else ():
        count = config.get(name)
        if isinstance(count, (int, float)) and count > MAX_LAYERS:
            raise CheckpointError(f"{NETWORK_CONFIG}: {name}: expected at most {MAX_LAYERS}, got {shown(count)}")


def _adapted(folder: Path, base_model: str) -> tuple[dict[str, Any], dict[str, Tensor], Scaling]:
    """Configuration of the base model's backbone; its weights with those of the adapter; what its factors are scaled
    with.
    """
    file = folder / ADAPTER_CONFIG
    adapter_config = read_json(file)
    scaling = Scaling.of(file, adapter_config)
    check_adapter(file, adapter_config)
    if not is_there(folder / ADAPTER_WEIGHTS):
        refuse_pickles(folder, ADAPTER_WEIGHTS, Path(ADAPTER_WEIGHTS).stem)
    adapter = _renamed(_renamed(read_tensors(folder / ADAPTER_WEIGHTS), _ADAPTER), _OLD_QWEN)
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
        raise CheckpointError(f"base model {base_model}: missing keys: {sorted(loaded['missing_keys'])}")
    config = backbone_config(network.config.to_dict(), base_model)
    return config, {f"model.{name}": tensor for name, tensor in network.state_dict().items()}
