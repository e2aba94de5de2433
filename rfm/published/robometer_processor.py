# SPDX-License-Identifier: MIT
"""Compare a processor with the published ones of its family of backbones."""

from __future__ import annotations

import re
from typing import Any

from rfm.families.robometer.collator import VlmCollator
from rfm.files import CheckpointError
from rfm.qwen.collator import Chat, Visual
from rfm.qwen.network import QWEN3, QWEN_2_5

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
