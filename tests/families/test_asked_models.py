# SPDX-License-Identifier: MIT
"""An ordinary Qwen3-VL that answers in words: the language head, and the source of each setting."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.torch import load_file, save_file
from torch import Tensor

import rfm_export
from reward_models import ROOT, as_before_marks
from rfm import families
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm.families import CheckpointError, Decision
from rfm_client import ProgressResult, ProgressSample, Trajectory

CHECKPOINT = ROOT / "topreward" / "checkpoints" / "vlm_fp32_untied"
ROBO = ROOT / "roboreward" / "rr_tied_bf16" / "checkpoint"
SAMPLE = ProgressSample(
    Trajectory(frames=np.random.default_rng(0).integers(0, 256, (3, 64, 96, 3), np.uint8), task="stack the cups")
)
HEAD, EMBEDDING, TIED = "lm_head.weight", "model.language_model.embed_tokens.weight", "tie_word_embeddings"


def with_head(folder: Path, stated: tuple[bool | None, bool | None], head: Callable[[Tensor, Tensor], Tensor]) -> Path:
    """A copy of CHECKPOINT with this ``tie_word_embeddings``. head: makes the head from head and embedding"""
    shutil.copytree(CHECKPOINT, folder, copy_function=shutil.copyfile)
    content = json.loads((folder / "config.json").read_text())
    for part, tied in zip((content, content["text_config"]), stated, strict=True):
        part.pop(TIED, None)
        part.update({} if tied is None else {TIED: tied})
    (folder / "config.json").write_text(json.dumps(content))
    weights = load_file(folder / "model.safetensors")
    weights[HEAD] = head(weights[HEAD], weights[EMBEDDING]).clone()
    save_file(weights, folder / "model.safetensors", {"format": "pt"})
    return folder


def test_a_head_scores_as_config_json_says(tmp_path: Path) -> None:
    log_probs, told = {}, {}
    for name, stated, head in (
        ("own", (False, False), lambda head, _: head),
        ("equal, own", (False, False), lambda _, embedding: embedding),
        ("equal, tied", (True, True), lambda _, embedding: embedding),
    ):
        checkpoint = families.load(with_head(tmp_path / name, stated, head), reward_model="topreward")
        (result,) = Engine.of(checkpoint).evaluate([SAMPLE])
        assert isinstance(result, ProgressResult)
        log_probs[name] = result.log_prob
        told[name] = next((d.value, d.source) for d in checkpoint.decisions() if d.name == "language_head")
    assert told == {
        "own": ("own", "weights: lm_head.weight"),
        "equal, own": ("own", "weights: lm_head.weight"),
        "equal, tied": ("tied to the embedding", "config.json: tie_word_embeddings"),
    }
    np.testing.assert_array_equal(log_probs["equal, own"], log_probs["equal, tied"])
    assert np.abs(np.subtract(log_probs["own"], log_probs["equal, own"])).max() > 1


def explained(source: Path, **options: Any) -> tuple[dict[str, Decision], list[str]]:
    """The decisions on the checkpoint by name, and the lines for the user."""
    said: list[str] = []
    decisions = rfm_export.explain(source, ExportConfig(num_gpus=0, **options), say=said.append)
    return {each.name: each for each in decisions if each.name != "computation"}, said


@pytest.mark.parametrize("reward_model", ["roboreward-expected", "topreward"])
def test_strictness_without_a_written_answer_is_refused(reward_model: str) -> None:
    source = ROBO if reward_model.startswith("robo") else CHECKPOINT
    with pytest.raises(CheckpointError, match="--strict-answers: expected a RoboReward that writes its answers"):
        families.load(source, reward_model=reward_model, strict_answers=True)


def test_a_file_without_a_dtype_gets_a_line(tmp_path: Path) -> None:
    folder = shutil.copytree(CHECKPOINT, tmp_path / "models" / "plain", copy_function=shutil.copyfile)
    content = json.loads((folder / "config.json").read_text())
    del content["dtype"]
    (folder / "config.json").write_text(json.dumps(content))
    decisions, (line,) = explained(folder, reward_model="topreward")
    assert decisions["dtype"] == Decision("dtype", "bfloat16", "default, as config.json has no dtype", is_assumed=True)
    assert "assumed, and not shown by the checkpoint: dtype bfloat16" in line


def test_a_model_of_before_marks_may_gain_them(tmp_path: Path) -> None:
    settings = ExportConfig(name="robo", num_gpus=0, reward_model="roboreward")
    assert rfm_export.export(ROBO, tmp_path, settings) == 1
    as_before_marks(tmp_path / "robo_frames" / "config.pbtxt")
    assert rfm_export.export(ROBO, tmp_path, settings) == 2
