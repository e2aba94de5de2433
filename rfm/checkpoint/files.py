# SPDX-License-Identifier: MIT
"""The files of a checkpoint: where it is, its weights, what its names and numbers may be."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfm.checkpoint.content import CheckpointError, cut, is_there, listed, read_json, read_tensors, shown

if TYPE_CHECKING:
    from torch import Tensor

WEIGHTS = "model.safetensors"
WEIGHTS_INDEX = "model.safetensors.index.json"
NETWORK_CONFIG = "config.json"
RUN_CONFIG = "config.yaml"

_BEST_TAG = re.compile(r"best-.*?-(-?\d+\.\d+)-step-\d+")
_COMMIT_DIGITS = 40
MAX_COUNT = 2**20  # of frames: longer than any trajectory
_LEVELS = ("*", "*/*", "*/*/*")  # below a folder: a training run's checkpoints, those of a model repository
_PICKLES = ("*.bin", "*.pt", "*.pth", "*.ckpt", "*.pkl")
_CONVERT = (
    "python -c \"import torch, safetensors.torch as s; weights = torch.load('{file}', map_location='cpu', "
    "weights_only=True); s.save_file({{k: v.contiguous() for k, v in weights.items()}}, '{target}')\""
)


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


def find_run_config(folder: Path) -> Path | None:
    """config.yaml in the checkpoint's folder, its parent or, of a snapshot in the Hub's cache, main's snapshot."""
    home = folder.resolve()
    candidates = (folder / RUN_CONFIG, home.parent / RUN_CONFIG, *_run_config_of_main(home))
    return next((file for file in candidates if is_there(file)), None)


def _run_config_of_main(home: Path) -> list[Path]:
    """Where the Hub's cache has main's config.yaml: in the snapshot of the commit in refs/main, beside ``home``."""
    main = home.parent.parent / "refs" / "main"
    if home.parent.name != "snapshots" or not is_there(main):
        return []
    with main.open("rb") as file:
        commit = file.read(_COMMIT_DIGITS + 1)
    return [home.parent / commit.decode() / RUN_CONFIG] if re.fullmatch(rb"[0-9a-f]+", commit) else []


def check_shapes(expected: Mapping[str, Tensor], got: Mapping[str, Tensor]) -> None:
    """Raises CheckpointError unless both have the same names, shapes and kinds of numbers."""
    check_keys(expected.keys(), got.keys())
    for name, tensor in got.items():
        if tensor.shape != expected[name].shape:
            raise CheckpointError(f"{name}: expected {list(expected[name].shape)}, got {list(tensor.shape)}")
        if tensor.is_floating_point() != expected[name].is_floating_point():
            raise CheckpointError(f"{name}: expected numbers like {expected[name].dtype}, got {tensor.dtype}")


def check_finite(weights: Mapping[str, Tensor]) -> None:
    """Raises CheckpointError for a weight that is no number: every score would be none."""
    for name, tensor in weights.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            at = (~tensor.isfinite()).nonzero()[0].tolist()
            raise CheckpointError(f"{name}: expected finite weights, got {tensor[tuple(at)].item()} at {at}")


def check_links(folder: Path) -> None:
    """Raises CheckpointError for a link in ``folder``, or one level below, to somewhere else.

    Those of the Hub's cache lead from ``snapshots/<commit>`` to ``blobs`` beside it.
    """
    home = folder.resolve()
    snapshots = next((path for path in home.parents if path.name == "snapshots"), None)
    allowed = home if snapshots is None or not (snapshots.parent / "blobs").is_dir() else snapshots.parent
    for file in (*folder.glob("*"), *folder.glob("*/*")):
        if file.is_symlink() and not file.resolve().is_relative_to(allowed):
            raise CheckpointError(f"{file}: expected a file of the checkpoint, got a link to {file.resolve()}")


def trained_frames(run: Mapping[str, Any], file: Path) -> int | None:
    """The most frames of a trajectory in training, as config.yaml has it; None if it has none."""
    data = run.get("data") or {}
    if not isinstance(data, dict):
        raise CheckpointError(f"{file}: data: expected a mapping, got {shown(data)}")
    return frame_count(data.get("max_frames"), f"{file}: data.max_frames")


def frame_count(frames: Any, where: str) -> int | None:
    """The value if it is a count of frames, or None. Raises CheckpointError."""
    if frames is not None and (type(frames) is not int or frames < 1):
        raise CheckpointError(f"{where}: expected a whole number of at least 1, got {shown(frames)}")
    if frames is not None and frames > MAX_COUNT:
        raise CheckpointError(f"{where}: expected at most {MAX_COUNT}, got {shown(frames)}")
    return frames


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


def read_weights(folder: Path) -> dict[str, Tensor]:
    """All tensors of model.safetensors or of the shards that its index names. Raises CheckpointError."""
    if is_there(folder / WEIGHTS):
        return read_tensors(folder / WEIGHTS)
    if is_there(folder / WEIGHTS_INDEX):
        return _read_shards(folder / WEIGHTS_INDEX)
    pickles = sorted(file for pattern in _PICKLES for file in folder.glob(pattern))
    if pickles:
        command = _CONVERT.format(file=pickles[0], target=folder / WEIGHTS)
        raise CheckpointError(
            f"{folder}: expected {WEIGHTS}, got {pickles[0].name}: pickle files run code when loaded and are refused; "
            f"if you trust it, convert it with: {command}"
        )
    below = next((file.parent for level in _LEVELS for file in sorted(folder.glob(f"{level}/{WEIGHTS}*"))), None)
    remedy = "a checkpoint's folder has it, beside config.json" if below is None else f"{below} has it"
    raise CheckpointError(f"{folder}: expected {WEIGHTS} or {WEIGHTS_INDEX}, got {_listing(folder)}: {remedy}")


def _read_shards(index: Path) -> dict[str, Tensor]:
    weight_map = read_json(index).get("weight_map")
    if not isinstance(weight_map, dict):
        raise CheckpointError(f"{index}: expected a weight_map, got none")
    weights: dict[str, Tensor] = {}
    for name in dict.fromkeys(map(str, weight_map.values())):
        if Path(name).name != name or not name.endswith(".safetensors"):
            raise CheckpointError(f"{index}: expected names of files beside it, got {shown(name)}")
        if not is_there(index.parent / name):
            raise CheckpointError(f"{index}: names the shard {name}, which is not there")
        weights |= read_tensors(index.parent / name)
    check_keys(weight_map.keys(), weights.keys())
    return weights


def take_prefix(weights: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Moves the tensors under ``prefix`` out of ``weights``, without the prefix."""
    names = [name for name in weights if name.startswith(prefix)]
    return {name.removeprefix(prefix): weights.pop(name) for name in names}


def check_keys(expected: Iterable[str], got: Iterable[str]) -> None:
    """Raises CheckpointError that lists the missing and the unexpected."""
    missing, unexpected = sorted(set(expected) - set(got)), sorted(set(got) - set(expected))
    if missing or unexpected:
        named = [listed(names) if names else "none" for names in (missing, unexpected)]
        raise CheckpointError(f"{WEIGHTS}: missing keys: {named[0]}; unexpected keys: {named[1]}")


def _listing(folder: Path) -> str:
    return cut(", ".join(sorted(path.name for path in folder.iterdir()))) or "nothing"
