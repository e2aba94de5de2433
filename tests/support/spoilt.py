# SPDX-License-Identifier: MIT
"""Copies of checkpoints for a test to spoil."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from safetensors.torch import load_file, save_file

import goldens
from rfm.families import CheckpointError

WEIGHTS = "model.safetensors"

Spoil = Callable[[Path], object]


def copied(config: goldens.Config, folder: Path) -> Path:
    return shutil.copytree(config.checkpoint, folder, copy_function=shutil.copyfile)


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


def settings(file: str, **changes: Any) -> Spoil:
    return in_json(file, lambda content: content.update(changes))


def text(name: str, content: str) -> Spoil:
    return lambda folder: (folder / name).write_text(content)


def text_settings(**changes: Any) -> Spoil:
    """Names of the language model's layers in a vision-language model."""
    return in_json("config.json", lambda content: content["text_config"].update(changes))


def conversion(load: Callable[[Path], object], folder: Path) -> str:
    """Return the command in the refusal of ``load``."""
    with pytest.raises(CheckpointError) as refusal:
        load(folder)
    (command,) = re.findall(r"python -c .*", str(refusal.value))
    return str(command)


def convert(load: Callable[[Path], object], folder: Path) -> None:
    """Run the code from the refusal of ``load`` in this process."""
    _, _, code, *arguments = shlex.split(conversion(load, folder))
    with mock.patch.object(sys, "argv", ["-c", *arguments]):
        exec(code, {})


def without(name: str, heads: Sequence[str], target: Path) -> Path:
    """A copy of a reference checkpoint without heads."""
    copied(goldens.config(name), target)
    if not (target / "config.yaml").exists():
        shutil.copyfile(goldens.config(name).checkpoint.parent / "config.yaml", target / "config.yaml")
    weights(
        lambda tensors: [tensors.pop(key) for key in [*tensors] if key.startswith(tuple(f"{h}_head." for h in heads))]
    )(target)
    return target
