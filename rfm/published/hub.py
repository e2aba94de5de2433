# SPDX-License-Identifier: MIT
"""Find a checkpoint: in a local folder, or in a Hugging Face Hub repository."""

from __future__ import annotations

import logging
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import TypeVar

from safetensors import SafetensorError, safe_open

from rfm.files import (
    ADAPTER_CONFIG,
    ADAPTER_WEIGHTS,
    HUB_FILES,
    HUB_WEIGHTS,
    RUN_CONFIG,
    WEIGHTS,
    WEIGHTS_INDEX,
    CheckpointError,
    cut,
    is_there,
    network_config,
    read_json,
    read_run_config,
    settings_digest,
    shown,
    weights_digest,
)
from rfm.published.provenance import snapshot_of
from rfm.published.run_config import find_run_config, section_of
from rfm.published.weights import refuse_pickles
from rfm_client.contract.hub_access import HubError, hub_errors, unreachable

_log = logging.getLogger(__name__)
_SOURCE = "a folder that exists or a Hugging Face id org/name[/subfolder][@tag]"
_ID = re.compile(r"(?P<repo>\w[\w.-]*/\w[\w.-]*)(?:/(?P<subfolder>[\w=.+-]+(?:/[\w=.+-]+)*))?(?:@(?P<tag>.+))?")
_COMMIT = re.compile(r"[0-9a-f]+")
_T = TypeVar("_T")
_FLOAT32_BYTES = 4
_BASES = ("base_model_id", "base_model_name_or_path", "vlm_name")  # keys that name a base model
_BEST_TAG = re.compile(r"best-.*?-(-?\d+\.\d+)-step-\d+")


@dataclass(frozen=True)
class Found:
    """A checkpoint's files before they are fetched.

    identity: what changes whenever the checkpoint does: commits on the Hub, digests of a local folder's files; digests
        of a local base model that its settings name
    sizes: bytes of the files in the checkpoint's folder, by name
    missing_bytes: what ``find`` will download
    float32_bytes: bytes of the weights in float32, of which most networks load half; None: unknown
    """

    identity: tuple[str | None, ...]
    sizes: Mapping[str, int]
    missing_bytes: int = 0
    float32_bytes: int | None = 0

    @property
    def weights_bytes(self) -> int:
        """The size of all weights, for an adapter without its base model."""
        return sum(size for name, size in self.sizes.items() if name.endswith(Path(HUB_WEIGHTS).suffix))

    @property
    def is_adapter(self) -> bool:
        """True if the weights change those of a base model."""
        return ADAPTER_WEIGHTS in self.sizes and not {WEIGHTS, WEIGHTS_INDEX} & self.sizes.keys()


def find(source: str | Path, say: Callable[[str], object] = _log.warning) -> Path:
    """Return a checkpoint's local folder, fetched from the Hub if necessary. Raises CheckpointError.

    An existing folder wins over a Hub id with the same name.
    say: receives a line about the cached revision in use if the Hub cannot be reached
    """
    folder = _local(source)
    return _ask(source, say, _snapshot) if folder is None else folder


def look(source: str | Path, say: Callable[[str], object] = _log.warning) -> Found:
    """Return what ``find`` will find, without a download. Raises CheckpointError. say: as for ``find``"""
    folder = _local(source)
    if folder is None:
        return _ask(source, say, _look)
    run_config = find_run_config(folder)
    run = "" if run_config is None else run_config.read_text(errors="replace")
    sizes = {file.name: file.stat().st_size for file in folder.iterdir() if file.is_file()}
    return Found((*digests(folder), run, *_of_bases(folder)), sizes, float32_bytes=_float32_bytes(folder))


def digests(folder: Path) -> tuple[str, str]:
    """Return digests of a local folder's weights and settings. Raises CheckpointError for weights that are no file."""
    for file in folder.rglob(HUB_WEIGHTS):
        is_there(file)
    return weights_digest([folder]), settings_digest([folder], {})


def _of_bases(folder: Path) -> Iterator[str]:
    """Yield digests of each local folder that a checkpoint's settings name as base model. Raises CheckpointError."""
    run_config, adapter = find_run_config(folder), folder / ADAPTER_CONFIG
    run = {} if run_config is None else section_of(read_run_config(run_config), "model")
    for settings in (run, read_json(adapter) if is_there(adapter) else {}, network_config(folder)):
        for value in map(settings.get, _BASES):
            base = os.path.expanduser(value) if isinstance(value, str) else ""  # noqa: PTH111  untrusted text:
            if os.path.isdir(base):  # noqa: PTH112  pathlib raises errors for some
                yield from digests(Path(base))


def _float32_bytes(folder: Path) -> int | None:
    """Return ``Found.float32_bytes``; None for a damaged file, which an export reports."""
    shapes: list[list[int]] = []
    try:
        for file in folder.glob(HUB_WEIGHTS):
            with safe_open(file, "numpy") as tensors:
                parts = [tensors.get_slice(name) for name in tensors.keys()]  # noqa: SIM118
                shapes += [part.get_shape() for part in parts if part.get_dtype() == "F32"]
    except (OSError, SafetensorError):
        return None
    return sum(_FLOAT32_BYTES * math.prod(shape) for shape in shapes)


