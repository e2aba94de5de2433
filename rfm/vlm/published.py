# SPDX-License-Identifier: MIT
"""How the published base models show a conversation and its images, beside which other processors are held."""

from __future__ import annotations

import re
from typing import Any

from rfm.checkpoint.content import CheckpointError
from rfm.vlm.backbone import QWEN_2_5, SMOL
from rfm.vlm.chat import Chat, Visual
from rfm.vlm.collator import QWEN3, VlmCollator

_EXAMPLE = "TASK"
_OF_QWEN = "<|im_start|>user\nTASK{visual} 1: <|vision_start|><|{pad}_pad|><|vision_end|><|im_end|>\n"
_NAMES = {
    QWEN_2_5: r"Qwen/Qwen2\.5-VL-\w+-Instruct",
    QWEN3: r"Qwen/Qwen3-VL-\w+-Instruct",
    SMOL: r"HuggingFaceTB/SmolVLM2-[\w.-]+-Instruct",
}
_FACTS: dict[str, dict[str, Any]] = {
    QWEN_2_5: {
        "prompt": f"<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n{_OF_QWEN}",
        "patch_size": 14,
        "image_mean": [0.48145466, 0.4578275, 0.40821073],
        "image_std": [0.26862954, 0.26130258, 0.27577711],
    },
    QWEN3: {"prompt": _OF_QWEN, "patch_size": 16, "image_mean": [0.5] * 3, "image_std": [0.5] * 3},
    SMOL: {
        "prompt": "<|im_start|>User: TASK<image><end_of_utterance>\n",
        "resample": 1,
        "image_mean": [0.5] * 3,
        "image_std": [0.5] * 3,
    },
}


def is_published(base_model_id: str, family: str) -> bool:
    """Whether the base model is one of those whose processors are known."""
    return re.fullmatch(_NAMES[family], base_model_id) is not None


def facts(collator: VlmCollator) -> dict[str, Any]:
    """What a processor does, as JSON can hold it: the text of a conversation that shows one frame or video, and how
    images become numbers.
    """
    visual = Visual.IMAGE if collator.config.multi_image else Visual.VIDEO
    images = {**collator.images.to_config()}
    del images["rescale_factor"]  # the only one that loads
    for name in ("image_mean", "image_std"):
        images[name] = list(images[name])
    return {"prompt": Chat(collator.tokenizer, keeps=False).text((_EXAMPLE, visual)), **images}


def check_published(collator: VlmCollator, processor: str) -> None:
    """Raises CheckpointError for a processor that stands for a published one, and is another."""
    found = differences(collator)
    if found:
        named = collator.config.base_model_id
        raise CheckpointError(
            f"base model {processor}: expected a processor like that of {named}, which the run names: "
            f"{'; '.join(found)}; name a folder with the files of {named} with --base-model, or correct "
            "model.base_model_id of the run's config.yaml"
        )


def differences(collator: VlmCollator) -> list[str]:
    """Where a processor differs from the published ones of its backbone's kind."""
    words = (
        {"visual": "Picture", "pad": "image"} if collator.config.multi_image else {"visual": "Video", "pad": "video"}
    )
    known = {**_FACTS[collator.config.family]}
    known["prompt"] = known["prompt"].format(**words)
    got = facts(collator)
    return [f"{name}: expected {value!r}, got {got[name]!r}" for name, value in known.items() if got[name] != value]
