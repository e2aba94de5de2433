# SPDX-License-Identifier: MIT
"""Copies of checkpoints that a test may spoil."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from safetensors.torch import load_file, save_file

import goldens
from rfm.checkpoint.content import CheckpointError

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


def text_settings(**changes: Any) -> Spoil:
    """Of the language model in a vision-language one."""
    return in_json("config.json", lambda content: content["text_config"].update(changes))


def run_the_command(load: Callable[[Path], object], folder: Path) -> None:
    """What the refusal of ``load`` says to type."""
    with pytest.raises(CheckpointError) as refusal:
        load(folder)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    (command,) = re.findall(r"python -c .*", str(refusal.value))
    subprocess.run(["bash", "-c", command], check=True, env={**os.environ, "PATH": path})


def without(name: str, heads: Sequence[str], target: Path) -> Path:
    """A copy of a reference checkpoint whose heads are cut off."""
    source = goldens.config(name).checkpoint
    shutil.copytree(source, target, copy_function=shutil.copyfile)
    if not (target / "config.yaml").exists():
        shutil.copyfile(source.parent / "config.yaml", target / "config.yaml")
    weights = load_file(target / "model.safetensors")
    cut = tuple(f"{head}_head." for head in heads)
    save_file({key: w for key, w in weights.items() if not key.startswith(cut)}, target / "model.safetensors")
    return target
