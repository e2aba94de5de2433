# SPDX-License-Identifier: MIT
"""Upstream's encoders, whose embeddings ReWiND checkpoints are trained on, and what is known of their files."""

from __future__ import annotations

from typing import Any

from rfm.rewind.pretrained import load_config, load_preprocessor

IMAGE_ENCODER = "facebook/dinov2-base"
TEXT_ENCODER = "sentence-transformers/all-MiniLM-L12-v2"

_OF_BOTH = ("model_type", "hidden_size", "num_hidden_layers", "num_attention_heads")
_IMAGE: dict[str, Any] = {
    "model_type": "dinov2",
    "hidden_size": 768,
    "num_hidden_layers": 12,
    "num_attention_heads": 12,
    "patch_size": 14,
    "resize_px": 256,
    "crop_px": [224, 224],
    "image_mean": [0.485, 0.456, 0.406],
    "image_std": [0.229, 0.224, 0.225],
}
_TEXT: dict[str, Any] = {
    "model_type": "bert",
    "hidden_size": 384,
    "num_hidden_layers": 12,
    "num_attention_heads": 12,
    "vocab_size": 30522,
}


def image_facts(source: str) -> dict[str, Any]:
    """What an image encoder's files say, as JSON can hold it. Raises OSError, ValueError, CheckpointError."""
    config, images = load_config(source), load_preprocessor(source)
    of_images = {
        "resize_px": images.resize_px,
        "crop_px": list(images.crop_px),
        "image_mean": list(images.mean),
        "image_std": list(images.std),
    }
    return {name: getattr(config, name, None) for name in (*_OF_BOTH, "patch_size")} | of_images


def text_facts(source: str) -> dict[str, Any]:
    """What a text encoder's files say, as JSON can hold it. Raises OSError, ValueError."""
    config = load_config(source)
    return {name: getattr(config, name, None) for name in (*_OF_BOTH, "vocab_size")}


def differences(facts: dict[str, Any]) -> list[str]:
    """Where an encoder that is as wide as upstream's is another one."""
    known = _IMAGE if "crop_px" in facts else _TEXT
    if facts["hidden_size"] != known["hidden_size"]:
        return []
    return [f"{name}: expected {known[name]}, got {facts[name]}" for name in known if facts[name] != known[name]]
