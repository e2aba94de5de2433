# SPDX-License-Identifier: MIT
"""An ordinary Qwen3-VL that answers in words: the language head, and the source of each setting."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

import rfm_export
from reward_models import BASE, ROOT, as_before_marks
from rfm import published
from rfm.config import ExportConfig
from rfm.files import CheckpointError

CHECKPOINT = ROOT / "topreward" / "checkpoints" / "vlm_fp32_untied"
OF_LEROBOT = ROOT / "topreward" / "lerobot_plain" / "lerobot"
ROBO = ROOT / "roboreward" / "rr_tied_bf16" / "checkpoint"
HEAD, EMBEDDING, TIED = "lm_head.weight", "model.language_model.embed_tokens.weight", "tie_word_embeddings"


def with_head(
    folder: Path, stated: tuple[bool | None, bool | None], head: Callable[[Tensor, Tensor], Tensor] | None
) -> Path:
    """A copy of CHECKPOINT with this ``tie_word_embeddings``. head: makes the head from head and embedding; None: none"""
    shutil.copytree(CHECKPOINT, folder, copy_function=shutil.copyfile)
    content = json.loads((folder / "config.json").read_text())
    for part, tied in zip((content, content["text_config"]), stated, strict=True):
        part.pop(TIED, None)
        part.update({} if tied is None else {TIED: tied})
    (folder / "config.json").write_text(json.dumps(content))
    weights = load_file(folder / "model.safetensors")
    own = weights.pop(HEAD)
    if head is not None:
        weights[HEAD] = head(own, weights[EMBEDDING]).clone()
    save_file(weights, folder / "model.safetensors", {"format": "pt"})
    return folder


OWN, EQUAL = (lambda head, _: head), (lambda _, embedding: embedding)
HEADS: dict[str, tuple[tuple[bool | None, bool | None], Any, bool, str | None]] = {
    "its own": ((False, False), OWN, True, None),
    "its own, though the outer setting ties it": ((True, False), OWN, True, None),
    "equal to the embedding": ((False, False), EQUAL, False, None),
    "equal and tied": ((True, True), EQUAL, False, None),
    "tied": ((True, True), None, False, None),
    "tied for transformers 4": ((False, True), None, False, "text_config alone, as transformers 4 reads it"),
    "tied for transformers 5": ((True, None), None, False, "the outer setting alone, as transformers 5 reads it"),
}


@pytest.mark.parametrize(("stated", "head", "is_own", "assumed"), HEADS.values(), ids=HEADS)
def test_a_head_scores_as_config_json_says(
    tmp_path: Path, stated: tuple[bool | None, bool | None], head: Any, is_own: bool, assumed: str | None
) -> None:
    """As transformers 4.57.6 or 5.23.0 loads it, or both."""
    loaded: Any = published.read(with_head(tmp_path / "changed", stated, head), reward_model="topreward")
    known = load_file(CHECKPOINT / "model.safetensors")[HEAD if is_own else EMBEDDING]
    assert torch.equal(loaded.checkpoint.build(torch.float32).lm_head.weight, known)
    sources = [each.source for each in loaded.assumptions if each.name == "language_head"]
    assert sources == ([] if assumed is None else [f"{TIED} of {assumed}"])


@pytest.mark.parametrize(
    ("source", "options"),
    [
        (CHECKPOINT, {"reward_model": "topreward,max_frames=9"}),
        (CHECKPOINT, {"reward_model": "topreward-robometer"}),
        (OF_LEROBOT, {"base_model": str(CHECKPOINT)}),
        (CHECKPOINT, {"reward_model": "topreward", "base_model": str(BASE)}),
        (ROBO, {"reward_model": "roboreward"}),
    ],
)
def test_an_ordinary_model_lacks_no_head_and_nothing_is_assumed(source: Path, options: dict[str, Any]) -> None:
    assert published.notes(source, published.read(source, **options)) == []


def test_a_checkpoint_in_the_hub_s_cache_is_named_by_its_id_and_commit(tmp_path: Path) -> None:
    snapshot = tmp_path / "models--Qwen--Qwen3-VL-8B-Instruct" / "snapshots" / "0123abcd"
    shutil.copytree(CHECKPOINT, snapshot)
    config = published.load(snapshot, reward_model="topreward").config
    assert config.base_model_id == "Qwen/Qwen3-VL-8B-Instruct@0123abcd"


@pytest.mark.parametrize(
    ("name", "options", "is_expected"),
    [
        ("robo", {"reward_model": "roboreward"}, False),
        ("robo", {"reward_model": "roboreward-expected"}, True),
        ("RoboReward-4B", {}, False),
        ("RoboReward-4B", {"strict_answers": True}, False),
    ],
)
def test_the_options_or_the_name_decide_how_roboreward_is_asked(
    tmp_path: Path, name: str, options: dict[str, Any], is_expected: bool
) -> None:
    checkpoint = published.load(shutil.copytree(ROBO, tmp_path / "models" / name), **options)
    config = checkpoint.config
    assert (config.is_expected, config.dtype) == (is_expected, "bfloat16")
    assert checkpoint.collator.example().endswith("ANSWER: ") is is_expected
    assert config.strict_answers is options.get("strict_answers", False)
    checkpoint.save(tmp_path / "saved")
    assert published.load(tmp_path / "saved").config == config
    with pytest.raises(CheckpointError, match="--as: expected the reward model of this export"):
        published.load(tmp_path / "saved", reward_model="roboreward" if is_expected else "roboreward-expected")


def test_a_file_without_a_dtype_gets_a_line(tmp_path: Path) -> None:
    folder = shutil.copytree(CHECKPOINT, tmp_path / "models" / "plain", copy_function=shutil.copyfile)
    content = json.loads((folder / "config.json").read_text())
    del content["dtype"]
    (folder / "config.json").write_text(json.dumps(content))
    (line,) = published.notes(folder, published.read(folder, reward_model="topreward"))
    assert "not shown by the checkpoint: dtype bfloat16 (default, as config.json has no dtype);" in line


@pytest.mark.slow
def test_a_model_of_before_marks_may_gain_them(tmp_path: Path) -> None:
    settings = ExportConfig(name="robo", num_gpus=0, reward_model="roboreward")
    assert rfm_export.export(ROBO, tmp_path, settings) == 1
    as_before_marks(tmp_path / "robo_frames" / "config.pbtxt")
    assert rfm_export.export(ROBO, tmp_path, settings) == 2
