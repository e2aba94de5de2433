# SPDX-License-Identifier: MIT
"""The files of a checkpoint: where it is, its weights, what its names and numbers may be."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rfm.checkpoint.content import (
    CheckpointError,
    cut,
    is_there,
    listed,
    read_json,
    read_run_config,
    read_tensors,
    shown,
    tensor_names,
)
from rfm.checkpoint.pickles import refuse_pickles
from rfm.checkpoint.wrappers import unwrapped

if TYPE_CHECKING:
    from torch import Tensor

WEIGHTS = "model.safetensors"
WEIGHTS_INDEX = "model.safetensors.index.json"
NETWORK_CONFIG = "config.json"
ADAPTER_CONFIG = "adapter_config.json"
RUN_CONFIG = "config.yaml"
RUN_CONFIGS = (RUN_CONFIG, "config.yml", ".hydra/config.yaml")  # the first is read

_COMMIT_DIGITS = 40
MAX_COUNT = 2**20  # of frames: longer than any trajectory
_SHARDS = "model-*.safetensors"
_PICKLE_STEM = "pytorch_model"  # of transformers' pickles of weights
_ENCODERS = ("image_encoder", "text_encoder")  # below an exported checkpoint's
_MAX_SUGGESTED = 5
_LEVELS = ("*", "*/*", "*/*/*")  # below a folder: a training run's checkpoints, those of a model repository
_NAMES = (WEIGHTS, WEIGHTS_INDEX, "adapter_model.safetensors")  # of weights in them


def find_run_config(folder: Path) -> Path | None:
    """The training run's configuration in the checkpoint's folder, its parent, or there on main in the Hub's cache.

    Raises CheckpointError for one from outside the folder that is of another kind of network.
    """
    home = folder.resolve()
    for place in (folder, home.parent, *_places_on_main(home)):
        file = next((place / name for name in RUN_CONFIGS if is_there(place / name)), None)
        if file is not None:
            if place != folder:
                _check_base(file, folder)
            return file
    return None


def not_of(folder: Path, expected: str, got: str, file: Path) -> CheckpointError:
    """The error for a ``file`` outside ``folder`` that is of another run."""
    return CheckpointError(
        f"{file}: expected the run of {folder}, {expected}, got {got}; copy the run's {RUN_CONFIG} into {folder}, "
        "also if it is this one"
    )


def _check_base(file: Path, folder: Path) -> None:
    """Raises CheckpointError if the run's base model and the checkpoint's network are of different kinds."""
    model = read_run_config(file).get("model")
    base = model.get("base_model_id") if isinstance(model, dict) else None
    if is_there(folder / NETWORK_CONFIG):
        kind = read_json(folder / NETWORK_CONFIG).get("model_type")
    else:  # an adapter names its base model; the first ReWiND checkpoints say nothing
        kind = None if is_there(folder / ADAPTER_CONFIG) else "rewind_transformer"
    if isinstance(kind, str) and isinstance(base, str) and base and _plain(kind) not in _plain(base):
        raise not_of(folder, f"whose network is {shown(kind)}", f"model.base_model_id {shown(base)}", file)


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _places_on_main(home: Path) -> list[Path]:
    """``home``, and the folder above a subfolder, in the Hub's cache of main: the snapshot that refs/main names."""
    snapshot = next((path for path in (home, *home.parents) if path.parent.name == "snapshots"), home)
    main = snapshot.parent.parent / "refs" / "main"
    if snapshot.parent.name != "snapshots" or not is_there(main):
        return []
    with main.open("rb") as file:
        commit = file.read(_COMMIT_DIGITS + 1)
    if not re.fullmatch(rb"[0-9a-f]+", commit):
        return []
    place = snapshot.parent / commit.decode() / home.relative_to(snapshot)
    return [place] if home == snapshot else [place, place.parent]


def check_shapes(expected: Mapping[str, Tensor], got: Mapping[str, Tensor]) -> None:
    """Raises CheckpointError unless both have the same names, shapes and kinds of numbers."""
    check_keys(expected.keys(), got.keys())
    for name, tensor in got.items():
        if tensor.shape != expected[name].shape:
            raise CheckpointError(f"{name}: expected {list(expected[name].shape)}, got {list(tensor.shape)}")
        if tensor.is_floating_point() != expected[name].is_floating_point():
            raise CheckpointError(f"{name}: expected numbers like {expected[name].dtype}, got {tensor.dtype}")


