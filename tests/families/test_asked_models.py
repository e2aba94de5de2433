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
from reward_models import BASE, ROOT, as_before_marks
from rfm import published
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm.files import CheckpointError
from rfm_client import ProgressResult, ProgressSample, Trajectory

CHECKPOINT = ROOT / "topreward" / "checkpoints" / "vlm_fp32_untied"
OF_LEROBOT = ROOT / "topreward" / "lerobot_plain" / "lerobot"
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
    log_probs = {}
    for name, stated, head in (
        ("own", (False, False), lambda head, _: head),
        ("equal, own", (False, False), lambda _, embedding: embedding),
        ("equal, tied", (True, True), lambda _, embedding: embedding),
    ):
        checkpoint = published.load(with_head(tmp_path / name, stated, head), reward_model="topreward")
        (result,) = Engine.of(checkpoint).evaluate([SAMPLE])
        assert isinstance(result, ProgressResult)
        log_probs[name] = result.log_prob
    np.testing.assert_array_equal(log_probs["equal, own"], log_probs["equal, tied"])
    assert np.abs(np.subtract(log_probs["own"], log_probs["equal, own"])).max() > 1


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


@pytest.mark.parametrize("reward_model", ["roboreward-expected", "topreward"])
def test_strictness_without_a_written_answer_is_refused(reward_model: str) -> None:
    source = ROBO if reward_model.startswith("robo") else CHECKPOINT
    with pytest.raises(CheckpointError, match="--strict-answers: expected a RoboReward that writes its answers"):
        published.load(source, reward_model=reward_model, strict_answers=True)


def test_a_file_without_a_dtype_gets_a_line(tmp_path: Path) -> None:
    folder = shutil.copytree(CHECKPOINT, tmp_path / "models" / "plain", copy_function=shutil.copyfile)
    content = json.loads((folder / "config.json").read_text())
    del content["dtype"]
    (folder / "config.json").write_text(json.dumps(content))
    (line,) = published.notes(folder, published.read(folder, reward_model="topreward"))
    assert "assumed, and not shown by the checkpoint: dtype bfloat16 (default, as config.json has no dtype);" in line


@pytest.mark.slow
def test_a_model_of_before_marks_may_gain_them(tmp_path: Path) -> None:
    settings = ExportConfig(name="robo", num_gpus=0, reward_model="roboreward")
    assert rfm_export.export(ROBO, tmp_path, settings) == 1
    as_before_marks(tmp_path / "robo_frames" / "config.pbtxt")
    assert rfm_export.export(ROBO, tmp_path, settings) == 2