def missing_bytes(repo_id: str, patterns: Sequence[str], revision: str | None = None) -> int:
    """Return what a download of a revision's files will take; 0 without an answer from the Hub. Raises HubError."""
    if unreachable(repo_id, revision=revision) is not None:
        return 0
    with hub_errors():
        commit, sizes, _ = _sizes(repo_id, patterns, revision)
    return _missing(repo_id, commit, sizes)


def _local(source: str | Path) -> Path | None:
    """Return the local folder; None: the source may be a Hub id. Raises CheckpointError."""
    try:
        path = Path(source).expanduser()
        if str(source) and path.is_dir():
            return path
        if path.is_file():
            raise CheckpointError.at("checkpoint", _SOURCE, f"the file {path}", f"name its folder, {path.parent}")
    except (OSError, RuntimeError) as error:
        got = f"{shown(str(source))}: {type(error).__name__}"
        raise CheckpointError.at("checkpoint", _SOURCE, got) from error
    return None


def check_links(folder: Path) -> None:
    """Raise CheckpointError for a link out of ``folder``, in it or one level below.

    Links inside the Hub's cache, from ``snapshots/<commit>`` to ``blobs``, are allowed.
    """
    home = folder.resolve()
    snapshot = snapshot_of(home)
    allowed = home if snapshot is None or not (snapshot.parent.parent / "blobs").is_dir() else snapshot.parent.parent
    for file in (*folder.glob("*"), *folder.glob("*/*")):
        if file.is_symlink() and not file.resolve().is_relative_to(allowed):
            raise CheckpointError.at(file, "a file of the checkpoint", f"a link to {file.resolve()}")


def commit_of(folder: Path) -> str:
    """Return a checkpoint's commit in the Hub's cache (its snapshot's name), otherwise the folder's name."""
    return (snapshot_of(folder) or folder).name


def best_tag(tags: Iterable[str]) -> str | None:
    """Return the tag ``best-<metric>-<score>-step-<n>`` with the highest score (the first if tied), otherwise None."""
    scores = {tag: float(match[1]) for tag in tags if (match := _BEST_TAG.search(tag))}
    return max(scores, key=scores.__getitem__, default=None)


def _ask(source: str | Path, say: Callable[[str], object], answer: Callable[..., _T]) -> _T:
    """Return what ``answer`` returns for the repository, subfolder and tag of a Hub id. Raises CheckpointError."""
    match = _ID.fullmatch(str(source))
    if match is None or ".." in Path(source).parts:
        raise CheckpointError.at("checkpoint", _SOURCE, shown(str(source)))
    repo_id, subfolder, tag = match["repo"], match["subfolder"] or "", match["tag"]
    down = None
    try:
        down = unreachable(repo_id, revision=tag)
        with hub_errors():
            tag = tag or (_best_revision(repo_id) if down is None else _cached_revision(repo_id, down, say))
            return answer(repo_id, subfolder, tag, is_down=down is not None)
    except HubError as error:
        where = repo_id if tag is None else f"{repo_id}@{tag}"
        why = str(error) if down in (None, str(error)) else f"{down}, and {error}"
        raise CheckpointError(
            f"{where}: cannot be fetched: {cut(why)}; there is no folder {Path(source).absolute()} either; "
            f"name one, or see to the Hub's name, login and network{_cached(repo_id, subfolder)}"
        ) from error


def _best_revision(repo_id: str) -> str | None:
    from huggingface_hub import HfApi

    return best_tag(ref.name for ref in HfApi().list_repo_refs(repo_id).tags)


def _cached_revision(repo_id: str, down: str, say: Callable[[str], object]) -> str:
    """Return the best revision with weights in the Hub's cache, and report it. Raises HubError if there is none."""
    snapshots = {name: folder for name, folder in _snapshots(repo_id).items() if any(folder.rglob(HUB_WEIGHTS))}
    revision = best_tag(snapshots) or ("main" if "main" in snapshots else None)
    if revision is None:
        raise HubError("the cache has neither a best revision nor a main with weights")
    used = f"{repo_id}@{revision} of the cache is used (commit {snapshots[revision].name}), because {down}"
    say(f"{used}; the Hub may have a newer or better revision: to choose one, name {repo_id}@REVISION")
    return revision


def _snapshot(repo_id: str, subfolder: str, tag: str | None, *, is_down: bool) -> Path:
    """Return a revision's folder in the Hub's cache, with all files that are read. tag: None: main."""
    from huggingface_hub import HfApi, snapshot_download

    patterns, run_configs = _wanted(subfolder)
    snapshot = Path(snapshot_download(repo_id, revision=tag, allow_patterns=patterns, local_files_only=is_down))
    folder = snapshot / subfolder
    if not is_down and not any(folder.rglob(HUB_WEIGHTS)):
        files = [Path(file.rfilename) for file in HfApi().model_info(repo_id, revision=tag).siblings or ()]
        names = (file.name for file in files if file.parent == Path(subfolder))
        refuse_pickles(f"{repo_id}@{tag or 'main'}", WEIGHTS, names)
    if not any(is_there(snapshot / name) for name in run_configs):  # upstream tags the commit before its upload
        _fetch_run_config_of_main(repo_id, run_configs, is_down=is_down)
    if not folder.is_dir():
        raise CheckpointError.at(f"{repo_id}@{tag or 'main'}", f"the folder {subfolder}", "none of this name")
    return folder


