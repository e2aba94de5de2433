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
from rfm import families
from rfm.config import ExportConfig
from rfm.engine import Engine
from rfm.families import CheckpointError, Decision
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


OF_ALL = {"backbone": "config.json", "patch_size": "config.json: vision_config"}
OF_FOLDER = {
    **OF_ALL,
    "base_model": "the checkpoint",
    "dtype": "config.json: dtype",
    "video_prompt": "config.json: transformers_version 4.57.6",
    "language_head": "weights: lm_head.weight",
    "rows_of_the_language_head": "weights",
    **dict.fromkeys(("prompt", "image_mean", "image_std"), "processor of checkpoints/vlm_fp32_untied"),
}
DEFAULTS = dict.fromkeys(("chat_template", "num_prefixes", "max_frames", "prompt_prefix", "prompt_suffix"), "default")
LIMITS = dict.fromkeys(("least_px", "most_px"), "processor of checkpoints/vlm_fp32_untied: size")
EXPLAINED: dict[str, tuple[Path, dict[str, Any], dict[str, str]]] = {
    "as LeRobot": (
        CHECKPOINT,
        {"reward_model": "topreward,max_frames=9"},
        {**OF_FOLDER, **DEFAULTS, **LIMITS, "variant": "--as", "fps": "default", "max_frames": "--as"},
    ),
    "as Robometer, which has no effect of fps and limits": (
        CHECKPOINT,
        {"reward_model": "topreward-robometer"},
        {**OF_FOLDER, **DEFAULTS, "variant": "--as"},
    ),
    "by LeRobot's file": (
        OF_LEROBOT,
        {"base_model": str(CHECKPOINT)},
        {
            **OF_FOLDER,
            **DEFAULTS,
            **LIMITS,
            "base_model": "--base-model",
            "variant": "config.json: type",
            "chat_template": "config.json: add_chat_template",
            "fps": "config.json: fps",
            "prompt_prefix": "config.json: prompt_prefix",
            "prompt_suffix": "config.json: prompt_suffix_template",
        },
    ),
    "with another processor": (
        CHECKPOINT,
        {"reward_model": "topreward", "base_model": str(BASE)},
        {
            **OF_FOLDER,
            **DEFAULTS,
            **dict.fromkeys(("prompt", "image_mean", "image_std"), "processor of bases/q3"),
            **dict.fromkeys(LIMITS, "processor of bases/q3: size"),
            "base_model": "--base-model",
            "variant": "--as",
            "fps": "default",
        },
    ),
}


def explained(source: Path, **options: Any) -> tuple[dict[str, Decision], list[str]]:
    """The decisions on the checkpoint by name, and the lines for the user."""
    said: list[str] = []
    decisions = rfm_export.explain(source, ExportConfig(num_gpus=0, **options), say=said.append)
    return {each.name: each for each in decisions if each.name != "computation"}, said


@pytest.mark.parametrize(("source", "options", "sources"), EXPLAINED.values(), ids=EXPLAINED)
def test_every_setting_says_what_decided_it(source: Path, options: dict[str, Any], sources: dict[str, str]) -> None:
    decisions, said = explained(source, **options)
    assert {name: each.source for name, each in decisions.items()} == sources
    assert said == []  # an ordinary model lacks no head
    assert decisions["dtype"].value == "float32"
    assert "<|vision_start|><|video_pad|><|vision_end|>" in decisions["prompt"].value
    assert decisions["prompt"].value.endswith("True")


def test_an_export_says_that_its_file_decides(tmp_path: Path) -> None:
    families.load(CHECKPOINT, reward_model="topreward,fps=3").save(tmp_path / "saved")
    decisions, said = explained(tmp_path / "saved")
    weights = {"language_head": "weights: lm_head.weight", "rows_of_the_language_head": "weights"}
    files = {name: OF_ALL.get(name, "config.json") for name in decisions if name not in weights}
    of_processor = dict.fromkeys(("prompt", "image_mean", "image_std"), "processor/")
    assert {name: each.source for name, each in decisions.items()} == {**files, **weights, **of_processor}
    assert (decisions["fps"].value, decisions["base_model"].value) == (3.0, "checkpoints/vlm_fp32_untied")
    assert said == []


def test_a_checkpoint_in_the_hub_s_cache_is_named_by_its_id_and_commit(tmp_path: Path) -> None:
    snapshot = tmp_path / "models--Qwen--Qwen3-VL-8B-Instruct" / "snapshots" / "0123abcd"
    shutil.copytree(CHECKPOINT, snapshot)
    decisions, _ = explained(snapshot, reward_model="topreward")
    assert decisions["base_model"].value == "Qwen/Qwen3-VL-8B-Instruct@0123abcd"
    assert decisions["prompt"].source == "processor of Qwen/Qwen3-VL-8B-Instruct@0123abcd"


OF_ROBO = {
    **OF_ALL,
    "base_model": "the checkpoint",
    "dtype": "upstream: always",
    "video_prompt": "config.json: transformers_version 4.57.6",
    "language_head": "config.json: tie_word_embeddings",
    "rows_of_the_language_head": "weights",
    **dict.fromkeys(("prompt", "image_mean", "image_std"), "processor of NAME"),
}
WRITTEN = {"stops": "generation_config.json: eos_token_id", "max_new_tokens": "upstream", "strict_answers": "default"}
OF_ROBOREWARD: dict[str, tuple[str, dict[str, Any], dict[str, str]]] = {
    "written": ("robo", {"reward_model": "roboreward"}, {**WRITTEN, "is_expected": "--as"}),
    "expected, which writes nothing": ("robo", {"reward_model": "roboreward-expected"}, {"is_expected": "--as"}),
    "by its name": ("RoboReward-4B", {}, {**WRITTEN, "is_expected": "the name of the folder"}),
    "strict": (
        "RoboReward-4B",
        {"strict_answers": True},
        {**WRITTEN, "is_expected": "the name of the folder", "strict_answers": "--strict-answers"},
    ),
}


@pytest.mark.parametrize(("name", "options", "sources"), OF_ROBOREWARD.values(), ids=OF_ROBOREWARD)
def test_every_setting_of_roboreward_says_what_decided_it(
    tmp_path: Path, name: str, options: dict[str, Any], sources: dict[str, str]
) -> None:
    folder = shutil.copytree(ROBO, tmp_path / "models" / name)
    decisions, said = explained(folder, **options)
    expected = {**OF_ROBO, **sources}
    told = {setting: source.replace("NAME", f"models/{name}") for setting, source in expected.items()}
    assert {setting: each.source for setting, each in decisions.items()} == told
    assert said == []
    assert decisions["dtype"].value == "bfloat16"
    assert decisions["is_expected"].value is decisions["prompt"].value.endswith("ANSWER: ")


def test_an_export_of_roboreward_says_that_its_file_decides(tmp_path: Path) -> None:
    families.load(ROBO, reward_model="roboreward", strict_answers=True).save(tmp_path / "saved")
    decisions, _ = explained(tmp_path / "saved")
    names = ("base_model", "dtype", "video_prompt", "stops", "max_new_tokens", "is_expected", "strict_answers")
    assert {decisions[name].source for name in names} == {"config.json"}
    assert decisions["strict_answers"].value is True


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
