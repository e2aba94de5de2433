# SPDX-License-Identifier: MIT
"""A digest of weights, which identifies a checkpoint."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

DIGEST_DIGITS = 16  # of 64: enough to identify a checkpoint, and to find damage

_CHUNK_BYTES = 2**22


def weights_digest(folders: Iterable[Path]) -> str:
    """The first digits of the SHA-256 of all safetensors files in the folders, one behind the other. Raises OSError."""
    digest = hashlib.sha256()
    for file in (file for folder in folders for file in sorted(folder.rglob("*.safetensors"))):
        with file.open("rb") as content:
            while chunk := content.read(_CHUNK_BYTES):
                digest.update(chunk)
    return digest.hexdigest()[:DIGEST_DIGITS]
