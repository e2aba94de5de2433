# SPDX-License-Identifier: MIT
"""Read RFM and Robometer checkpoints: whole weights, optionally with LoRA factors, or an adapter to a base model.

Every format has a rename table, which maps weight names to VlmRewardModel's.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from torch import Tensor

from rfm.config import CheckpointConfig
from rfm.families.robometer.checkpoint import VlmCheckpoint, restore
from rfm.families.robometer.network import VlmConfig
from rfm.families.robometer.prompts import OLD_RUN_REMEDY, VlmCollator
from rfm.files import (
    ADAPTER_CONFIG,
    NETWORK_CONFIG,
    CheckpointError,
    expecting,
    is_there,
    network_config,
    read_json,
)
from rfm.published.lora import adapted, has_adapter, scaled_inside
from rfm.published.provenance import Assumption
from rfm.published.qwen import (
    UNQUANTIZED,
    UNUSED,
    backbone_config,
    check_not_quantized,
    decided,
)
from rfm.published.reader import Loaded, Reader
from rfm.published.robometer_run import (
    LEROBOT_BACKBONE,
    RunConfig,
    assumptions_of,
    base_of_adapter,
    check_bins,
    is_lerobot,
    lerobot_run,
    lerobot_weights,
)
from rfm.published.rounding import kind_of, read_published, read_unrounded_config
from rfm.published.run_config import check_progress
from rfm.published.weights import has_head, read_weights
from rfm.qwen.collator import Chat, Visual
from rfm.qwen.lora import changed_by, split
from rfm.qwen.network import BACKBONES, QWEN3, QWEN_2_5
from rfm.saved import PROCESSOR_FOLDER, is_saved


def reads(folder: Path) -> bool:
    """True if the folder holds an adapter, a network on a known backbone, or LeRobot's Robometer."""
    if is_there(folder / ADAPTER_CONFIG):
        return True
    content = network_config(folder)
    model_type = content.get("model_type")
    return is_lerobot(content) or (isinstance(model_type, str) and model_type in BACKBONES)


def load(folder: Path, options: CheckpointConfig) -> Loaded:
    """Load a checkpoint from a local folder. Raises CheckpointError."""
    checkpoint, assumptions = (restore(folder), ()) if is_saved(folder) else _published(folder, options)
    base_model, config = options.base_model, checkpoint.config
    has_processor = base_model is None and isinstance(checkpoint.processor, Path)
    checkpoint = replace(checkpoint, processor=base_model or checkpoint.processor)
    checkpoint.check()
    if base_model is not None and re.fullmatch(_PUBLISHED_NAMES[config.family], config.base_model_id):
        _check_published(checkpoint.collator, base_model)
    return Loaded(checkpoint, assumptions, partial(_notes, has_processor=has_processor))


def _check_published(collator: VlmCollator, processor: str) -> None:
    """Raise CheckpointError if a processor that replaces the published one differs from it."""
    if found := _differences(collator):
        named = collator.config.base_model_id
        raise CheckpointError(
            f"base model {processor}: expected a processor like that of {named}, which the run names: "
            f"{'; '.join(found)}; name a folder with the files of {named} with --base-model, or correct "
            "model.base_model_id of the run's config.yaml"
        )


def _notes(checkpoint: VlmCheckpoint, *, has_processor: bool) -> list[str]:
    """Return one line per sign that prompts, images or positions differ from those in training.

    has_processor: the processor is the checkpoint's own
    """
    config, lines = checkpoint.config, []
    if not has_processor and (found := _differences(checkpoint.collator)):
        known = f"the published processors of {config.family}"
        lines.append(f"base model {checkpoint.processor}: differs from {known} in {'; '.join(found)}")
    version = str(config.backbone.get("transformers_version"))
    major = version.partition(".")[0]
    if config.family == QWEN_2_5 and not config.multi_image and major.isdigit() and int(major) >= 5:
        lines.append(
            f"{NETWORK_CONFIG}: transformers_version is {version}: text behind a video stands where transformers 4 "
            "puts it; if the run was trained with transformers 5, which puts it elsewhere, scores differ from the "
            "run's"
        )
    return lines


_Read: TypeAlias = tuple[VlmConfig, dict[str, Tensor], dict[str, Tensor], tuple[Assumption, ...]]


def _published(folder: Path, options: CheckpointConfig) -> tuple[VlmCheckpoint, tuple[Assumption, ...]]:
    with expecting("a vision-language checkpoint", folder):
        content = {} if has_adapter(folder) else read_json(folder / NETWORK_CONFIG)
        read = _by_lerobot if is_lerobot(content) else _trained
        config, weights, factors, assumptions = read(folder, content, options.base_model)
        if config.family == QWEN3 and not config.multi_image:
            file = f"{NETWORK_CONFIG}: {LEROBOT_BACKBONE}" if is_lerobot(content) else NETWORK_CONFIG
            # An adapter has no config.json: another transformers may have saved its base model.
            form, of_form = decided(options.video_prompt, config.backbone if content else {}, file)
            config, assumptions = replace(config, video_prompt=form), (*assumptions, *of_form)
    own = folder / PROCESSOR_FOLDER
    return VlmCheckpoint(config, weights, own if own.is_dir() else config.base_model_id, factors), assumptions


