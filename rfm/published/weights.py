# SPDX-License-Identifier: MIT
"""Read a checkpoint's weights: from safetensors files, never pickles, without the name prefixes from training code."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from rfm.files import (
    NETWORK_CONFIG,
    SHARDS,
    WEIGHTS,
    WEIGHTS_INDEX,
    CheckpointError,
    check_one_form,
    cut,
    is_there,
    listed,
    network_config,
    read_json,
    read_tensors,
    shown,
)
from rfm.weights import check_names

if TYPE_CHECKING:
    from torch import Tensor


_PICKLES = (".bin", ".pt", ".pth", ".ckpt", ".pkl")
_STATES = ("optimizer", "scheduler", "rng_state", "random_states", "scaler", "training_args")  # to resume training
# Prefixes that training code puts before weight names. Those in _INSIDE also stand before layer names.
_INSIDE = r"_orig_mod|_fsdp_wrapped_module|_checkpoint_wrapped_module|_forward_module"
_WRAPPERS = re.compile(rf"^(?:(?:module|base_model\.model|{_INSIDE})\.)+|(?<=\.)(?:(?:{_INSIDE})\.)+")
_HEAD = "progress_head.4.weight"  # in every reward network
# config.json's model_type, by the name of a weight that only this network has.
_NETWORKS = {
    "rewind_transformer": re.compile(r"(^|\.)video_proj\.weight$"),
    "qwen2_5_vl": re.compile(r"(^|\.)visual\.blocks\.\d+\.mlp\.gate_proj\."),
    "qwen3_vl": re.compile(r"(^|\.)visual\.blocks\.\d+\.mlp\.linear_fc1\."),
}
_PART = re.compile(r"_(text|vision)$")  # ends a part's model_type


def read_weights(folder: Path, model_type: str | None = None) -> dict[str, Tensor]:
    """Return all tensors from model.safetensors, or its shards, without wrapper prefixes.

    model_type: in config.json, for a network that contains a known network; None: the network itself is known
    Raises CheckpointError.
    """
    check_one_form(folder)
    if is_there(folder / WEIGHTS):
        weights = read_tensors(folder / WEIGHTS)
    elif is_there(folder / WEIGHTS_INDEX):
        weights = _read_shards(folder / WEIGHTS_INDEX)
    else:
        refuse_pickles(folder, WEIGHTS, [path.name for path in folder.iterdir()])
        got = cut(", ".join(sorted(path.name for path in folder.iterdir()))) or "nothing"
        remedy = "name the folder that has it, beside config.json"
        raise CheckpointError.at(folder, f"{WEIGHTS} or {WEIGHTS_INDEX}", got, remedy)
    _check_network(folder, weights, model_type)
    return _unwrapped(weights, folder)


def _check_network(folder: Path, names: Iterable[str], model_type: str | None) -> None:
    """Raise CheckpointError if config.json describes another network than the weights, as some trainers write it."""
    file, content = folder / NETWORK_CONFIG, network_config(folder)
    stated = content.get("model_type")
    found = next((kind for name in names for kind, own in _NETWORKS.items() if own.search(name)), None)
    is_first = stated is None and found == next(iter(_NETWORKS))  # the first ReWiND checkpoints state nothing
    is_expected = stated is not None and stated in (found, model_type)
    if found is None or "type" in content or is_first or is_expected:  # ``type``: LeRobot's
        return
    if isinstance(stated, str) and _PART.sub("", stated) not in _NETWORKS:  # another network with some of the names
        got = f"{shown(stated)}, which is not supported"
        raise CheckpointError.at(f"{file}: model_type", f"one of {', '.join(_NETWORKS)}", got)
    got = "none" if stated is None else shown(stated)
    expected = f"{found}, by the names of the weights"
    remedy = f"copy {NETWORK_CONFIG} of the model that the run started from"
    raise CheckpointError.at(f"{file}: model_type", expected, f"{got}: the file describes another network", remedy)


def _read_shards(index: Path) -> dict[str, Tensor]:
    """Return each tensor from the shard that the index names for it. Raises CheckpointError."""
    weight_map = read_json(index).get("weight_map")
    if not isinstance(weight_map, dict):
        raise CheckpointError.at(index, "a weight_map", "none")
    weights: dict[str, Tensor] = {}
    for shard in dict.fromkeys(map(str, weight_map.values())):
        if Path(shard).name != shard or not shard.endswith(".safetensors"):
            raise CheckpointError.at(index, "names of files beside it", shown(shard))
        if not is_there(index.parent / shard):
            raise CheckpointError(f"{index}: names the shard {shard}, which is not there")
        tensors = read_tensors(index.parent / shard)
        if unknown := sorted(tensors.keys() - {name for name, place in weight_map.items() if place == shard}):
            raise CheckpointError.at(
                index, f"the tensors in {shard}", f"no {listed(unknown)}", "save the weights again"
            )
        weights |= tensors
    check_names(weight_map.keys(), weights.keys())
    for file in sorted(index.parent.glob(SHARDS)):
        if file.name not in weight_map.values() and (unknown := sorted(read_tensors(file).keys() - weights.keys())):
            got = f"{file.name}, which it does not name, with {listed(unknown)}"
            raise CheckpointError.at(index, "the names of all shards", got, "name a copy of the folder without it")
    return weights


def _unwrapped(weights: Mapping[str, Tensor], folder: Path) -> dict[str, Tensor]:
    """Remove the prefixes from DataParallel, torch.compile, PEFT and FSDP, and any prefix that all names share.

    folder: checkpoint folder, for messages
    Raises CheckpointError if only some names have the prefix, or two names would be equal.
    """
    bare: dict[str, Tensor] = {}
    for name, tensor in weights.items():
        if (short := _WRAPPERS.sub("", name)) in bare:
            raise CheckpointError.at(folder, "each weight once", f"{shown(short)} and {shown(name)}")
        bare[short] = tensor
    head = next((name for name in bare if name == _HEAD or name.endswith(f".{_HEAD}")), _HEAD)
    prefix = head.removesuffix(_HEAD)
    other = next((name for name in bare if not name.startswith(prefix)), None)
    if other is not None:
        got = f"{shown(head)}, with the prefix {prefix} that {shown(other)} lacks"
        remedy = "save the weights again where they were trained, with the prefix before all names or none"
        raise CheckpointError.at(folder, _HEAD, got, remedy)
    return {name.removeprefix(prefix): tensor for name, tensor in bare.items()}


def take_prefix(weights: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Remove the tensors under ``prefix`` from ``weights``; return them without the prefix."""
    names = [name for name in weights if name.startswith(prefix)]
    return {name.removeprefix(prefix): weights.pop(name) for name in names}


def has_head(weights: Iterable[str], head: str) -> bool:
    """True if the weights contain any from this head; ``check_shapes`` finds an incomplete head."""
    return any(name.startswith(f"{head}_head.") for name in weights)


def refuse_pickles(where: object, wanted: str, names: Iterable[str]) -> None:
    """Raise CheckpointError if pickled weights are among ``names``, the files beside the missing file ``wanted``.

    Pickles are never opened, since that may run code.
    """
    pickles = sorted(name for name in names if name.endswith(_PICKLES) and not name.startswith(_STATES))
    if pickles:
        got = f"{cut(', '.join(pickles))}: pickles may run code when they are loaded, so they are refused"
        remedy = "save the weights where they were trained with safetensors.torch.save_file or save_pretrained"
        raise CheckpointError.at(where, wanted, got, remedy)
