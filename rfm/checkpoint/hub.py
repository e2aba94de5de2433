# SPDX-License-Identifier: MIT
"""Where a checkpoint is: a local folder, or a repository of the Hugging Face Hub."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from rfm.checkpoint.content import CheckpointError, is_there, shown
from rfm.checkpoint.files import RUN_CONFIG

_BEST_TAG = re.compile(r"best-.*?-(-?\d+\.\d+)-step-\d+")


def find(source: str | Path) -> Path:
    """The local folder of a checkpoint, fetched from the Hub if need be. An existing path wins over an id."""
    expected = "a folder that exists or a Hugging Face id org/name[@tag]"
    try:
        path = Path(source).expanduser()
        if str(source) and path.is_dir():
            return path
        if path.is_file():
            raise CheckpointError(f"checkpoint: expected {expected}, got the file {path}: name {path.parent}")
    except (OSError, RuntimeError) as error:
        got = f"{shown(str(source))}: {type(error).__name__}"
        raise CheckpointError(f"checkpoint: expected {expected}, got {got}") from error
    repo_id, _, tag = str(source).partition("@")
    if not re.fullmatch(r"\w[\w.-]*/\w[\w.-]*", repo_id):
        raise CheckpointError(f"checkpoint: expected {expected}, got {shown(str(source))}")
    return _fetch(repo_id, tag or None)


def best_tag(tags: Iterable[str]) -> str | None:
    """The tag ``best-<metric>-<score>-step-<n>`` of the highest score, the first of equals; None if there is none."""
    scores = {tag: float(match[1]) for tag in tags if (match := _BEST_TAG.search(tag))}
    return max(scores, key=scores.__getitem__, default=None)


def _fetch(repo_id: str, tag: str | None) -> Path:
    from huggingface_hub import HfApi, snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError

    patterns = ["*.safetensors", "*.json", "*.yaml", "*.txt"]
    try:
        if tag is None:
            tag = best_tag(ref.name for ref in HfApi().list_repo_refs(repo_id).tags)
        folder = Path(snapshot_download(repo_id, revision=tag, allow_patterns=patterns))
        if not is_there(folder / RUN_CONFIG):  # upstream's uploader tags a commit of before config.yaml's
            _fetch_run_config_of_main(repo_id)
        return folder
    except (HfHubHTTPError, HFValidationError, OSError) as error:
        remedy = "there is no folder of this name either; name one, or see to the Hub's name, login and network"
        raise CheckpointError(f"{repo_id}@{tag or 'latest'}: cannot be fetched: {error}; {remedy}") from error


def _fetch_run_config_of_main(repo_id: str) -> None:
    """Fetches main's config.yaml into the Hub's cache, where ``find_run_config`` looks. Even main may have none."""
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError

    try:
        hf_hub_download(repo_id, RUN_CONFIG)
    except LocalEntryNotFoundError:  # the cache lacks it, and the Hub was not tried
        raise
    except EntryNotFoundError:
        return
