# SPDX-License-Identifier: MIT
"""What a checkpoint's scores depend on: what decided each setting, and the digests that identify it."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

PROVENANCE = "provenance.json"  # beside an exported checkpoint's config.json; nothing reads it
OF_WEIGHTS = "weights"
OF_UPSTREAM = "default of upstream"

_NAMED_PARTS = 2  # of a path; the whole path may be private


@dataclass(frozen=True)
class Decision:
    """One thing that scores depend on, and what decided it.

    value: as JSON can hold it
    source: OF_WEIGHTS, a file and its key, an option of the caller, or a default and whose it is
    is_assumed: neither weights nor files prove it, so that it may not be what training had
    """

    name: str
    value: Any
    source: str
    is_assumed: bool = False

    @property
    def text(self) -> str:
        """The value on one line."""
        is_plain = isinstance(self.value, str) and self.value.isprintable()
        return self.value if is_plain else json.dumps(self.value)


# Clients pad short trajectories by default, for a checkpoint of either family.
TRAINED_WITH_PADDING = Decision("trained_padding", True, "upstream: every training run pads")


def source_name(source: str | Path) -> str:
    """How models name the source of a checkpoint: by the end of a folder's path, or the Hub id."""
    return "/".join(Path(source).expanduser().resolve().parts[-_NAMED_PARTS:]) if is_folder(source) else str(source)


def is_folder(source: str | Path) -> bool:
    """Whether it is a folder here, which wins over a Hub id."""
    return bool(str(source)) and Path(source).expanduser().is_dir()


def file_name(file: Path, folder: Path) -> str:
    """The path of a checkpoint's file as seen from its folder."""
    return os.path.relpath(file, folder if file.is_relative_to(folder) else folder.resolve())


def assumed(decisions: Sequence[Decision]) -> list[str]:
    """One line for the user on all that was assumed; none if nothing was."""
    listed = [f"{each.name} {each.text} ({each.source})" for each in decisions if each.is_assumed]
    if not listed:
        return []
    return [
        f"assumed, and not shown by the checkpoint: {'; '.join(listed)}; scores differ from the run's if it had "
        "others; rfm export --explain shows what decided each setting"
    ]


def table(decisions: Sequence[Decision]) -> str:
    """Lines of name, source and value in columns."""
    rows = [(each.name, each.source + (", assumed" if each.is_assumed else ""), each.text) for each in decisions]
    widths = [max((len(row[column]) for row in rows), default=0) for column in range(2)]
    return "\n".join(f"{name:{widths[0]}}  {source:{widths[1]}}  {text}" for name, source, text in rows)


def write(decisions: Sequence[Decision], folder: Path) -> None:
    """Writes PROVENANCE into an exported checkpoint's folder."""
    content = json.dumps([asdict(each) for each in decisions], indent=2)
    (folder / PROVENANCE).write_text(content + "\n")


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
