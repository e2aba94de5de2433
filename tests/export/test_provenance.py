# SPDX-License-Identifier: MIT
"""The source of each setting: printed, written beside the checkpoint, refused where it contradicts the run."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from transformers import AutoTokenizer

import goldens
import rfm_export
from engines import serve_config
from in_process import rfm
from rfm import families
from rfm.config import ExportConfig
from rfm.families import CheckpointError, Decision

PLAIN, VIDEO, POOLED, ADAPTER = (
    "q3_tok_disc10",
    "q25_video_avg_disc10",
    "q25_attention_disc10",
    "q25_peft_adapter_disc10",
)
LORA_INSIDE, REWIND = "q3_lora_full_disc10", "c1_t1_disc10"
NAMED = {PLAIN: "Qwen3-VL-4B-Instruct", LORA_INSIDE: "Qwen3-VL-4B-Instruct"}  # else a Qwen2.5-VL
OF_QWEN_2_5 = "Qwen2.5-VL-3B-Instruct"
NEW_TOKENS = ("<|split_token|>", "<|reward_token|>", "<|pref_token|>", "<|sim_token|>", "<|prog_token|>")


def copied(source: Path, target: Path) -> Path:
    return shutil.copytree(source, target, copy_function=shutil.copyfile)


def rewritten(file: Path, change: Callable[[Any], object]) -> None:
    """A YAML or JSON file, changed."""
    read, write = (json.loads, json.dumps) if file.suffix == ".json" else (yaml.safe_load, yaml.safe_dump)
    content = read(file.read_text())
    change(content)
    file.write_text(write(content))


@pytest.fixture
def vlm(tmp_path: Path) -> Callable[[str], tuple[Path, Path]]:
    """Copies of a vision-language checkpoint and the base model, in a folder with the name from the run."""

    def copy(name: str) -> tuple[Path, Path]:
        config = goldens.config(name)
        assert config.base_model is not None
        base = tmp_path / "models" / NAMED.get(name, OF_QWEN_2_5)
        return copied(config.checkpoint, tmp_path / "checkpoint"), copied(config.base_model, base)

    return copy


def explained(folder: Path, base: Path | None = None) -> tuple[dict[str, Decision], list[str]]:
    """Decisions by name, and the messages about assumptions and contradictions."""
    said: list[str] = []
    settings = ExportConfig(num_gpus=0, base_model=None if base is None else str(base))
    decisions = {each.name: each for each in rfm_export.explain(folder, settings, say=said.append)}
    assert decisions.pop("computation").source == "installed PyTorch"
    return decisions, [line for line in said if "read as the settings" not in line and "did not train" not in line]


def sources(decisions: dict[str, Decision]) -> dict[str, str]:
    return {name: each.source for name, each in decisions.items()}


def test_every_setting_of_a_vision_language_checkpoint_says_what_decided_it(
    vlm: Callable[[str], tuple[Path, Path]],
) -> None:
    decisions, said = explained(*vlm(PLAIN))
    assert said == []
    assert sources(decisions) == {
        "backbone": "config.json",
        "base_model": "--base-model",
        "progress_bins": "weights",
        "has_similarity": "weights",
        "has_preference": "weights",
        "has_success": "weights",
        "dtype": "config.yaml: model.torch_dtype",
        "multi_image": "config.yaml: model.use_multi_image, data.use_multi_image",
        "per_frame_progress_token": "config.yaml: model.use_per_frame_progress_token, data.use_per_frame_progress_token",
        "progress_in_preference": "config.yaml: training.predict_pref_progress",
        "trained_frames": "config.yaml: data.max_frames",
        "trained_padding": "upstream: every training run pads",
        "special_tokens": "weights: last rows of the embedding",
        **dict.fromkeys(
            ("prompt", "patch_size", "image_mean", "image_std"), "processor of models/Qwen3-VL-4B-Instruct"
        ),
    }
    assert decisions["base_model"].value == "models/Qwen3-VL-4B-Instruct"  # the whole path may be private
    assert decisions["trained_frames"].value == 8
    assert decisions["special_tokens"].value == [446, 447, 448, 449, 450]
    expected = "<|im_start|>user\nTASKPicture 1: <|vision_start|><|image_pad|><|vision_end|><|im_end|>\n"
    assert decisions["prompt"].value == expected


LORA = {
    ADAPTER: ("config.json of base_model", "adapter_config.json: r, lora_alpha"),
    LORA_INSIDE: ("config.json", "config.yaml: peft: r, lora_alpha"),
}


@pytest.mark.parametrize(("name", "expected"), LORA.items())
def test_the_scale_of_lora_says_its_file(vlm: Callable[[str], tuple[Path, Path]], name: str, expected: object) -> None:
    decisions, _ = explained(*vlm(name))
    assert (decisions["backbone"].source, decisions["lora"].source) == expected
    assert decisions["lora"].value == {"r": 4, "lora_alpha": 8.0}


# Settings from a checkpoint: the keys, and the value without them.
KEYS: dict[str, tuple[str, list[str], object]] = {
    "dtype": (PLAIN, ["model.torch_dtype"], "bfloat16"),
    "per_frame_progress_token": (
        PLAIN, ["model.use_per_frame_progress_token", "data.use_per_frame_progress_token"], False,
    ),
    "progress_in_preference": (PLAIN, ["training.predict_pref_progress"], False),
    "frame_pooling": (POOLED, ["model.frame_pooling"], "mean"),
    "pooling_temperature": (POOLED, ["model.frame_pooling_attn_temperature"], 1.0),
    "multi_image": (VIDEO, ["model.use_multi_image", "data.use_multi_image"], False),
    "average_temporal_patches": (VIDEO, ["model.average_temporal_patches"], False),
}  # fmt: skip


@pytest.mark.parametrize(("setting", "case"), KEYS.items(), ids=KEYS)
def test_what_config_yaml_does_not_say_is_assumed_aloud(
    vlm: Callable[[str], tuple[Path, Path]], setting: str, case: tuple[str, list[str], object]
) -> None:
    name, keys, default = case
    folder, base = vlm(name)
    before, said = explained(folder, base)
    assert before[setting].source == f"config.yaml: {', '.join(keys)}"
    assert not before[setting].is_assumed
    assert said == []
    for key in keys:
        section, _, last = key.partition(".")
        rewritten(folder / "config.yaml", lambda run, section=section, last=last: run[section].pop(last))
    after, said = explained(folder, base)
    source = f"default of upstream, as config.yaml has no {keys[0]}"
    assert after[setting] == Decision(setting, default, source, is_assumed=True)
    (line,) = said
    assert line.startswith(f"assumed, and not shown by the checkpoint: {setting} {after[setting].text} ({source}); ")
    assert line.endswith("; rfm export --explain shows what decided each setting")


@pytest.mark.parametrize(
    ("version", "source", "is_assumed"),
    [
        ("4.57.6", "config.json: transformers_version 4.57.6", False),
        ("5.5.4", "default: no file names transformers 4", False),  # has a separate line
        (None, "default: no file names transformers 4", True),
    ],
)
def test_positions_behind_videos_say_what_decided_them(
    vlm: Callable[[str], tuple[Path, Path]], version: str | None, source: str, is_assumed: bool
) -> None:
    folder, base = vlm(VIDEO)
    rewritten(folder / "config.json", lambda config: config.update(transformers_version=version))
    decisions, said = explained(folder, base)
    name = "positions_behind_videos"
    assert decisions[name] == Decision(name, "as transformers 4", source, is_assumed=is_assumed)
    assert len(said) == (version != "4.57.6")


def test_a_config_yaml_above_the_checkpoint_is_named_so() -> None:
    decisions, said = explained(goldens.config(REWIND).checkpoint)
    assert said == []
    assert sources(decisions) == {
        **dict.fromkeys(
            (
                "video_feature_dim", "text_feature_dim", "hidden_dim", "num_layers", "use_per_frame_progress_token",
                "progress_bins", "has_similarity", "has_preference", "has_success", "max_len",
            ),
            "weights",
        ),
        "num_attention_heads": "config.json and ../config.yaml: model.rewind",
        "causal_mask": "config.json and ../config.yaml: model.rewind",
        "trained_frames": "../config.yaml: data.max_frames",
        "trained_padding": "upstream: every training run pads",
    }  # fmt: skip


def test_a_mask_that_no_file_states_is_assumed_aloud() -> None:
    decisions, said = explained(goldens.config("legacy_keys_l2").checkpoint)
    source = "default of upstream of before causal_mask"
    assert decisions["causal_mask"] == Decision("causal_mask", False, source, is_assumed=True)
    (line,) = said
    assert f"assumed, and not shown by the checkpoint: causal_mask false ({source}); " in line


def test_an_export_keeps_the_table_beside_the_checkpoint_and_nothing_reads_it(tmp_path: Path) -> None:
    source, repository = goldens.config(REWIND), tmp_path / "repository"
    settings = replace(serve_config(source), dtype="float32")
    rfm_export.export(source.checkpoint, repository, settings)
    checkpoint = repository / "rfm" / "1" / "checkpoint"
    kept = [Decision(**row) for row in json.loads((checkpoint / "provenance.json").read_text())]
    computed = f"float32, torch {torch.__version__}, scaled_dot_product_attention"
    told = [Decision("served_dtype", "float32", "--dtype"), Decision("computation", computed, "installed PyTorch")]
    assert kept == [*explained(source.checkpoint)[0].values(), *told]

    assert rfm_export.check(repository, settings) == []
    (checkpoint / "provenance.json").write_text("no JSON")
    assert rfm_export.check(repository, settings) == []  # which compares settings_digest
    assert families.load(checkpoint).config == families.load(source.checkpoint).config


def test_an_export_states_every_setting(vlm: Callable[[str], tuple[Path, Path]], tmp_path: Path) -> None:
    folder, base = vlm(PLAIN)
    families.load(folder, base_model=str(base)).save(tmp_path / "saved")
    decisions, said = explained(tmp_path / "saved")
    assert said == []
    decided = {
        "config.json",
        "weights",
        "weights: last rows of the embedding",
        "processor/",
        "upstream: every training run pads",
    }
    assert set(sources(decisions).values()) == decided
    assert decisions["base_model"].value == "Qwen/Qwen3-VL-4B-Instruct"


def test_a_base_model_under_another_name_is_assumed_aloud(vlm: Callable[[str], tuple[Path, Path]]) -> None:
    folder, base = vlm(PLAIN)
    _, said = explained(folder, base.rename(base.parent / "base"))
    (line,) = said
    expected = "base_model models/base (--base-model, for Qwen/Qwen3-VL-4B-Instruct of config.yaml); "
    assert line.startswith(f"assumed, and not shown by the checkpoint: {expected}")


CONTRADICTIONS: dict[str, tuple[str, str, object, str]] = {
    "chat template": ("chat_template.json", "chat_template", "Hello.", "prompt: expected '<|im_start|>user"),
    "image statistics": (
        *("preprocessor_config.json", "image_mean", [0.485, 0.456, 0.406]),
        "image_mean: expected [0.5, 0.5, 0.5], got [0.485, 0.456, 0.406]",
    ),
}


@pytest.mark.parametrize(("file", "key", "value", "expected"), CONTRADICTIONS.values(), ids=CONTRADICTIONS)
def test_a_processor_that_is_not_the_published_one_is_refused_or_told_of_a_run_s_own(
    vlm: Callable[[str], tuple[Path, Path]], file: str, key: str, value: Any, expected: str
) -> None:
    folder, base = vlm(PLAIN)
    rewritten(base / file, lambda content: content.update({key: value}))
    message = f"base model {base}: expected a processor like that of Qwen/Qwen3-VL-4B-Instruct, which the run names: {expected}"
    with pytest.raises(CheckpointError, match=f"^{re.escape(message)}") as refused:
        explained(folder, base)
    assert "; name a folder with the files of Qwen/Qwen3-VL-4B-Instruct with --base-model, or " in str(refused.value)
    rewritten(folder / "config.yaml", lambda run: run["model"].update(base_model_id=str(base)))
    _, (line,) = explained(folder)
    assert line.startswith(f"base model {base}: differs from the published processors of qwen3_vl in {expected}")


def test_tokens_of_other_numbers_are_refused(vlm: Callable[[str], tuple[Path, Path]]) -> None:
    folder, base = vlm(PLAIN)
    config = (folder / "config.json").read_text()
    rewritten(folder / "config.json", lambda config: config.update(image_token_id=433, video_token_id=432))
    with pytest.raises(CheckpointError, match=r"<\|image_pad\|>: expected token 433, .*, got 432"):
        explained(folder, base)
    (folder / "config.json").write_text(config)
    tokenizer = AutoTokenizer.from_pretrained(str(base))
    tokenizer.add_tokens(list(reversed(NEW_TOKENS)), special_tokens=True)
    tokenizer.save_pretrained(base)
    expected = rf"base model {base}: <\|split_token\|>: expected token 446, .*, got 450; name the base model as it was"
    with pytest.raises(CheckpointError, match=expected):
        explained(folder, base)


def test_an_adapter_of_a_run_that_began_with_a_checkpoint_needs_its_base_named(
    vlm: Callable[[str], tuple[Path, Path]],
) -> None:
    folder, base = vlm(ADAPTER)
    rewritten(folder / "config.yaml", lambda run: run["training"].update(load_from_checkpoint="org/whole"))
    expected = r"config\.yaml: training\.load_from_checkpoint: expected none beside an adapter, got 'org/whole': .*--base-model"
    with pytest.raises(CheckpointError, match=expected):
        explained(folder)
    assert explained(folder, base)[0]["base_model"].source == "--base-model"


def test_explain_prints_the_table_and_writes_nothing(tmp_path: Path) -> None:
    folder, repository = goldens.config(REWIND).checkpoint, tmp_path / "repository"
    command = ["export", "--checkpoint", str(folder), "--repository", str(repository), "--num-gpus", "0"]
    result = rfm(*command, "--explain")
    assert result.exit_code == 0, result.output
    assert [line.split()[0] for line in result.stdout.splitlines()] == [*explained(folder)[0], "computation"]
    assert not repository.exists()
