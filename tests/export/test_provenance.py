# SPDX-License-Identifier: MIT
"""Settings that nothing proves are told and kept; those that contradict the run are refused."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import pytest
import torch
import yaml
from transformers import AutoTokenizer

import goldens
import rfm_export
from engines import serve_config
from rfm import published
from rfm.files import CheckpointError
from rfm.published import provenance

PLAIN, VIDEO, POOLED, ADAPTER = (
    "q3_tok_disc10",
    "q25_video_avg_disc10",
    "q25_attention_disc10",
    "q25_peft_adapter_disc10",
)
FRAMES = goldens.config("enc_c1_t1_disc10")
OF_QWEN_3, OF_QWEN_2_5 = "Qwen3-VL-4B-Instruct", "Qwen2.5-VL-3B-Instruct"
NEW_TOKENS = ("<|split_token|>", "<|reward_token|>", "<|pref_token|>", "<|sim_token|>", "<|prog_token|>")
TOLD = "not shown by the checkpoint: "

Copy: TypeAlias = Callable[[str], tuple[Path, Path]]


def rewritten(file: Path, change: Callable[[Any], object]) -> None:
    """A YAML or JSON file, changed."""
    read, write = (json.loads, json.dumps) if file.suffix == ".json" else (yaml.safe_load, yaml.safe_dump)
    content = read(file.read_text())
    change(content)
    file.write_text(write(content))


@pytest.fixture
def vlm(tmp_path: Path) -> Copy:
    """Copies of a vision-language checkpoint and the base model, in a folder with the name from the run."""

    def copy(name: str) -> tuple[Path, Path]:
        config = goldens.config(name)
        assert config.base_model is not None
        base = tmp_path / "models" / (OF_QWEN_3 if name == PLAIN else OF_QWEN_2_5)
        checkpoint = shutil.copytree(config.checkpoint, tmp_path / "checkpoint", copy_function=shutil.copyfile)
        return checkpoint, shutil.copytree(config.base_model, base, copy_function=shutil.copyfile)

    return copy


def notes(folder: Path, base: Path | None = None) -> list[str]:
    """The lines about assumptions and contradictions."""
    loaded = published.read(folder, base_model=None if base is None else str(base))
    return [line for line in published.notes(folder, loaded) if "did not train" not in line]


# Settings from a checkpoint: the keys, and the value without them.
KEYS: dict[str, tuple[str, list[str], object]] = {
    "dtype": (PLAIN, ["model.torch_dtype"], "bfloat16"),
    "per_frame_progress_token": (
        PLAIN, ["model.use_per_frame_progress_token", "data.use_per_frame_progress_token"], "false",
    ),
    "progress_in_preference": (PLAIN, ["training.predict_pref_progress"], "false"),
    "frame_pooling": (POOLED, ["model.frame_pooling"], "mean"),
    "pooling_temperature": (POOLED, ["model.frame_pooling_attn_temperature"], "1.0"),
    "multi_image": (VIDEO, ["model.use_multi_image", "data.use_multi_image"], "false"),
    "average_temporal_patches": (VIDEO, ["model.average_temporal_patches"], "false"),
}  # fmt: skip


@pytest.mark.parametrize(("setting", "case"), KEYS.items(), ids=KEYS)
def test_settings_missing_in_config_yaml_are_assumed_with_a_note(
    vlm: Copy, setting: str, case: tuple[str, list[str], object]
) -> None:
    name, keys, default = case
    folder, base = vlm(name)
    assert notes(folder, base) == []
    for key in keys:
        section, _, last = key.partition(".")
        rewritten(folder / "config.yaml", lambda run, section=section, last=last: run[section].pop(last))
    expected = f"{setting} {default} (default of upstream, as config.yaml has no {keys[0]})"
    assert notes(folder, base) == [f"{TOLD}{expected}; scores differ from the run's if it had others"]


def test_a_missing_setting_without_effect_gives_no_note(vlm: Copy) -> None:
    folder, base = vlm(PLAIN)
    for key in ("frame_pooling", "frame_pooling_attn_temperature", "average_temporal_patches"):
        rewritten(folder / "config.yaml", lambda run, key=key: run["model"].pop(key, None))
    assert notes(folder, base) == []


@pytest.mark.parametrize(("version", "is_assumed"), [("4.57.6", False), ("5.5.4", False), (None, True)])
def test_positions_behind_videos_are_assumed_unless_a_version_is_stated(
    vlm: Copy, version: str | None, is_assumed: bool
) -> None:
    folder, base = vlm(VIDEO)
    rewritten(folder / "config.json", lambda config: config.update(transformers_version=version))
    assumed = published.read(folder, base_model=str(base)).assumptions
    assert ["positions_behind_videos"] * is_assumed == [each.name for each in assumed]
    assert len(notes(folder, base)) == (version != "4.57.6")  # version 5 has a line of its own


def test_a_mask_that_no_file_states_is_assumed_aloud() -> None:
    (line,) = notes(goldens.config("legacy_keys_l2").checkpoint)
    assert f"{TOLD}causal_mask false (default of upstream of before causal_mask); " in line


def test_an_export_keeps_assumptions_and_versions_and_nothing_reads_them(tmp_path: Path) -> None:
    settings, said, begun = replace(serve_config(FRAMES), dtype="float32"), list[str](), list[str]()
    rfm_export.export(FRAMES.checkpoint, tmp_path, settings, say=said.append, begin=begun.append)
    assert [step.partition(" ")[0] for step in begun] == ["reading", "writing", "comparing"]
    checkpoint = tmp_path / "rfm" / "1" / "checkpoint"
    whose = {
        name: f"--{name}-encoder; its settings alone: the weights are the checkpoint's" for name in ("image", "text")
    }
    assert json.loads((checkpoint / "provenance.json").read_text()) == {
        "assumed": [
            {"name": f"{name}_encoder", "value": f"encoders/{name}_encoder", "source": source}
            for name, source in whose.items()
        ],
        "computation": f"float32, torch {torch.__version__}, scaled_dot_product_attention",
    }
    told = "; ".join(f"{name}_encoder encoders/{name}_encoder ({source})" for name, source in whose.items())
    assert said[-1] == f"{TOLD}{told}; scores differ from the run's if it had others"
    assert rfm_export.check(tmp_path, settings) == []
    (checkpoint / "provenance.json").write_text("no JSON")
    assert rfm_export.check(tmp_path, settings) == []  # which compares settings_digest
    assert published.load(checkpoint).config == published.load(FRAMES.checkpoint).config


def test_an_export_of_a_vision_language_checkpoint_assumes_nothing(vlm: Copy, tmp_path: Path) -> None:
    folder, base = vlm(PLAIN)
    published.load(folder, base_model=str(base)).save(tmp_path / "saved")
    assert notes(tmp_path / "saved") == []


def test_a_base_model_under_another_name_is_assumed_aloud(vlm: Copy) -> None:
    folder, base = vlm(PLAIN)
    (line,) = notes(folder, base.rename(base.parent / "base"))
    expected = "base_model models/base (--base-model, for Qwen/Qwen3-VL-4B-Instruct of config.yaml); "
    assert line.startswith(f"{TOLD}{expected}")  # the whole path may be private


CONTRADICTIONS: dict[str, tuple[str, str, object, str]] = {
    "chat template": ("chat_template.json", "chat_template", "Hello.", "prompt: expected '<|im_start|>user"),
    "image statistics": (
        *("preprocessor_config.json", "image_mean", [0.485, 0.456, 0.406]),
        "image_mean: expected (0.5, 0.5, 0.5), got (0.485, 0.456, 0.406)",
    ),
}


@pytest.mark.parametrize(("file", "key", "value", "expected"), CONTRADICTIONS.values(), ids=CONTRADICTIONS)
def test_a_processor_unlike_the_published_one_is_refused_or_noted_if_the_run_names_it(
    vlm: Copy, file: str, key: str, value: Any, expected: str
) -> None:
    folder, base = vlm(PLAIN)
    rewritten(base / file, lambda content: content.update({key: value}))
    message = f"base model {base}: expected a processor like that of Qwen/{OF_QWEN_3}, which the run names: {expected}"
    with pytest.raises(CheckpointError, match=f"^{re.escape(message)}") as refused:
        notes(folder, base)
    assert f"; name a folder with the files of Qwen/{OF_QWEN_3} with --base-model, or " in str(refused.value)
    rewritten(folder / "config.yaml", lambda run: run["model"].update(base_model_id=str(base)))
    (line,) = notes(folder)
    assert line.startswith(f"base model {base}: differs from the published processors of qwen3_vl in {expected}")


def test_tokens_of_other_numbers_are_refused(vlm: Copy) -> None:
    folder, base = vlm(PLAIN)
    config = (folder / "config.json").read_text()
    rewritten(folder / "config.json", lambda config: config.update(image_token_id=433, video_token_id=432))
    with pytest.raises(CheckpointError, match=r"<\|image_pad\|>: expected token 433, .*, got 432"):
        _ = published.load(folder, base_model=str(base)).collator
    (folder / "config.json").write_text(config)
    tokenizer = AutoTokenizer.from_pretrained(str(base))
    tokenizer.add_tokens(list(reversed(NEW_TOKENS)), special_tokens=True)
    tokenizer.save_pretrained(base)
    expected = rf"base model {base}: <\|split_token\|>: expected token 446, .*, got 450; name the base model as it was"
    with pytest.raises(CheckpointError, match=expected):
        _ = published.load(folder, base_model=str(base)).collator


def test_an_adapter_of_a_run_that_began_with_a_checkpoint_needs_its_base_named(vlm: Copy) -> None:
    folder, base = vlm(ADAPTER)
    rewritten(folder / "config.yaml", lambda run: run["training"].update(load_from_checkpoint="org/whole"))
    expected = r"config\.yaml: training\.load_from_checkpoint: expected none beside an adapter, got 'org/whole': .*--base-model"
    with pytest.raises(CheckpointError, match=expected):
        notes(folder)
    assert notes(folder, base) == []


@pytest.mark.parametrize(("folder", "name"), [("/usr/share/doc", "share/doc"), ("/usr", "usr")])
def test_a_folder_has_the_name_of_its_last_two_parts(folder: str, name: str) -> None:
    assert provenance.source_name(folder) == name
