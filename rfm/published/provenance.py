# SPDX-License-Identifier: MIT
"""Where a checkpoint comes from, the settings that had to be assumed, and digests that identify it."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rfm.files import MODEL_CARD, PROVENANCE, is_there, network_config

UPSTREAM_DEFAULT = "default of upstream"
_CARD_LICENSE = re.compile(r"\A---\n(?:.*\n)*?license: *(\S+) *\n")
_NAMED_PARTS = 2  # path parts to show; the rest may be private
HUB_FOLDER = "models--"  # prefix of a repository's folder name in the Hub's cache


@dataclass(frozen=True)
class Assumption:
    """A setting that affects scores but that neither weights nor files prove, so training may have used another.

    value: a JSON value
    source: a default and its author, or the caller's option
    """

    name: str
    value: Any
    source: str

    @property
    def text(self) -> str:
        """The assumption on one line."""
        is_plain = isinstance(self.value, str) and self.value.isprintable()
        return f"{self.name} {self.value if is_plain else json.dumps(self.value)} ({self.source})"


def snapshot_of(folder: Path) -> Path | None:
    """Return the commit folder in the Hub's cache that is or holds ``folder``; None if there is none."""
    return next((path for path in (folder, *folder.parents) if path.parent.name == "snapshots"), None)


def source_name(source: str | Path) -> str:
    """Return a checkpoint source's public name: the Hub id, also for a folder in its cache, or a path's end."""
    if not is_folder(source):
        return str(source)
    folder = Path(source).expanduser().resolve()
    snapshot = snapshot_of(folder)
    if snapshot is None or not snapshot.parent.parent.name.startswith(HUB_FOLDER):
        return "/".join(folder.parts[1:][-_NAMED_PARTS:])  # without the root
    names = [*snapshot.parent.parent.name.removeprefix(HUB_FOLDER).split("--"), *folder.relative_to(snapshot).parts]
    return f"{'/'.join(names)}@{snapshot.name}"


def license_of(folder: Path) -> str | None:
    """Return the licence in a checkpoint's model card (README.md) or config.json; None: neither states one."""
    card = folder / MODEL_CARD
    if is_there(card) and (found := _CARD_LICENSE.search(card.read_text(errors="replace"))):
        return found[1].strip("\"'")
    stated = network_config(folder).get("license")
    return stated if isinstance(stated, str) and stated else None


def is_folder(source: str | Path) -> bool:
    """True if the source is a local folder, which wins over a Hub id."""
    return bool(str(source)) and Path(source).expanduser().is_dir()


def file_name(file: Path, folder: Path) -> str:
    """Return the path of a checkpoint's file relative to the checkpoint's folder."""
    return os.path.relpath(file, folder if file.is_relative_to(folder) else folder.resolve())


def assumption_lines(assumptions: Sequence[Assumption]) -> list[str]:
    """Return one line for the user about all assumptions, or an empty list."""
    listed = "; ".join(each.text for each in assumptions)
    line = f"not shown by the checkpoint: {listed}; scores differ from the run's if it had others"
    return [line] if assumptions else []


def write(assumptions: Sequence[Assumption], computation: str | None, folder: Path) -> None:
    """Write PROVENANCE, with the versions in ``Description.computation``, into an exported checkpoint's folder."""
    content = {"assumed": [asdict(each) for each in assumptions], "computation": computation}
    (folder / PROVENANCE).write_text(json.dumps(content, indent=2) + "\n")
