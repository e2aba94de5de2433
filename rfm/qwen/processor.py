# SPDX-License-Identifier: MIT
"""A base model's tokenizer and preprocessing, in transformers' files.

Every setting that transformers 4.57 to 5.24 write into preprocessor_config.json, video_preprocessor_config.json or
processor_config.json is applied, has no effect here, or is refused unless its value leaves the pixels as they are
computed here. A null means a missing key.
"""

from __future__ import annotations

import importlib.metadata
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

from rfm.engine.layers import Normalisation
from rfm.files import (
    MAX_UINT8,
    PIL_BICUBIC,
    PREPROCESSOR_CONFIG,
    CheckpointError,
    is_there,
    local_copy,
    read_json,
    shown,
)
from rfm.qwen.collator import IMAGE_PAD, VIDEO_PAD, VISION_START, QwenCollator
from rfm.qwen.images import FRAMES_PER_GROUP, MERGE
from rfm.qwen.network import BackboneConfig

PROCESSOR_CONFIG = "processor_config.json"
VIDEO_PREPROCESSOR_CONFIG = "video_preprocessor_config.json"
# Preprocessing files, and their keys in transformers 5's PROCESSOR_CONFIG.
IMAGE_PREPROCESSOR = (PREPROCESSOR_CONFIG, "image_processor")
VIDEO_PREPROCESSOR = (VIDEO_PREPROCESSOR_CONFIG, "video_processor")
Settings: TypeAlias = Mapping[str, Any]
_ALL: Settings = {
    "do_rescale": True, "rescale_factor": 1 / MAX_UINT8, "do_normalize": True, "do_center_crop": False,
}  # fmt: skip
_QWEN_SETTINGS = {**_ALL, "do_pad": False, "merge_size": MERGE, "temporal_patch_size": FRAMES_PER_GROUP}
_RESIZING: Settings = {
    "do_resize": True, "resample": PIL_BICUBIC, "min_pixels": None, "max_pixels": None, "cap_pixels_per_frame": False,
    "max_video_tokens": 768, "fps": 2, "num_frames": None, "min_frames": 4, "max_frames": 768,
}  # fmt: skip
# Values that leave pixels as they are computed here, by the code that trained the model or runs it.
# RFM and Robometer resize frames themselves, and turn off the processor's resizing.
SIZED_BEFORE: Settings = _QWEN_SETTINGS
SIZED_BY_PROCESSOR: Settings = {**_QWEN_SETTINGS, **_RESIZING}
# Settings that are read, and settings without effect on RGB frames.
_APPLIED = {"image_mean", "image_std", "patch_size", "resample", "size"}
_IDLE = {
    "_valid_processor_keys", "auto_map", "crop_size", "data_format", "default_to_square", "device", "disable_grouping",
    "do_convert_rgb", "do_image_splitting", "do_sample_frames", "feature_extractor_type", "image_processor_type",
    "image_seq_length", "input_data_format", "max_duration", "max_image_size", "pad_size", "processor_class",
    "return_metadata", "return_row_col_info", "return_tensors", "transformers_version", "video_metadata",
    "video_processor_type", "video_sampling",
}  # fmt: skip
_CHANNELS = 3


def read_preprocessor(processor: str | Path, file: str, key: str) -> dict[str, Any]:
    """Return the preprocessing from ``file`` and from ``key`` in transformers 5's file; videos fall back to images.

    transformers 4.57 reads the former first, transformers 5 the latter.
    Raises OSError if neither exists, CheckpointError if they disagree.
    """
    folder = local_copy(processor)
    nested, found = _optional(folder / PROCESSOR_CONFIG).get(key), _optional(folder / file)
    if nested is not None and not isinstance(nested, dict):
        raise CheckpointError.at(f"{processor}: {PROCESSOR_CONFIG}: {key}", "settings", shown(nested))
    if nested is None and not found:
        if file == VIDEO_PREPROCESSOR_CONFIG:
            return read_preprocessor(processor, *IMAGE_PREPROCESSOR)
        raise OSError(f"expected {file}, or {key} in {PROCESSOR_CONFIG}, got none")
    inner = {name: value for name, value in (nested or {}).items() if value is not None}
    for name, value in inner.items():
        if name not in _IDLE and found.get(name) not in (None, value):
            both = f"{file} with {shown(found[name])} and {key} of {PROCESSOR_CONFIG} with {shown(value)}"
            remedy = "transformers 4 reads the former, transformers 5 the latter; correct the one that is older"
            raise CheckpointError.at(f"{processor}: {name}", "one value", f"{both}: {remedy}")
    return {**found, **inner}


