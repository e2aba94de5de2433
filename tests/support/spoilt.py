# SPDX-License-Identifier: MIT
"""Copies of checkpoints for a test to spoil."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
import yaml
from safetensors.torch import load_file, save_file

import goldens
import reward_models

WEIGHTS = "model.safetensors"

Spoil = Callable[[Path], object]


def copied(config: goldens.Config, folder: Path) -> Path:
    return shutil.copytree(config.checkpoint, folder, copy_function=shutil.copyfile)


REWARD_MODELS: dict[str, tuple[str, dict[str, str]]] = {
    "topreward": ("topreward/checkpoints/vlm_fp32_untied", {"reward_model": "topreward"}),
    "topreward-robometer": ("topreward/checkpoints/vlm_fp32_untied", {"reward_model": "topreward-robometer"}),
    "topreward of LeRobot": (
        "topreward/lerobot_plain/lerobot",
        {"base_model": "topreward/checkpoints/vlm_fp32_untied"},
    ),
    "roboreward": ("roboreward/rr_tied_bf16/checkpoint", {"reward_model": "roboreward"}),
    "robometer of LeRobot": ("lerobot_robometer/tok_disc10/checkpoint", {"base_model": "bases/q3"}),
}


def with_sources(name: str, folder: Path) -> tuple[Path, dict[str, Any]]:
    """Copies of a reference's checkpoint, as ``folder/checkpoint``, and of what it needs; the options to load them."""
    if name in REWARD_MODELS:
        place, options = REWARD_MODELS[name]
        checkpoint = reward_models.ROOT / place
        sources = {option: reward_models.ROOT / value for option, value in options.items() if option == "base_model"}
    else:
        checkpoint, options = goldens.config(name).checkpoint, {}
        sources = {option: Path(value) for option, value in goldens.config(name).sources.items()}
    for option, source in {"checkpoint": checkpoint, **sources}.items():
        shutil.copytree(source, folder / option, copy_function=shutil.copyfile)
    return folder / "checkpoint", {**options, **{option: str(folder / option) for option in sources}}


def beside(option: str, spoil: Spoil) -> Spoil:
    """Spoils what ``with_sources`` copied for this option."""
    return lambda folder: spoil(folder.parent / option)


def both(*spoils: Spoil) -> Spoil:
    return lambda folder: [spoil(folder) for spoil in spoils]


def gone(file: str) -> Spoil:
    return lambda folder: (folder / file).unlink()


def taken(folder: Path) -> dict[str, Any]:
    """Return the tensors of ``model.safetensors``, and remove it."""
    tensors = load_file(folder / WEIGHTS)
    (folder / WEIGHTS).unlink()
    return tensors


def in_two_shards(folder: Path) -> None:
    _in_two(folder, ("a.safetensors", "b.safetensors"), "model.safetensors.index.json", save_file)


def sharded_pickle(folder: Path) -> None:
    names = ("pytorch_model-00001-of-00002.bin", "pytorch_model-00002-of-00002.bin")
    _in_two(folder, names, "pytorch_model.bin.index.json", torch.save)


def _in_two(folder: Path, names: tuple[str, str], index: str, save: Callable[..., Any]) -> None:
    tensors = taken(folder)
    keys = sorted(tensors)
    parts = dict(zip(names, (keys[:20], keys[20:]), strict=True))
    for name, part in parts.items():
        save({key: tensors[key] for key in part}, folder / name)
    weight_map = {key: name for name, part in parts.items() for key in part}
    (folder / index).write_text(json.dumps({"metadata": {}, "weight_map": weight_map}))


def files_in(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def weights(change: Callable[[dict[str, Any]], object], file: str = WEIGHTS) -> Spoil:
    """Changes the tensors of a file."""

    def spoil(folder: Path) -> None:
        tensors = load_file(folder / file)
        change(tensors)
        save_file(tensors, folder / file)

    return spoil


def in_json(file: str, change: Callable[[dict[str, Any]], object]) -> Spoil:
    def spoil(folder: Path) -> None:
        content = json.loads((folder / file).read_text())
        change(content)
        (folder / file).write_text(json.dumps(content))

    return spoil


def in_yaml(change: Callable[[dict[str, Any]], object]) -> Spoil:
    """Changes config.yaml."""

    def spoil(folder: Path) -> None:
        content = yaml.safe_load((folder / "config.yaml").read_text())
        change(content)
        (folder / "config.yaml").write_text(yaml.safe_dump(content))

    return spoil


def run_settings(section: str, **changes: Any) -> Spoil:
    """Changes a section of config.yaml."""
    return in_yaml(lambda content: content[section].update(changes))


def renamed(pattern: str, replacement: str | Callable[[re.Match[str]], str], file: str = WEIGHTS) -> Spoil:
    """Renames tensors of a file."""

    def change(tensors: dict[str, Any]) -> None:
        for name in [*tensors]:
            tensors[re.sub(pattern, replacement, name)] = tensors.pop(name)

    return weights(change, file)


def settings(file: str, **changes: Any) -> Spoil:
    return in_json(file, lambda content: content.update(changes))


def nested(**changes: Any) -> Spoil:
    """Transformers 5's file beside those of transformers 4, with the same content but for ``changes``."""

    def spoil(base: Path) -> None:
        content = json.loads((base / "preprocessor_config.json").read_text())
        (base / "processor_config.json").write_text(json.dumps({"image_processor": content | changes}))

    return spoil


def text(name: str, content: str) -> Spoil:
    return lambda folder: (folder / name).write_text(content)


def text_settings(**changes: Any) -> Spoil:
    """Changes settings of a vision-language model's language model."""
    return in_json("config.json", lambda content: content["text_config"].update(changes))


def without(name: str, heads: Sequence[str], target: Path) -> Path:
    """A copy of a reference checkpoint without heads."""
    copied(goldens.config(name), target)
    if not (target / "config.yaml").exists():
        shutil.copyfile(goldens.config(name).checkpoint.parent / "config.yaml", target / "config.yaml")
    weights(
        lambda tensors: [tensors.pop(key) for key in [*tensors] if key.startswith(tuple(f"{h}_head." for h in heads))]
    )(target)
    return target