def _wanted(subfolder: str) -> tuple[list[str], list[str]]:
    """Return patterns for the files that are read, and where the run's config.yaml may be."""
    if not subfolder:
        return HUB_FILES, [RUN_CONFIG]
    above = subfolder.rpartition("/")[0]
    run_configs = [f"{subfolder}/{RUN_CONFIG}", f"{above}/{RUN_CONFIG}".lstrip("/")]
    return [*(f"{subfolder}/{pattern}" for pattern in HUB_FILES), run_configs[1]], run_configs


def _look(repo_id: str, subfolder: str, tag: str | None, *, is_down: bool) -> Found:
    """Return what ``_snapshot`` will find."""
    from huggingface_hub import HfApi, snapshot_download

    patterns, run_configs = _wanted(subfolder)
    missing, float32 = 0, None
    if is_down:
        snapshot = Path(snapshot_download(repo_id, revision=tag, local_files_only=True))
        files = [file for file in snapshot.rglob("*") if file.is_file()]
        commit, sizes = snapshot.name, {str(file.relative_to(snapshot)): file.stat().st_size for file in files}
    else:
        commit, sizes, float32 = _sizes(repo_id, patterns, tag)
        missing = _missing(repo_id, commit, sizes)
    run_commit = None
    if sizes.keys().isdisjoint(run_configs):  # then main has it
        cached = _snapshots(repo_id).get("main")
        run_commit = HfApi().model_info(repo_id).sha if not is_down else None if cached is None else cached.name
    of_folder = {Path(name).name: size for name, size in sizes.items() if Path(name).parent == Path(subfolder)}
    folder = _home(repo_id) / "snapshots" / commit / subfolder
    if not missing:
        return Found((commit, run_commit, *_of_bases(folder)), of_folder, float32_bytes=_float32_bytes(folder))
    return Found((commit, run_commit), of_folder, missing, None if subfolder else float32)


def _sizes(
    repo_id: str, patterns: Sequence[str], revision: str | None = None
) -> tuple[str, dict[str, int], int | None]:
    """Return a revision's commit, the size of each file that fits a pattern, and its root's ``Found.float32_bytes``."""
    from huggingface_hub import HfApi

    info = HfApi().model_info(repo_id, revision=revision, files_metadata=True)
    sizes = {file.rfilename: file.size or 0 for file in info.siblings or ()}
    float32 = None if info.safetensors is None else _FLOAT32_BYTES * info.safetensors.parameters.get("F32", 0)
    wanted = {name: size for name, size in sizes.items() if any(fnmatch(name, each) for each in patterns)}
    return str(info.sha), wanted, float32


def _missing(repo_id: str, commit: str, sizes: Mapping[str, int]) -> int:
    """Return the size of the files that the Hub's cache lacks."""
    from huggingface_hub import try_to_load_from_cache

    cached = {name for name in sizes if isinstance(try_to_load_from_cache(repo_id, name, revision=commit), str)}
    return sum(size for name, size in sizes.items() if name not in cached)


def _home(repo_id: str) -> Path:
    """Return the folder of a repository in the Hub's cache."""
    from huggingface_hub.constants import HF_HUB_CACHE

    return Path(HF_HUB_CACHE) / f"models--{repo_id.replace('/', '--')}"


def _snapshots(repo_id: str) -> dict[str, Path]:
    """Return the folders of a repository's revisions in the Hub's cache, by tag or branch."""
    home = _home(repo_id)
    refs = [file for file in sorted((home / "refs").rglob("*")) if file.is_file()]
    commits = {str(file.relative_to(home / "refs")): file.read_text().strip() for file in refs}
    return {name: home / "snapshots" / commit for name, commit in commits.items() if _COMMIT.fullmatch(commit)}


def _cached(repo_id: str, subfolder: str) -> str:
    """Name a repository's revisions in the Hub's cache, which need no network."""
    names = [f"{repo_id}{'/' * bool(subfolder)}{subfolder}@{name}" for name in _snapshots(repo_id)]
    return f"; without it, name a revision that is in the cache: {', '.join(names)}" if names else ""


def _fetch_run_config_of_main(repo_id: str, names: Iterable[str], *, is_down: bool) -> None:
    """Fetch the first of these files that exists on main into the Hub's cache, where ``find_run_config`` looks."""
    from huggingface_hub import _CACHED_NO_EXIST, hf_hub_download, try_to_load_from_cache
    from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError

    for name in names:
        try:
            hf_hub_download(repo_id, name, local_files_only=is_down)
            return
        except LocalEntryNotFoundError:  # no connection; the cache may record that main lacks the file
            if try_to_load_from_cache(repo_id, name) is not _CACHED_NO_EXIST:
                raise
        except EntryNotFoundError:
            pass
