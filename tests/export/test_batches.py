# SPDX-License-Identifier: MIT
"""The export derives the batch size that saturates a GPU from the work of a typical sample."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import goldens
from engines import serve_config
from reward_models import ROOT
from rfm import families
from rfm.config import ExportConfig
from rfm_export import check, export
from rfm_export.pbtxt import parse
from rfm_export.source import saturating_samples, with_batch_size
from vlm import BFLOAT16, load

QWEN3_4B = {  # Qwen3-VL-4B-Instruct
    "text_config": {
        "hidden_size": 2560, "intermediate_size": 9728, "num_attention_heads": 32, "num_key_value_heads": 8,
        "head_dim": 128, "num_hidden_layers": 36,
    },
    "vision_config": {
        "hidden_size": 1024, "intermediate_size": 4096, "depth": 24, "num_heads": 16, "out_hidden_size": 2560,
        "deepstack_visual_indexes": [5, 11, 17], "num_position_embeddings": 2304,
    },
}  # fmt: skip
TEXT_2B = {"hidden_size": 2048, "intermediate_size": 6144, "num_attention_heads": 16, "num_hidden_layers": 28}


def of_real_size(checkpoint: Any, text: Mapping[str, int] | None = None) -> Any:
    """A small reference checkpoint that claims the network of Qwen3-VL-4B or ``text``. The weights are not read."""
    sizes = {part: {**checkpoint.config.backbone[part], **QWEN3_4B[part]} for part in QWEN3_4B}
    sizes["text_config"] |= text or {}
    sizes["vision_config"]["out_hidden_size"] = sizes["text_config"]["hidden_size"]
    return replace(checkpoint, config=replace(checkpoint.config, backbone={**checkpoint.config.backbone, **sizes}))


def language(folder: str, reward_model: str) -> Any:
    return families.load(ROOT / folder, reward_model=reward_model)


def batch_size(checkpoint: Any, told: list[str] | None = None, **settings: Any) -> int | None:
    say = (told if told is not None else []).append
    return with_batch_size(ExportConfig(**settings), checkpoint, say).max_batch_size


def test_a_robometer_4b_is_scored_four_at_a_time_and_the_export_says_why() -> None:
    told: list[str] = []
    assert batch_size(of_real_size(load(BFLOAT16)), told) == 4
    (line,) = told
    assert line.startswith("max_batch_size is 4: one sample of 8 frames of 224x224 takes 5.5 TFLOP, and a GPU is ")
    assert line.endswith("saturated at about 20 (--max-batch-size sets another number)")


def test_a_smaller_network_has_larger_batches() -> None:
    assert batch_size(of_real_size(load(BFLOAT16), TEXT_2B)) == 8


def test_a_longer_clip_in_training_makes_smaller_batches() -> None:
    checkpoint = of_real_size(load(BFLOAT16))
    assert batch_size(replace(checkpoint, config=replace(checkpoint.config, trained_frames=16))) == 2


@pytest.mark.parametrize(
    ("folder", "reward_model", "expected"),
    [
        ("roboreward/rr_tied_bf16/checkpoint", "roboreward", 2),
        ("topreward/checkpoints/vlm_fp32_untied", "topreward", 4),
        ("topreward/checkpoints/vlm_fp32_untied", "topreward-robometer", 1),
    ],
)
def test_models_of_4b_that_are_asked_in_words(folder: str, reward_model: str, expected: int) -> None:
    assert batch_size(of_real_size(language(folder, reward_model))) == expected


@pytest.mark.parametrize("name", ["c1_t1_disc10", "q3_tok_disc10", "q25_video_avg_disc10"])
def test_a_small_network_keeps_batches_of_64_without_a_line(name: str) -> None:
    config, told = goldens.config(name), list[str]()
    assert batch_size(families.load(config.checkpoint, **config.sources), told) == 64
    assert told == []


def test_the_number_is_at_least_1_and_at_most_64() -> None:
    assert [saturating_samples(flop) for flop in (0.0, 1e9, 5e12, 6e12, 1e15)] == [64, 64, 4, 4, 1]


def test_a_set_number_wins_also_in_the_check(tmp_path: Path) -> None:
    config = goldens.config("c1_t1_disc10")
    settings = replace(serve_config(config), max_batch_size=7)
    export(config.checkpoint, tmp_path, settings)
    assert parse((tmp_path / "rfm" / "config.pbtxt").read_text()).max_batch_size == 7
    assert check(tmp_path, settings) == []
    assert check(tmp_path, replace(settings, max_batch_size=None))  # 64