def check_finite(weights: Mapping[str, Tensor]) -> None:
    """Raises CheckpointError for a weight that is no number. A score that it makes may still be one: success of 1."""
    for name, tensor in weights.items():
        if not (tensor.is_floating_point() and tensor.numel()):
            continue
        if not all(extreme.isfinite() for extreme in tensor.aminmax()):  # fifty times as fast as isfinite of each
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


def read_weights(folder: Path) -> dict[str, Tensor]:
    """All tensors of model.safetensors or of the shards that its index names, without the prefixes of wrappers.

    Raises CheckpointError.
    """
    check_one_form(folder)
    if is_there(folder / WEIGHTS):
        files = [folder / WEIGHTS]
        weights = read_tensors(folder / WEIGHTS)
    elif is_there(folder / WEIGHTS_INDEX):
        files, weights = _read_shards(folder / WEIGHTS_INDEX)
    else:
        refuse_pickles(folder, WEIGHTS, _PICKLE_STEM)
        raise CheckpointError(
            f"{folder}: expected {WEIGHTS} or {WEIGHTS_INDEX}, got {_listing(folder)}: {_below(folder)}"
        )
    return unwrapped(weights, files, folder / WEIGHTS)


def check_one_form(folder: Path) -> None:
    """Raises CheckpointError for weights that are there whole and in shards: which are the newer, no file says."""
    shards = [path.name for path in (folder / WEIGHTS_INDEX, *sorted(folder.glob(_SHARDS))) if is_there(path)]
    if shards and is_there(folder / WEIGHTS):
        raise CheckpointError(
            f"{folder}: expected {WEIGHTS} or shards, got {WEIGHTS} and {listed(shards)}, of which one is older; "
            "move away what is not meant: transformers, which reads the former, leaves it when it writes shards"
        )


def _read_shards(index: Path) -> tuple[list[Path], dict[str, Tensor]]:
    """The shards that the index names, and their tensors."""
    weight_map = read_json(index).get("weight_map")
    if not isinstance(weight_map, dict):
        raise CheckpointError(f"{index}: expected a weight_map, got none")
    weights: dict[str, Tensor] = {}
    shard_of: dict[str, str] = {}
    for shard in dict.fromkeys(map(str, weight_map.values())):
        if Path(shard).name != shard or not shard.endswith(".safetensors"):
            raise CheckpointError(f"{index}: expected names of files beside it, got {shown(shard)}")
        if not is_there(index.parent / shard):
            raise CheckpointError(f"{index}: names the shard {shard}, which is not there")
        for name, tensor in read_tensors(index.parent / shard).items():
            if name in shard_of:
                got = f"{shown(name)} in {shard_of[name]} and in {shard}"
                raise CheckpointError(f"{index}: expected each tensor in one shard, got {got}; save the weights again")
            weights[name], shard_of[name] = tensor, shard
    check_keys(weight_map.keys(), weights.keys())
    for file in sorted(index.parent.glob(_SHARDS)):
        unknown = set(tensor_names(file)) - shard_of.keys()
        if unknown:
            got = f"{file.name}, which it does not name, with {listed(sorted(unknown))}"
            raise CheckpointError(f"{index}: expected the names of all shards, got {got}; move that file away")
    return [index.parent / shard for shard in dict.fromkeys(shard_of.values())], weights


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


def has_head(weights: Iterable[str], head: str) -> bool:
    """Whether there are weights of the head of ``head``; one of which some are missing is refused later."""
    return any(name.startswith(f"{head}_head.") for name in weights)


def _below(folder: Path) -> str:
    """Where there are weights below a folder that has none, or what a folder with weights looks like."""
    found = [file.parent for level in _LEVELS for name in _NAMES for file in sorted(folder.glob(f"{level}/{name}"))]
    checkpoints = [str(path) for path in dict.fromkeys(found) if path.name not in _ENCODERS]
    if not checkpoints:
        return "a checkpoint's folder has it, beside config.json"
    return f"name the checkpoint in it: {cut(', '.join(checkpoints[:_MAX_SUGGESTED]))}"


def _listing(folder: Path) -> str:
    return cut(", ".join(sorted(path.name for path in folder.iterdir()))) or "nothing"
