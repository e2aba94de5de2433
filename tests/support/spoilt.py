# SPDX-License-Identifier: MIT
"""Copies of checkpoints that a test may spoil."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

import goldens

WEIGHTS = "model.safetensors"

Spoil = Callable[[Path], object]


def copied(config: goldens.Config, folder: Path) -> Path:
    shutil.copytree(config.checkpoint, folder)
    for file in folder.rglob("*"):
        file.chmod(0o644 if file.is_file() else 0o755)
    return folder


def files_in(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def weights(change: Callable[[dict[str, torch.Tensor]], object]) -> Spoil:
    def spoil(folder: Path) -> None:
        tensors = load_file(folder / WEIGHTS)
        change(tensors)
        save_file(tensors, folder / WEIGHTS)

    return spoil
