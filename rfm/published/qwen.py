# SPDX-License-Identifier: MIT
"""A Qwen backbone's config.json and weights from transformers, in a form that versions 4.57 and 5 read alike.

Transformers 5 keeps a rotary embedding's settings in ``rope_parameters``, which 4.57 ignores. Before 4.52, a Qwen2.5-VL
had no ``text_config``. Weights do not show how positions were rotated, so no such setting has a default.

The chat template writes a video as vision start, pad, vision end. The processor writes a time, vision start, pads and
vision end for each temporal patch. Before transformers 5.10 (checked: 4.57.6, 5.5.4, 5.9.0) these replace all three
tokens: the form is bare. Since 5.10 (checked: 5.10.1, 5.10.4, 5.24.0) they replace only the pad, so one more vision
start and end remain around the video: the form is wrapped. Images, and Qwen2.5-VL videos, did not change.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

from torch import Tensor

from rfm.config import VideoPrompt
from rfm.files import CheckpointError, shown
from rfm.published.provenance import Assumption
from rfm.qwen.network import BACKBONES, BARE, QWEN_2_5, WRAPPED

VISION_THETA = 10_000.0  # a constant in transformers 4.57's code, for every backbone
# Required fields in text_config and vision_config: no weight's shape shows them, and transformers has defaults.
_NEEDED = {
    QWEN_2_5: (
        ("num_attention_heads", "rms_norm_eps"),
        ("num_heads", "patch_size", "window_size", "fullatt_block_indexes"),
    ),
    "qwen3_vl": (("num_attention_heads", "rms_norm_eps"), ("num_heads", "patch_size", "deepstack_visual_indexes")),
}
_TIED = "tie_word_embeddings"
# Fields that stay outside text_config, in a Qwen2.5-VL from before text_config.
_OUTSIDE_TEXT_CONFIG = (
    "architectures", "dtype", "image_token_id", "model_type", _TIED, "torch_dtype",
    "transformers_version", "video_token_id", "vision_config", "vision_end_token_id", "vision_start_token_id",
    "vision_token_id",
)  # fmt: skip
NF4 = "bitsandbytes nf4"  # a result from ``quantization``
_ROPE = ("rope_theta", "rope_scaling", "rope_parameters", "partial_rotary_factor")
UNQUANTIZED = (
    "export the checkpoint that was quantized (its scores differ), or load this one with the code that trained it, "
    "and after model.dequantize() save model.state_dict() with safetensors"
)
_COPY = "copy it from config.json of the base model"


def backbone_config(content: Mapping[str, Any], where: object) -> dict[str, Any]:
    """Return the configuration with ``rope_theta`` and ``rope_scaling`` in its ``text_config``.

    where: its file
    Raises CheckpointError for a missing setting, or two that disagree.
    """
    family = content.get("model_type")
    if family not in BACKBONES:
        raise CheckpointError.at(f"{where}: model_type", f"one of {', '.join(BACKBONES)}", shown(family))
    config = _nested(content) if family == QWEN_2_5 and "text_config" not in content else {**content}
    for part, needed in zip(("text_config", "vision_config"), _NEEDED[family], strict=True):
        if not isinstance(config.get(part), dict):
            raise CheckpointError.at(f"{where}: {part}", "settings of the backbone", shown(config.get(part)))
        for name in needed:
            if config[part].get(name) is None:
                raise CheckpointError.at(f"{where}: {part}.{name}", "a value", "none", _COPY)
    config["text_config"] = _text(config["text_config"], f"{where}: text_config")
    config["vision_config"] = _vision(config["vision_config"], f"{where}: vision_config")
    return config


def quantization(config: Any) -> str | None:
    """Return how weights were rounded to fewer bits, with bitsandbytes' type; None: they were not."""
    found = config.get("quantization_config") if isinstance(config, dict) else None
    if not found or not isinstance(found, dict):
        return str(found) if found else None
    method = str(found.get("quant_method"))
    kind = "int8" if found.get("load_in_8bit") else found.get("bnb_4bit_quant_type")
    return f"{method} {kind}" if kind and method == "bitsandbytes" else method


def check_not_quantized(config: Mapping[str, Any], where: object, remedy: str) -> None:
    """Raise CheckpointError, ending with ``remedy``, if the configuration states weights rounded to fewer bits."""
    for part in (config, config.get("text_config")):
        if (found := quantization(part)) is not None:
            raise CheckpointError.at(f"{where}: quantization_config", "none", shown(found), remedy)


def _nested(content: Mapping[str, Any]) -> dict[str, Any]:
    """Move the text model's fields into ``text_config``, as transformers does since 4.52, which copies the tie."""
    rest = {name: value for name, value in content.items() if name in _OUTSIDE_TEXT_CONFIG}
    text = {name: value for name, value in content.items() if name not in _OUTSIDE_TEXT_CONFIG or name == _TIED}
    return rest | {"text_config": text | {"model_type": f"{QWEN_2_5}_text"}}


def _text(config: dict[str, Any], where: str) -> dict[str, Any]:
    rope = _rope(config, where)
    theta = rope.pop("rope_theta", None)
    if type(theta) not in (int, float) or not 0 < theta < math.inf:
        raise CheckpointError.at(f"{where}.rope_theta", "a number above 0", shown(theta), _COPY)
    if not isinstance(rope.get("mrope_section"), list):
        got = shown(rope.get("mrope_section"))
        raise CheckpointError.at(f"{where}.rope_scaling.mrope_section", "a list of numbers", got, _COPY)
    rest = {name: value for name, value in config.items() if name not in _ROPE}
    return rest | {"rope_theta": float(theta), "rope_scaling": None if rope == {"rope_type": "default"} else rope}


