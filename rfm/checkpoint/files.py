# SPDX-License-Identifier: MIT
"""The files of a checkpoint: where it is, its weights, its configurations. Nothing in them is executed."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

WEIGHTS = "model.safetensors"
WEIGHTS_INDEX = "model.safetensors.index.json"
NETWORK_CONFIG = "config.json"
RUN_CONFIG = "config.yaml"

_BEST_TAG = re.compile(r"best-.*?-(-?\d+\.\d+)-step-\d+")
_PICKLES = ("*.bin", "*.pt", "*.pth", "*.ckpt", "*.pkl")
_CONVERT = (
    "python -c \"import torch, safetensors.torch as s; weights = torch.load('{file}', map_location='cpu', "
    "weights_only=True); s.save_file({{k: v.contiguous() for k, v in weights.items()}}, '{target}')\""
)


class CheckpointError(Exception):
    """A checkpoint that cannot be loaded: what is wrong with which file, and what to do about it."""


def find(source: str | Path) -> Path:
    """The local folder of a checkpoint, fetched from the Hub if need be. An existing path wins over an id."""
    path = Path(source).expanduser()
    if str(source) and path.is_dir():
        return path
    repo_id, _, tag = str(source).partition("@")
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", repo_id):
        expected = "a folder that exists or a Hugging Face id org/name[@tag]"
        raise CheckpointError(f"checkpoint: expected {expected}, got {str(source)!r}")
    return _fetch(repo_id, tag or None)


def best_tag(tags: Iterable[str]) -> str | None:
    """The tag ``best-<metric>-<score>-step-<n>`` of the highest score, the first of equals; None if there is none."""
    scores = {tag: float(match[1]) for tag in tags if (match := _BEST_TAG.search(tag))}
    return max(scores, key=scores.__getitem__, default=None)


def find_run_config(folder: Path) -> Path | None:
    """config.yaml in the checkpoint's folder or its parent."""
    candidates = (folder / RUN_CONFIG, folder.resolve().parent / RUN_CONFIG)
    return next((file for file in candidates if file.is_file()), None)


def check_shapes(expected: Mapping[str, Tensor], got: Mapping[str, Tensor]) -> None:
    """Raises CheckpointError unless both have the same names and shapes."""
    check_keys(expected.keys(), got.keys())
    for name, tensor in got.items():
        if tensor.shape != expected[name].shape:
            raise CheckpointError(f"{name}: expected {list(expected[name].shape)}, got {list(tensor.shape)}")


def read_run_config(file: Path) -> dict[str, Any]:
    """config.yaml as plain mappings, lists and scalars, whatever Python objects its tags ask for."""
    try:
        config = yaml.load(file.read_text(), Loader=_PlainLoader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{file}: expected YAML, got {error}") from error
    if not isinstance(config, dict):
        raise CheckpointError(f"{file}: expected a mapping, got {type(config).__name__}")
    return config


def trained_frames(run: Mapping[str, Any], file: Path) -> int | None:
    """The most frames of a trajectory in training, as config.yaml tells it; None if it does not."""
    data = run.get("data") or {}
    if not isinstance(data, dict):
        raise CheckpointError(f"{file}: data: expected a mapping, got {data!r}")
    return frame_count(data.get("max_frames"), f"{file}: data.max_frames")


def frame_count(frames: Any, where: str) -> int | None:
    """The value if it is a count of frames, or None. Raises CheckpointError."""
    if frames is not None and (type(frames) is not int or frames < 1):
        raise CheckpointError(f"{where}: expected a whole number of at least 1, got {frames!r}")
    return frames


class _PlainLoader(yaml.SafeLoader):
    """SafeLoader that reads nodes tagged as Python objects as the plain data that they hold."""


def _plain(loader: yaml.SafeLoader, _suffix: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return node.value


_PlainLoader.add_multi_constructor("tag:yaml.org,2002:python/", _plain)


def _fetch(repo_id: str, tag: str | None) -> Path:
    from huggingface_hub import HfApi, snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError

    patterns = ["*.safetensors", "*.json", "*.yaml", "*.txt"]
    try:
        if tag is None:
            tag = best_tag(ref.name for ref in HfApi().list_repo_refs(repo_id).tags)
        return Path(snapshot_download(repo_id, revision=tag, allow_patterns=patterns))
    except (HfHubHTTPError, HFValidationError, OSError) as error:
        raise CheckpointError(f"{repo_id}@{tag or 'latest'}: cannot be fetched: {error}") from error


def read_weights(folder: Path) -> dict[str, Tensor]:
    """All tensors of model.safetensors or of the shards that its index names. Raises CheckpointError."""
    if (folder / WEIGHTS).is_file():
        return read_tensors(folder / WEIGHTS)
    if (folder / WEIGHTS_INDEX).is_file():
        return _read_shards(folder / WEIGHTS_INDEX)
    pickles = sorted(file for pattern in _PICKLES for file in folder.glob(pattern))
    if pickles:
        command = _CONVERT.format(file=pickles[0], target=folder / WEIGHTS)
        raise CheckpointError(
            f"{folder}: expected {WEIGHTS}, got {pickles[0].name}: pickle files run code when loaded and are refused; "
            f"if you trust it, convert it with: {command}"
        )
    raise CheckpointError(f"{folder}: expected {WEIGHTS} or {WEIGHTS_INDEX}, got {_listing(folder)}")


def _read_shards(index: Path) -> dict[str, Tensor]:
    weight_map = read_json(index).get("weight_map")
    if not isinstance(weight_map, dict):
        raise CheckpointError(f"{index}: expected a weight_map, got none")
    weights: dict[str, Tensor] = {}
    for name in sorted(set(weight_map.values())):
        if Path(name).name != name:
            raise CheckpointError(f"{index}: expected names of files beside it, got {name!r}")
        if not (index.parent / name).is_file():
            raise CheckpointError(f"{index}: names the shard {name}, which is not there")
        weights |= read_tensors(index.parent / name)
    check_keys(weight_map.keys(), weights.keys())
    return weights


def read_tensors(file: Path) -> dict[str, Tensor]:
    """All tensors of one safetensors file. Raises CheckpointError."""
    try:
        return load_file(file)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{file}: expected a safetensors file, got {error}") from error


def read_json(file: Path) -> dict[str, Any]:
    """A JSON object. Raises CheckpointError."""
    try:
        content = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{file}: expected JSON, got {error}") from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{file}: expected a JSON object, got {type(content).__name__}")
    return content


def take_prefix(weights: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Moves the tensors under ``prefix`` out of ``weights``, without the prefix."""
    names = [name for name in weights if name.startswith(prefix)]
    return {name.removeprefix(prefix): weights.pop(name) for name in names}


def check_keys(expected: Iterable[str], got: Iterable[str]) -> None:
    """Raises CheckpointError that lists the missing and the unexpected."""
    missing, unexpected = sorted(set(expected) - set(got)), sorted(set(got) - set(expected))
    if missing or unexpected:
        raise CheckpointError(f"{WEIGHTS}: missing keys: {missing or 'none'}; unexpected keys: {unexpected or 'none'}")


def _listing(folder: Path) -> str:
    return ", ".join(sorted(path.name for path in folder.iterdir())) or "nothing"
