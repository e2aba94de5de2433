# SPDX-License-Identifier: MIT
"""What decided each setting of a vision-language checkpoint."""

from __future__ import annotations

from rfm.checkpoint.decision import OF_WEIGHTS, TRAINED_WITH_PADDING, Decision, source_name
from rfm.checkpoint.files import ADAPTER_CONFIG, NETWORK_CONFIG
from rfm.version_folder import PROCESSOR_FOLDER
from rfm.vlm.adapter import model_name
from rfm.vlm.backbone import QWEN_2_5
from rfm.vlm.collator import VlmCollator
from rfm.vlm.lora import Scaling
from rfm.vlm.network import VlmConfig
from rfm.vlm.prompts import SPECIAL_TOKENS
from rfm.vlm.published import facts
from rfm.vlm.run_config import SETTINGS, RunConfig

_BASE_MODEL = "--base-model"


def of_run(
    config: VlmConfig, run: RunConfig, base_model: str | None, scaling: Scaling | None, *, is_adapter: bool
) -> tuple[Decision, ...]:
    """The decisions about a checkpoint as training wrote it.

    base_model: the one that the caller names
    scaling: of LoRA factors; None: there are none
    is_adapter: the base model's weights are not in the checkpoint
    """
    base = _base_model(config.base_model_id, run, base_model)
    backbone = f"{NETWORK_CONFIG} of base_model" if is_adapter else NETWORK_CONFIG
    lora = [] if scaling is None else [_lora(scaling, run)]
    return (
        Decision("backbone", config.family, backbone),
        base,
        *lora,
        *_of_weights(config),
        *(run.decision(name, getattr(config, name)) for name in _deciding(config)),
        TRAINED_WITH_PADDING,
        *_positions(config),
    )


def of_export(config: VlmConfig, base_model: str | None) -> tuple[Decision, ...]:
    """The decisions about a checkpoint that ``rfm export`` wrote: its config.json has every setting."""
    stated = Decision("base_model", source_name(config.base_model_id), NETWORK_CONFIG)
    given = None if base_model is None else Decision("base_model", source_name(base_model), _BASE_MODEL)
    return (
        Decision("backbone", config.family, NETWORK_CONFIG),
        given or stated,
        *_of_weights(config),
        *(Decision(name, getattr(config, name), NETWORK_CONFIG) for name in _deciding(config)),
        TRAINED_WITH_PADDING,
    )


def of_rounding(num_nf4: int) -> list[Decision]:
    """The decision about weights in NF4, which may have been rounded after training. ``num_nf4``: how many they are."""
    rounded = f"{num_nf4} in NF4 of bitsandbytes"
    source = f"{OF_WEIGHTS}, rounded in training too"
    return [Decision("rounded_weights", rounded, source, is_assumed=True)] if num_nf4 else []


def of_processor(collator: VlmCollator, source: object) -> list[Decision]:
    """The decisions about prompts and images. ``source``: folder or id of the processor."""
    name = f"processor of {source_name(str(source))}" if source != PROCESSOR_FOLDER else f"{PROCESSOR_FOLDER}/"
    tokens = [collator.tokenizer.convert_tokens_to_ids(token) for token in SPECIAL_TOKENS]
    read = [Decision(fact, value, name) for fact, value in facts(collator).items()]
    return [*read, Decision("special_tokens", tokens, "weights: last rows of the embedding")]


def _of_weights(config: VlmConfig) -> list[Decision]:
    names = ("progress_bins", "has_similarity", "has_preference", "has_success")
    return [Decision(name, getattr(config, name), OF_WEIGHTS) for name in names]


def _deciding(config: VlmConfig) -> list[str]:
    """The SETTINGS that change something about this checkpoint."""
    idle = {"average_temporal_patches", "size_px"} if config.multi_image else set()
    idle |= set() if config.pools_images else {"frame_pooling"}
    idle |= set() if config.pools_by_attention else {"pooling_temperature"}
    return [name for name in SETTINGS if name not in idle]


def _base_model(named: str, run: RunConfig, given: str | None) -> Decision:
    """Where the tokenizer and image preprocessing are from, and of an adapter what it changes."""
    if given is None:
        return Decision("base_model", source_name(named), f"{run.name}: model.base_model_id")
    if not named or model_name(named) in given.lower():
        return Decision("base_model", source_name(given), _BASE_MODEL)
    source = f"{_BASE_MODEL}, for {named} of {run.name}"
    return Decision("base_model", source_name(given), source, is_assumed=True)


def _lora(scaling: Scaling, run: RunConfig) -> Decision:
    file = ADAPTER_CONFIG if scaling.file.name == ADAPTER_CONFIG else f"{run.name}: peft"
    return Decision("lora", {"r": scaling.rank, "lora_alpha": scaling.alpha}, f"{file}: r, lora_alpha")


def _positions(config: VlmConfig) -> list[Decision]:
    """What decides positions behind a video, which transformers changed, of a Qwen2.5-VL."""
    if config.family != QWEN_2_5 or config.multi_image:
        return []
    version = config.backbone.get("transformers_version")
    stated = f"{NETWORK_CONFIG}: transformers_version {version}"
    source = stated if str(version).startswith("4.") else "default: no file names transformers 4"
    is_assumed = version is None  # of a later version, VlmCheckpoint.notes tells
    return [Decision("positions_behind_videos", "as transformers 4", source, is_assumed=is_assumed)]