def _optional(file: Path) -> dict[str, Any]:
    return read_json(file) if is_there(file) else {}


def check_settings(settings: Settings, neutral: Settings, where: object) -> None:
    """Raise CheckpointError for a setting that is not applied and differs from its neutral value.

    neutral: SIZED_BEFORE or SIZED_BY_PROCESSOR
    """
    idle = (_IDLE | _APPLIED | _RESIZING.keys()) - neutral.keys()
    for name, value in settings.items():
        if value is None or name in idle:
            continue
        if name in neutral and _is_same(value, neutral[name]):
            continue
        if name not in neutral and value in (False, {}, []):
            continue
        usual = "1/255" if name == "rescale_factor" else json.dumps(neutral.get(name))
        expected = usual if name in neutral else "a known setting"
        got = f"{_text(value)}, which is not applied here and may change pixels"
        remedy = (
            "if the model was trained without it, remove it from a copy of the folder and name that with --base-model"
        )
        raise CheckpointError.at(f"{where}: {name}", expected, got, remedy)


def _text(value: Any) -> str:
    return json.dumps(value) if isinstance(value, bool) else shown(value)


def _is_same(value: Any, neutral: Any) -> bool:
    if type(neutral) in (int, float):
        return type(value) in (int, float) and math.isclose(value, neutral, rel_tol=0, abs_tol=1e-9)
    return type(value) is type(neutral) and bool(value == neutral)


def normalisation_of(settings: Settings, neutral: Settings, where: object) -> Normalisation:
    """Return the normalisation in a preprocessor's settings. Raises CheckpointError, as ``check_settings``."""
    check_settings(settings, neutral, where)
    mean, std = (_numbers(settings, name, where) for name in ("image_mean", "image_std"))
    if min(std) <= 0:
        raise CheckpointError.at(f"{where}: image_std", "numbers above 0", shown(settings["image_std"]))
    return Normalisation(mean, std)


def pixel_limits(settings: Settings, where: object) -> dict[str, int]:
    """Return an image's least and most pixels, ``least_px`` and ``most_px``. Raises CheckpointError.

    ``min_pixels`` and ``max_pixels``, if set, override ``size``, as in transformers.
    """
    size = settings.get("size")
    stated = {**size} if isinstance(size, Mapping) else {}
    found: dict[str, Any] = {}
    for name, edge, own in (("least_px", "shortest_edge", "min_pixels"), ("most_px", "longest_edge", "max_pixels")):
        found[name] = stated.get(edge) if settings.get(own) is None else settings[own]
    if not all(type(value) is int for value in found.values()):
        raise CheckpointError.at(f"{where}: size", "shortest_edge and longest_edge", shown(size))
    return found


def patch_px(settings: Settings, vision: Settings, where: object) -> int:
    """Return a patch's side, on which preprocessor and vision tower must agree. Raises CheckpointError."""
    expected, stated = vision["patch_size"], settings.get("patch_size")
    if type(stated) is not int or stated != expected:
        got = "none" if stated is None else shown(stated)
        raise CheckpointError.at(f"{where}: patch_size", f"{expected}, as vision_config of config.json", got)
    return stated


def _numbers(settings: Settings, name: str, where: object) -> tuple[float, ...]:
    values = settings.get(name)
    each = values if isinstance(values, list) else []
    if len(each) != _CHANNELS or not all(type(value) in (int, float) and math.isfinite(value) for value in each):
        raise CheckpointError.at(f"{where}: {name}", f"{_CHANNELS} numbers", shown(values))
    return tuple(map(float, each))


