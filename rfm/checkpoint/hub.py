# SPDX-License-Identifier: MIT
"""Find a checkpoint: in a local folder, or in a repository of the Hugging Face Hub."""

from __future__ import annotations

import difflib
import re
import shlex
from collections.abc import Iterable
from pathlib import Path

from rfm.checkpoint.content import RUN_CONFIG, WEIGHTS, CheckpointError, cut, is_there, shown
from rfm.checkpoint.weights import PICKLE_STEM, pickled_weights

_SOURCE = "a folder that exists or a Hugging Face id org/name[/subfolder][@tag]"
_ID = re.compile(r"(?P<repo>\w[\w.-]*/\w[\w.-]*)(?:/(?P<subfolder>[\w=.+-]+(?:/[\w=.+-]+)*))?(?:@(?P<tag>.+))?")
_FILES = ["*.safetensors", "*.json", "*.yaml", "*.yml", "*.txt", "README.md"]
_BEST_TAG = re.compile(r"best-.*?-(-?\d+\.\d+)-step-\d+")


def find(source: str | Path) -> Path:
    """Return the local folder of a checkpoint, fetched from the Hub if necessary. Raises CheckpointError.

    An existing folder wins over a Hub id of the same name.
    """
    try:
        path = Path(source).expanduser()
        if str(source) and path.is_dir():
            return path
        if path.is_file():
            raise CheckpointError(f"checkpoint: expected {_SOURCE}, got the file {path}: name {path.parent}")
    except (OSError, RuntimeError) as error:
        got = f"{shown(str(source))}: {type(error).__name__}"
        raise CheckpointError(f"checkpoint: expected {_SOURCE}, got {got}") from error
    match = _ID.fullmatch(str(source))
    if match is None or ".." in Path(source).parts:
        raise CheckpointError(f"checkpoint: expected {_SOURCE}, got {shown(str(source))}{_near(path)}")
    return _fetch(match["repo"], match["subfolder"] or "", match["tag"], path)


def check_links(folder: Path) -> None:
    """Raise CheckpointError for a link out of ``folder``, in it or one level below.

    Links of the Hub's cache, from ``snapshots/<commit>`` to ``blobs``, are allowed.
    """
    home = folder.resolve()
    snapshots = next((path for path in home.parents if path.name == "snapshots"), None)
    allowed = home if snapshots is None or not (snapshots.parent / "blobs").is_dir() else snapshots.parent
    for file in (*folder.glob("*"), *folder.glob("*/*")):
        if file.is_symlink() and not file.resolve().is_relative_to(allowed):
            raise CheckpointError(f"{file}: expected a file of the checkpoint, got a link to {file.resolve()}")


def commit_of(folder: Path) -> str:
    """Return the commit of a checkpoint in the Hub's cache (its snapshot's name), else the folder's name."""
    return next((path.name for path in (folder, *folder.parents) if path.parent.name == "snapshots"), folder.name)


def best_tag(tags: Iterable[str]) -> str | None:
    """Return the tag ``best-<metric>-<score>-step-<n>`` with the highest score, the first of equals; else None."""
    scores = {tag: float(match[1]) for tag in tags if (match := _BEST_TAG.search(tag))}
    return max(scores, key=scores.__getitem__, default=None)


def _fetch(repo_id: str, subfolder: str, tag: str | None, path: Path) -> Path:
    """Fetch a checkpoint without pickles into the Hub's cache. ``path``: the local folder that does not exist."""
    from huggingface_hub import HfApi, snapshot_download

    patterns, run_configs = _FILES, [RUN_CONFIG]
    if subfolder:
        above = subfolder.rpartition("/")[0]
        run_configs = [f"{subfolder}/{RUN_CONFIG}", f"{above}/{RUN_CONFIG}".lstrip("/")]
        patterns = [*(f"{subfolder}/{pattern}" for pattern in _FILES), run_configs[1]]
    try:
        if tag is None:
            tag = best_tag(ref.name for ref in HfApi().list_repo_refs(repo_id).tags)
        snapshot = Path(snapshot_download(repo_id, revision=tag, allow_patterns=patterns))
        folder = snapshot / subfolder
        if not any(folder.glob("**/*.safetensors")):
            _refuse_pickles(repo_id, subfolder, tag)
        if not any(is_there(snapshot / name) for name in run_configs):  # upstream tags the commit before its upload
            _fetch_run_config_of_main(repo_id, run_configs)
    except _failures() as error:
        where = f"{repo_id}@{tag or 'latest'}"
        raise CheckpointError(
            f"{where}: cannot be fetched: {cut(str(error))}; there is no folder {path.absolute()} either{_near(path)}; "
            f"name one, or see to the Hub's name, login and network{_cached(repo_id, subfolder)}"
        ) from error
    if not folder.is_dir():
        raise CheckpointError(
            f"{repo_id}@{tag or 'main'}: expected the folder {subfolder}, got none of this name{_near(path)}"
        )
    return folder


def _failures() -> tuple[type[Exception], ...]:
    """Exceptions of huggingface_hub, which from version 1 include those of httpx."""
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError

    try:
        import httpx
    except ImportError:
        return HfHubHTTPError, HFValidationError, OSError
    return HfHubHTTPError, HFValidationError, OSError, httpx.HTTPError


def _refuse_pickles(repo_id: str, subfolder: str, tag: str | None) -> None:
    from huggingface_hub import HfApi

    files = [Path(file.rfilename) for file in HfApi().model_info(repo_id, revision=tag).siblings or ()]
    names = pickled_weights((file.name for file in files if file.parent == Path(subfolder)), PICKLE_STEM)
    if names:
        revision = "" if tag is None else f" --revision {shlex.quote(tag)}"
        fetch = f"hf download {repo_id}{revision} --local-dir FOLDER"
        raise CheckpointError(
            f"{repo_id}@{tag or 'main'}: expected {WEIGHTS}, got {cut(', '.join(names))}: pickles may run code when "
            f"they are loaded, so none is fetched. If you trust who made it: {fetch}, then name "
            f"{Path('FOLDER', subfolder)} as the checkpoint, and you are told how to convert it"
        )


def _near(path: Path) -> str:
    """Name the folders beside a missing path that have similar names."""
    try:
        names = [beside.name for beside in path.parent.iterdir() if beside.is_dir()]
    except OSError:
        return ""
    alike = difflib.get_close_matches(path.name, names)
    return f" (but {', '.join(str(path.parent / name) for name in alike)})" if alike else ""


def _cached(repo_id: str, subfolder: str) -> str:
    """Name the revisions of a repository in the Hub's cache, which need no network."""
    from huggingface_hub.constants import HF_HUB_CACHE

    refs = Path(HF_HUB_CACHE) / f"models--{repo_id.replace('/', '--')}" / "refs"
    within = f"/{subfolder}" if subfolder else ""
    names = [f"{repo_id}{within}@{file.relative_to(refs)}" for file in sorted(refs.rglob("*")) if file.is_file()]
    return f"; without it, name a revision that is in the cache: {', '.join(names)}" if names else ""


def _fetch_run_config_of_main(repo_id: str, names: Iterable[str]) -> None:
    """Fetch the first existing of these files of main into the Hub's cache, where ``find_run_config`` looks."""
    from huggingface_hub import _CACHED_NO_EXIST, hf_hub_download, try_to_load_from_cache
    from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError

    for name in names:
        try:
            hf_hub_download(repo_id, name)
            return
        except LocalEntryNotFoundError:  # no connection; the cache may record that main lacks the file
            if try_to_load_from_cache(repo_id, name) is not _CACHED_NO_EXIST:
                raise
        except EntryNotFoundError:
            pass