def _rope(config: dict[str, Any], where: str) -> dict[str, Any]:
    """Return the rotary embedding's settings from both forms. Raises CheckpointError if the forms disagree."""
    rope: dict[str, Any] = {}
    for part in ("rope_parameters", "rope_scaling"):
        section = config.get(part) or {}
        if not isinstance(section, dict):
            raise CheckpointError.at(f"{where}.{part}", "a mapping", shown(section))
        _add(rope, section, where, part)
    _add(rope, {name: config.get(name) for name in ("rope_theta", "partial_rotary_factor")}, where, "text_config")
    if config.get("rope_interleaved"):
        raise CheckpointError.at(f"{where}.rope_interleaved", "false", shown(config["rope_interleaved"]), _COPY)
    partial = rope.pop("partial_rotary_factor", 1)
    if partial != 1:
        raise CheckpointError.at(f"{where}.partial_rotary_factor", "1", shown(partial), _COPY)
    return {"rope_type": "default"} | rope


def _add(rope: dict[str, Any], section: Mapping[str, Any], where: str, part: str) -> None:
    for name, value in section.items():
        name = "rope_type" if name == "type" else name  # an older name
        value = "default" if name == "rope_type" and value == "mrope" else value  # an older value
        if value is not None and rope.setdefault(name, value) != value:
            got = f"{shown(rope[name])} and {shown(value)}"
            raise CheckpointError.at(where, f"one value of {name} in {part}", got, _COPY)


def _vision(config: dict[str, Any], where: str) -> dict[str, Any]:
    """Remove the rotary embedding's settings, which transformers 5 writes and 4.57 has in its code."""
    rope = config.get("rope_parameters") or {}
    theta = rope.get("rope_theta", VISION_THETA) if isinstance(rope, dict) else rope
    kind = rope.get("rope_type", "axial") if isinstance(rope, dict) else rope
    if theta != VISION_THETA or kind not in ("axial", "default"):
        expected = "axial with a rope_theta of 10000"
        raise CheckpointError.at(f"{where}.rope_parameters", expected, shown(rope), _COPY)
    for name in ("patch_size", "spatial_merge_size", "temporal_patch_size"):
        _check_count(config.get(name, 1), f"{where}.{name}")
    return {name: value for name, value in config.items() if name != "rope_parameters"}


def _check_count(value: object, where: str) -> None:
    if type(value) is not int or value < 1:
        raise CheckpointError.at(where, "a whole number of at least 1", shown(value), _COPY)


# Renames for one form of weights. The first pattern that matches a name is applied.
Renames: TypeAlias = Sequence[tuple[str, str]]
LORA_INSIDE: Renames = ((r"^(model(\.\w+)?)\.base_model\.model\.", r"\1."),)
ADAPTER_NAMES: Renames = ((r"^base_model\.model\.", "model."),)
# For Qwen backbone names from transformers before 4.52, and in some cases since.
QWEN_NAMES: Renames = (
    (r"^visual\.", "model.visual."),
    (r"^model\.(embed_tokens|layers|norm)\.", r"model.language_model.\1."),
)
# Weights without effect on scores: the head that generates text, and rotary frequencies, which transformers computes.
UNUSED = re.compile(r"(model\.)?lm_head\.weight|.*\.(rotary_emb|rotary_pos_emb)\.(original_)?inv_freq")
# Tensors that bitsandbytes, GPTQ, AWQ and FP8 write beside or instead of a weight.
QUANTIZED = re.compile(
    r"\.(absmax|quant_map|nested_absmax|SCB|qweight|qzeros|weight_packed|weight_scale|weight_scale_inv)$|\.quant_state\."
)


def renamed(weights: Mapping[str, Tensor], renames: Renames) -> dict[str, Tensor]:
    """Return the weights under new names. Raises CheckpointError if two names become equal."""

    def rename(name: str) -> str:
        for pattern, replacement in renames:
            changed, count = re.subn(pattern, replacement, name)
            if count:
                return changed
        return name

    names = {rename(name): name for name in weights}
    if len(names) < len(weights):
        twice = next(name for name in weights if names[rename(name)] != name)
        got = f"{shown(twice)} and {shown(names[rename(twice)])}"
        raise CheckpointError.at(rename(twice), "one weight", got, "remove the one that is not meant")
    return {name: weights[old] for name, old in names.items()}


WRAPPED_SINCE = (5, 10)  # 5.10.1 is its first published release
_TRANSFORMERS_VERSION = re.compile(r"(\d+)\.(\d+)")
_SETTING, _STATED = "video_prompt", "transformers_version"


def decided(
    given: VideoPrompt | None, backbone: Mapping[str, Any], file: str, *, may_be_saved_later: bool = False
) -> tuple[VideoPrompt, tuple[Assumption, ...]]:
    """Return the form of a checkpoint's video prompts, and the form as an assumption if no file proves it.

    given: the caller's option
    backbone: config.json as transformers saved it with the weights; empty: the run has no such file
    file: its name, for the source
    may_be_saved_later: a later transformers version than in training may have saved the file
    """
    if given is not None:
        return given, ()
    stated = str(backbone.get(_STATED))
    match = _TRANSFORMERS_VERSION.match(stated)
    if match is None:
        source = f"default, as no file tells the run's {_STATED}; --video-prompt names the form"
        return BARE, (Assumption(_SETTING, BARE, source),)
    form: VideoPrompt = WRAPPED if (int(match[1]), int(match[2])) >= WRAPPED_SINCE else BARE
    is_assumed = form == WRAPPED and may_be_saved_later
    return form, (Assumption(_SETTING, form, f"{file}: {_STATED} {stated}"),) if is_assumed else ()
