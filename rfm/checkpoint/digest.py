# SPDX-License-Identifier: MIT
"""Digests of weights and of settings, which together identify a checkpoint."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rfm.checkpoint.decision import PROVENANCE

DIGEST_DIGITS = 16  # of 64: enough to identify a checkpoint, and to find damage

# Of files beside the weights that decide scores: configuration, tokenizer, image processor.
SETTINGS_SUFFIXES = (".json", ".jinja", ".model", ".txt", ".yaml")

_CHUNK_BYTES = 2**22


def weights_digest(folders: Iterable[Path]) -> str:
    """The first digits of the SHA-256 of all safetensors files in the folders, one behind the other. Raises OSError."""
    digest = hashlib.sha256()
    for file in (file for folder in folders for file in sorted(folder.rglob("*.safetensors"))):
        with file.open("rb") as content:
            while chunk := content.read(_CHUNK_BYTES):
                digest.update(chunk)
    return digest.hexdigest()[:DIGEST_DIGITS]


def settings_digest(folders: Iterable[Path], told: Mapping[str, Any]) -> str:
    """The first digits of the SHA-256 of what decides scores beside the weights. Raises OSError.

    folders: whose files of SETTINGS_SUFFIXES count, with their paths; but for PROVENANCE, which decides nothing
    told: what no file says, as JSON can hold it
    """
    digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode())
    for folder in folders:
        for file in sorted(file for file in folder.rglob("*") if _counts(file)):
            content = file.read_bytes()
            digest.update(f"{file.relative_to(folder).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:DIGEST_DIGITS]


def _counts(file: Path) -> bool:
    return file.suffix in SETTINGS_SUFFIXES and file.name != PROVENANCE and file.is_file()
