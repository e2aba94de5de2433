# SPDX-License-Identifier: MIT
"""Models in a repository folder; for a folder without models, the likely mistake and its remedy."""

from __future__ import annotations

import os
from pathlib import Path

CONFIG_FILE = "config.pbtxt"
_WEIGHTS = "model.safetensors*"  # also matches the index of shards
_EXPORT = "rfm export --checkpoint {checkpoint} --repository {repository}"
_LEVELS_ABOVE = 4  # from MODEL/VERSION/checkpoint up to the repository


def models_in(repository: Path) -> list[str]:
    """Return the sorted names of a repository's models; empty for the folder of a model."""
    if (repository / CONFIG_FILE).exists():
        return []
    return sorted(file.parent.name for file in repository.glob(f"*/{CONFIG_FILE}"))


def no_models(repository: Path) -> str:
    """Return the error message for a folder without models, with the remedy."""
    got, remedy = _found(repository)
    return f"repository: expected a folder of models, got {repository}, {got}: {remedy}"


def _found(folder: Path) -> tuple[str, str]:
    new = _EXPORT.format(checkpoint="CHECKPOINT", repository=folder)
    if not folder.exists():
        return "which is not there", f"{new} writes one"
    if not folder.is_dir():
        return "a file", "--repository names the folder"
    if not os.access(folder, os.R_OK | os.X_OK):
        return "which may not be read", "give this user the right to read it"
    above = next((path for path in folder.resolve().parents[:_LEVELS_ABOVE] if models_in(path)), None)
    if above is not None:
        return "a folder inside one", f"--repository {above}"
    if any(folder.glob(_WEIGHTS)):
        export = _EXPORT.format(checkpoint=folder, repository="model_repository")
        return "a checkpoint", f"{export}, then --repository model_repository"
    below = next((file.parent.parent for file in sorted(folder.glob(f"*/*/{CONFIG_FILE}"))), None)
    if below is not None:
        return "a folder that has one", f"--repository {below}"
    return "which has none", f"{new} writes them"