TOKENIZER_CONFIG = "tokenizer_config.json"
# TOKENIZER_CONFIG fields that transformers 4.57 and 5 read alike; the rest is in tokenizer.json.
_KEPT = (
    "bos_token", "clean_up_tokenization_spaces", "eos_token", "model_max_length", "pad_token", "padding_side",
    "unk_token",
)  # fmt: skip
# Token id fields in a backbone's config.json.
_STATED_TOKENS = {"image_token_id": IMAGE_PAD, "video_token_id": VIDEO_PAD, "vision_start_token_id": VISION_START}


def read_processor(processor: str | Path, *, videos: bool = False) -> tuple[Any, dict[str, Any]]:
    """Return the tokenizer, with its chat template, and the image preprocessing from a folder or Hub id.

    videos: return the video preprocessing instead
    Raises CheckpointError.
    """
    try:
        folder = local_copy(processor)
        tokenizer = _tokenizer(folder)
        preprocessor = read_preprocessor(processor, *(VIDEO_PREPROCESSOR if videos else IMAGE_PREPROCESSOR))
        tokenizer.chat_template = _chat_template(folder, tokenizer)
    except (LookupError, OSError, ValueError) as error:
        hint = "name its folder with --base-model"
        raise CheckpointError(f"base model {processor}: tokenizer and processor: {error} ({hint})") from error
    return tokenizer, preprocessor


def check_tokens(
    config: BackboneConfig, tokenizer: Any, processor: str | Path, expected: Mapping[str, int] | None = None
) -> None:
    """Raise CheckpointError unless the tokenizer has the ids in the backbone's config.json and ``expected``."""
    stated = {token: config.backbone.get(name) for name, token in _STATED_TOKENS.items()}
    expected = {**(expected or {}), **{token: number for token, number in stated.items() if type(number) is int}}
    for token, number in expected.items():
        got = tokenizer.convert_tokens_to_ids(token)
        if got != number:
            where = f"base model {processor}: {token}"
            remedy = "name the base model as it was published with --base-model"
            raise CheckpointError.at(where, f"token {number}, with which the checkpoint was trained", got, remedy)


def _tokenizer(folder: Path) -> Any:
    """Load the tokenizer, even if transformers 5 wrote its configuration, which 4.57 does not read."""
    from transformers import AutoTokenizer, PreTrainedTokenizerFast

    config = read_json(_required(folder / TOKENIZER_CONFIG))
    special = config.get("extra_special_tokens")
    if not isinstance(special, list) or not importlib.metadata.version("transformers").startswith("4."):
        return AutoTokenizer.from_pretrained(str(folder), use_fast=True, trust_remote_code=False)
    kept = {name: config[name] for name in _KEPT if name in config}
    file = _required(folder / "tokenizer.json")
    return PreTrainedTokenizerFast(tokenizer_file=str(file), additional_special_tokens=special, **kept)


def _required(file: Path) -> Path:
    if not is_there(file):
        raise OSError(f"expected {file.name}, got none")
    return file


def _chat_template(folder: Path, tokenizer: Any) -> str:
    """Return the processor's chat template, which upstream uses, or else the tokenizer's. Raises ValueError."""
    from transformers import ProcessorMixin

    of_processor = ProcessorMixin.get_processor_dict(str(folder))[0].get("chat_template")
    template = tokenizer.chat_template if of_processor is None else of_processor
    if isinstance(template, dict):  # several templates by name
        template = template.get("default")
    if not isinstance(template, str):
        raise ValueError("expected a chat template, got none")
    return template


def save_processor(collator: QwenCollator, folder: Path) -> None:
    """Write the files that ``load_collator`` reads, so that serving needs no internet."""
    collator.tokenizer.save_pretrained(folder)
    (folder / PREPROCESSOR_CONFIG).write_text(json.dumps(collator.images.to_config(), indent=2) + "\n")