def _by_lerobot(folder: Path, content: Mapping[str, Any], base_model: str | None) -> _Read:
    """Read a Robometer that LeRobot saved, with every setting in config.json."""
    file = folder / NETWORK_CONFIG
    run = lerobot_run(content, file)
    backbone = backbone_config(content[LEROBOT_BACKBONE], f"{file}: {LEROBOT_BACKBONE}")
    check_not_quantized(backbone, file, UNQUANTIZED)
    weights, factors = _used(lerobot_weights(read_weights(folder), backbone))
    check_bins(content, weights, file)
    config = _config(folder, backbone, run, weights)
    return config, weights, factors, assumptions_of(config, run, base_model)


def _trained(folder: Path, content: Mapping[str, Any], base_model: str | None) -> _Read:
    """Read a training run's checkpoint, with the run's config.yaml. content: {} for an adapter."""
    file = folder / NETWORK_CONFIG
    backbone = backbone_config(content, file) if content else {}
    is_nf4, num_nf4 = read_unrounded_config(backbone, file), 0
    run = RunConfig.of(folder)
    run.check_model_type()
    check_progress(run.sections, run.file)
    if content:
        tensors, num_nf4 = read_published(folder, is_nf4)
        tensors = scaled_inside(tensors, folder, backbone, run.file, run.sections["peft"])
    else:
        backbone, tensors = adapted(folder, base_model or base_of_adapter(folder, run))
    weights, factors = _used(tensors)
    config = _config(folder, backbone, run, weights)
    return config, weights, factors, assumptions_of(config, run, base_model, num_nf4)


def _config(
    folder: Path,
    backbone: dict[str, Any],
    run: RunConfig,
    weights: Mapping[str, Tensor],
) -> VlmConfig:
    if "progress_head.4.weight" not in weights:
        raise CheckpointError.at(folder, "reward heads", "no progress_head.4.weight")
    if "frame_pool_attn.weight" not in weights:
        raise CheckpointError.at(folder, "frame_pool_attn.weight", "none", OLD_RUN_REMEDY)
    network = run.network()
    config = VlmConfig(
        backbone=backbone,
        progress_bins=weights["progress_head.4.weight"].shape[0],
        has_similarity="similarity_head.0.weight" in weights,
        size_px=run.size_px(network["multi_image"]),
        has_preference=has_head(weights, "preference"),
        has_success=has_head(weights, "success"),
        weights=kind_of(weights),
        **network,
    )
    if config.per_frame_progress_token and not config.multi_image:
        where = f"{run.file}: use_multi_image with per-frame progress tokens"
        raise CheckpointError.at(where, "true", "false")
    return config


def _used(tensors: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return the weights that scores depend on, and their LoRA factors."""
    weights, factors = split(tensors)
    weights = {name: tensor for name, tensor in weights.items() if not UNUSED.fullmatch(name)}
    return weights, {name: tensor for name, tensor in factors.items() if changed_by(name) in weights}


# The published processors by backbone family, with which another is compared.
_PUBLISHED_NAMES = {QWEN_2_5: r"Qwen/Qwen2\.5-VL-\w+-Instruct", QWEN3: r"Qwen/Qwen3-VL-\w+-Instruct"}
_QWEN_PROMPT = "<|im_start|>user\nTASK{visual} 1: <|vision_start|><|{pad}_pad|><|vision_end|><|im_end|>\n"
_FACTS: dict[str, dict[str, Any]] = {
    QWEN_2_5: {
        "prompt": f"<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n{_QWEN_PROMPT}",
        "image_mean": (0.48145466, 0.4578275, 0.40821073),
        "image_std": (0.26862954, 0.26130258, 0.27577711),
    },
    QWEN3: {"prompt": _QWEN_PROMPT, "image_mean": (0.5,) * 3, "image_std": (0.5,) * 3},
}


def _differences(collator: VlmCollator) -> list[str]:
    """Return the differences between a processor and those published for its backbone family."""
    is_image = collator.config.multi_image
    words = {"visual": "Picture", "pad": "image"} if is_image else {"visual": "Video", "pad": "video"}
    known = {**_FACTS[collator.config.family]}
    known["prompt"] = known["prompt"].format(**words)
    text = Chat(collator.tokenizer).text(("TASK", Visual.IMAGE if is_image else Visual.VIDEO))
    got = {"prompt": text, **collator.images.to_config()}
    return [f"{name}: expected {value!r}, got {got[name]!r}" for name, value in known.items() if got[name] != value]


READER = Reader(reads, load)
