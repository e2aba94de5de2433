# SPDX-License-Identifier: MIT
"""Read a checkpoint's weights: from safetensors files, never pickles, without the name prefixes from training code."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING

from rfm.files import (
    ADAPTER_WEIGHTS,
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
    tensor_names,
)
from rfm.weights import check_names

if TYPE_CHECKING:
    from torch import Tensor


PICKLE_STEM = "pytorch_model"  # transformers' name for pickled weights
_ENCODERS = ("image_encoder", "text_encoder")  # subfolders in an exported checkpoint
_LEVELS = ("*", "*/*", "*/*/*")  # how deep checkpoints lie in a training run's folder or in a model repository
_MAX_SUGGESTED = 5
_PICKLES = ("*.bin", "*.pt", "*.pth", "*.ckpt", "*.pkl")
# Files besides weights from which training resumes.
_STATES = ("optimizer*", "*optim_states*", "scheduler*", "rng_state*", "random_states*", "scaler*", "training_args*")
_CONVERT = (
    "import argparse, functools, sys, torch, safetensors.torch as s; "
    "torch.serialization.add_safe_globals([argparse.Namespace]); "
    "load = lambda file: functools.reduce("
    "lambda d, key: d[key] if isinstance(d.get(key), dict) else d, "
    "('state_dict', 'model_state_dict', 'model', 'module'), "
    "torch.load(file, map_location='cpu', weights_only=True)); "
    "s.save_file({name: t.clone(memory_format=torch.contiguous_format) "
    "for file in sys.argv[2:] for name, t in load(file).items() if torch.is_tensor(t)}, "
    "sys.argv[1], {'format': 'pt'})"
)
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
        refuse_pickles(folder, WEIGHTS, PICKLE_STEM)
        got = cut(", ".join(sorted(path.name for path in folder.iterdir()))) or "nothing"
        raise CheckpointError.at(folder, f"{WEIGHTS} or {WEIGHTS_INDEX}", f"{got}: {_below(folder)}")
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
    weight_map = read_json(index).get("weight_map")
    if not isinstance(weight_map, dict):
        raise CheckpointError.at(index, "a weight_map", "none")
    weights: dict[str, Tensor] = {}
    shard_of: dict[str, str] = {}
    for shard in dict.fromkeys(map(str, weight_map.values())):
        if Path(shard).name != shard or not shard.endswith(".safetensors"):
            raise CheckpointError.at(index, "names of files beside it", shown(shard))
        if not is_there(index.parent / shard):
            raise CheckpointError(f"{index}: names the shard {shard}, which is not there")
        for name, tensor in read_tensors(index.parent / shard).items():
            if name in shard_of:
                got = f"{shown(name)} in {shard_of[name]} and in {shard}"
                raise CheckpointError.at(index, "each tensor in one shard", got, "save the weights again")
            weights[name], shard_of[name] = tensor, shard
    check_names(weight_map.keys(), weights.keys())
    for file in sorted(index.parent.glob(SHARDS)):
        unknown = set(tensor_names(file)) - shard_of.keys()
        if unknown:
            got = f"{file.name}, which it does not name, with {listed(sorted(unknown))}"
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


def _below(folder: Path) -> str:
    """Name the checkpoints below a folder that has no weights, or describe a checkpoint's folder."""
    names = (WEIGHTS, WEIGHTS_INDEX, ADAPTER_WEIGHTS)
    found = [file.parent for level in _LEVELS for name in names for file in sorted(folder.glob(f"{level}/{name}"))]
    checkpoints = [str(path) for path in dict.fromkeys(found) if path.name not in _ENCODERS]
    if not checkpoints:
        return "a checkpoint's folder has it, beside config.json"
    return f"name the checkpoint in it: {cut(', '.join(checkpoints[:_MAX_SUGGESTED]))}"


def take_prefix(weights: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Remove the tensors under ``prefix`` from ``weights``; return them without the prefix."""
    names = [name for name in weights if name.startswith(prefix)]
    return {name.removeprefix(prefix): weights.pop(name) for name in names}


def has_head(weights: Iterable[str], head: str) -> bool:
    """True if the weights contain any from this head; ``check_shapes`` finds an incomplete head."""
    return any(name.startswith(f"{head}_head.") for name in weights)


def pickled_weights(names: Iterable[str], stem: str) -> list[str]:
    """Return the pickles among a folder's file names that may hold weights.

    stem: how transformers' names begin; if files with such names exist, only these are returned
    """
    pickles = sorted(name for name in names if _is_any(name, _PICKLES) and not _is_any(name, _STATES))
    return [name for name in pickles if _is_any(name, (f"{stem}.bin", f"{stem}-*-of-*.bin"))] or pickles


def refuse_pickles(folder: Path, wanted: str, stem: str) -> None:
    """Raise CheckpointError if ``folder`` has pickled weights instead of the missing file ``wanted``.

    Pickles are never opened, since that may run code. The message holds a command that converts them.
    stem: as in ``pickled_weights``
    """
    names = pickled_weights((file.name for file in folder.iterdir()), stem)
    if not names:
        return
    if len(names) > 1 and f"{stem}.bin" in names:
        both = f"{stem}.bin and {names[0]}"
        raise CheckpointError.at(folder, "one form of the weights", both, "name a copy without what is not meant")
    files = names if names[0].endswith(".bin") and "-of-" in names[0] else names[:1]  # all shards, or the first other
    arguments = shlex.join(map(str, [folder / wanted, *(folder / name for name in files)]))
    command = f'python -c "{_CONVERT}" {arguments}'
    got = (
        f"{cut(', '.join(names))}: pickles may run code when they are loaded, so they are refused. If you trust who "
        "made it, convert it. weights_only=True lets PyTorch make tensors and little else; do not convert a file that "
        f"needs more: {command}"
    )
    raise CheckpointError.at(folder, wanted, got)


def _is_any(name: str, patterns: Iterable[str]) -> bool:
    return any(fnmatch(name, pattern) for pattern in patterns)
