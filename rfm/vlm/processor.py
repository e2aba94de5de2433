# SPDX-License-Identifier: MIT
"""Load, check and save a base model's tokenizer and image preprocessing, in transformers' files."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rfm.checkpoint.content import PREPROCESSOR_CONFIG, CheckpointError, is_there, read_json
from rfm.checkpoint.hub import local_copy
from rfm.vlm.backbone import QWEN_2_5, is_at_least
from rfm.vlm.collator import (
    IMAGE_PAD,
    QWEN3,
    VIDEO_PAD,
    VISION_START,
    QwenCollator,
    VlmCollator,
)
from rfm.vlm.images import FRAMES_PER_GROUP, MERGE, QwenImages, fitted_size
from rfm.vlm.network import BackboneConfig, VlmConfig
from rfm.vlm.preprocessor import (
    OF_IMAGES,
    OF_VIDEOS,
    SIZED_BEFORE,
    normalisation_of,
    patch_px,
    read_preprocessor,
)
from rfm.vlm.prompts import OLD_SPECIAL_TOKENS, SPECIAL_TOKENS, Chat, Visual
from rfm_client.contract import FrameSize

TOKENIZER_CONFIG = "tokenizer_config.json"
# Fields of TOKENIZER_CONFIG that transformers 4.57 and 5 read alike; the rest is in tokenizer.json.
_KEPT = (
    "bos_token", "clean_up_tokenization_spaces", "eos_token", "model_max_length", "pad_token", "padding_side",
    "unk_token",
)  # fmt: skip
# Fields of a backbone's config.json with token ids.
_STATED_TOKENS = {"image_token_id": IMAGE_PAD, "video_token_id": VIDEO_PAD, "vision_start_token_id": VISION_START}


def frame_size(config: VlmConfig) -> FrameSize | None:
    """Return the size to which a checkpoint first resizes each frame; None: it depends on the frame."""
    if config.size_px is None:
        return None
    factor = config.backbone["vision_config"]["patch_size"] * MERGE * (1 if config.multi_image else FRAMES_PER_GROUP)
    return FrameSize("exact", fitted_size(*config.size_px, factor))


def load_collator(config: VlmConfig, num_tokens: int, processor: str | Path) -> VlmCollator:
    """Load the collator of a checkpoint. Raises CheckpointError for a processor that is missing or does not fit.

    num_tokens: rows of the checkpoint's token embedding
    processor: folder or id with tokenizer and image preprocessing
    """
    tokenizer, preprocessor = read_processor(processor, videos=not config.multi_image)
    tokenizer.add_tokens(list(SPECIAL_TOKENS), special_tokens=True)
    if len(tokenizer) != num_tokens:  # upstream resizes the embedding to the tokenizer
        expected = f"a tokenizer of {num_tokens} tokens with the special ones, as the checkpoint's embedding"
        is_old = num_tokens - len(tokenizer) == OLD_SPECIAL_TOKENS - len(SPECIAL_TOKENS)
        hint = (
            f" (with {OLD_SPECIAL_TOKENS} special tokens, as upstream before 2026-01-21, it would fit)"
            if is_old
            else ""
        )
        raise CheckpointError.at(f"base model {processor}", expected, f"{len(tokenizer)}{hint}")
    _check_tokens(config, tokenizer, processor)
    return _collator(config, tokenizer, preprocessor, processor)


def read_processor(processor: str | Path, *, videos: bool = False) -> tuple[Any, dict[str, Any]]:
    """Return the tokenizer, with its chat template, and the preprocessing of images in a folder or of a Hub id.

    videos: the preprocessing of videos in its place
    Raises CheckpointError.
    """
    try:
        folder = local_copy(processor)
        tokenizer = _tokenizer(folder)
        preprocessor = read_preprocessor(processor, *(OF_VIDEOS if videos else OF_IMAGES))
        tokenizer.chat_template = _chat_template(folder, tokenizer)
    except (LookupError, OSError, ValueError) as error:
        hint = "name its folder with --base-model"
        raise CheckpointError(f"base model {processor}: tokenizer and processor: {error} ({hint})") from error
    return tokenizer, preprocessor


def _check_tokens(config: VlmConfig, tokenizer: Any, processor: str | Path) -> None:
    first = len(tokenizer) - len(SPECIAL_TOKENS)
    check_tokens(config, tokenizer, processor, {token: first + index for index, token in enumerate(SPECIAL_TOKENS)})


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
    """Load the tokenizer, also if transformers 5 wrote its configuration, which 4.57 does not read."""
    from transformers import AutoTokenizer, PreTrainedTokenizerFast

    config = read_json(_require(folder / TOKENIZER_CONFIG))
    special = config.get("extra_special_tokens")
    if is_at_least(5) or not isinstance(special, list):
        return AutoTokenizer.from_pretrained(str(folder), use_fast=True, trust_remote_code=False)
    kept = {name: config[name] for name in _KEPT if name in config}
    file = _require(folder / "tokenizer.json")
    return PreTrainedTokenizerFast(tokenizer_file=str(file), additional_special_tokens=special, **kept)


def _require(file: Path) -> Path:
    if not is_there(file):
        raise OSError(f"expected {file.name}, got none")
    return file


def _chat_template(folder: Path, tokenizer: Any) -> str:
    """Return the processor's chat template, which upstream uses, else the tokenizer's. Raises ValueError."""
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


def _collator(config: VlmConfig, tokenizer: Any, preprocessor: dict[str, Any], processor: str | Path) -> VlmCollator:
    where = f"base model {processor}: preprocessing of {'images' if config.multi_image else 'videos'}"
    vision = config.backbone["vision_config"]
    normalisation = normalisation_of(preprocessor, SIZED_BEFORE, where)
    images = QwenImages(patch_px(preprocessor, vision, where), normalisation, config.size_px)
    return VlmCollator(config, tokenizer, images)


_EXAMPLE = "TASK"
_QWEN_PROMPT = "<|im_start|>user\nTASK{visual} 1: <|vision_start|><|{pad}_pad|><|vision_end|><|im_end|>\n"
_NAMES = {
    QWEN_2_5: r"Qwen/Qwen2\.5-VL-\w+-Instruct",
    QWEN3: r"Qwen/Qwen3-VL-\w+-Instruct",
}
_FACTS: dict[str, dict[str, Any]] = {
    QWEN_2_5: {
        "prompt": f"<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n{_QWEN_PROMPT}",
        "patch_size": 14,
        "image_mean": [0.48145466, 0.4578275, 0.40821073],
        "image_std": [0.26862954, 0.26130258, 0.27577711],
    },
    QWEN3: {"prompt": _QWEN_PROMPT, "patch_size": 16, "image_mean": [0.5] * 3, "image_std": [0.5] * 3},
}


def is_published(base_model_id: str, family: str) -> bool:
    """True for a base model whose published processor is known."""
    return re.fullmatch(_NAMES[family], base_model_id) is not None


def facts(collator: VlmCollator) -> dict[str, Any]:
    """Return a processor's effect, as JSON: the text of a conversation with an image or video, and image settings."""
    visual = Visual.IMAGE if collator.config.multi_image else Visual.VIDEO
    images = {**collator.images.to_config()}
    del images["rescale_factor"]  # the same for every processor that loads
    for name in ("image_mean", "image_std"):
        images[name] = list(images[name])
    return {"prompt": Chat(collator.tokenizer).text((_EXAMPLE, visual)), **images}


def check_published(collator: VlmCollator, processor: str) -> None:
    """Raise CheckpointError if a processor in place of a published processor differs from it."""
    found = differences(collator)
    if found:
        named = collator.config.base_model_id
        raise CheckpointError(
            f"base model {processor}: expected a processor like that of {named}, which the run names: "
            f"{'; '.join(found)}; name a folder with the files of {named} with --base-model, or correct "
            "model.base_model_id of the run's config.yaml"
        )


def differences(collator: VlmCollator) -> list[str]:
    """Return the differences between a processor and the published processors of its family of backbones."""
    words = (
        {"visual": "Picture", "pad": "image"} if collator.config.multi_image else {"visual": "Video", "pad": "video"}
    )
    known = {**_FACTS[collator.config.family]}
    known["prompt"] = known["prompt"].format(**words)
    got = facts(collator)
    return [f"{name}: expected {value!r}, got {got[name]!r}" for name, value in known.items() if got[name] != value]
