# SPDX-License-Identifier: MIT
"""Upstream's checkpoint layouts -> configuration and weights.

A checkpoint is a local folder or a Hugging Face id ``org/name[@tag]``. In it: ``model.safetensors`` (or shards
with an index), ``config.json`` (the network, flat) and, in the folder or its parent, ``config.yaml`` (the
training run). Nothing in a checkpoint is executed: safetensors only, and YAML tags construct nothing.
Where configuration and weights disagree, the weights decide.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from rfm.models.rewind import RewindConfig, RewindTransformer

WEIGHTS = "model.safetensors"
WEIGHTS_INDEX = "model.safetensors.index.json"
NETWORK_CONFIG = "config.json"
RUN_CONFIG = "config.yaml"
MODEL_TYPE = "rewind_transformer"
IMAGE_ENCODER_PREFIX = "image_encoder."
TEXT_ENCODER_PREFIX = "text_encoder."

_BEST_TAG = re.compile(r"best-.*?-(-?\d+\.\d+)-step-\d+")
_PICKLES = ("*.bin", "*.pt", "*.pth", "*.ckpt", "*.pkl")
_CONVERT = (
    "python -c \"import torch, safetensors.torch as s; weights = torch.load('{file}', map_location='cpu', "
    "weights_only=True); s.save_file({{k: v.contiguous() for k, v in weights.items()}}, '{target}')\""
)
# What the weights' shapes cannot tell, and what it is where a checkpoint does not say (older ones).
_STATED_DEFAULTS: dict[str, Any] = {"causal_mask": False, "max_len": 16}
_STATED_TYPES: dict[str, type] = {"num_attention_heads": int, "max_len": int, "causal_mask": bool}


class CheckpointError(Exception):
    """A checkpoint that cannot be loaded: what is wrong with which file, and what to do about it."""


@dataclass(frozen=True)
class RewindCheckpoint:
    """A ReWiND checkpoint in memory.

    network: weights of RewindTransformer
    image_encoder, text_encoder: encoder weights without their prefix; empty if the checkpoint has none
    """

    config: RewindConfig
    network: dict[str, Tensor]
    image_encoder: dict[str, Tensor] = field(default_factory=dict)
    text_encoder: dict[str, Tensor] = field(default_factory=dict)

    def build(self) -> RewindTransformer:
        """The network with these weights, on the CPU, ready to score. Raises CheckpointError."""
        network = RewindTransformer(self.config)
        expected = network.state_dict()
        _check_keys(expected.keys(), self.network.keys())
        for name, tensor in self.network.items():
            if tensor.shape != expected[name].shape:
                shapes = f"expected {list(expected[name].shape)}, got {list(tensor.shape)}"
                raise CheckpointError(f"{name}: {shapes}")
        network.load_state_dict(self.network, strict=True)
        return network.eval().requires_grad_(False)


def load(source: str | Path) -> RewindCheckpoint:
    """The checkpoint at a local folder or Hugging Face id. Raises CheckpointError."""
    folder = find(source)
    weights = _read_weights(folder)
    image_encoder = _take_prefix(weights, IMAGE_ENCODER_PREFIX)
    text_encoder = _take_prefix(weights, TEXT_ENCODER_PREFIX)
    config = _rewind_config(folder, weights)
    return RewindCheckpoint(config, weights, image_encoder, text_encoder)


def save(checkpoint: RewindCheckpoint, folder: Path) -> None:
    """Writes network and configuration in the layout that ``load`` reads, without encoders."""
    folder.mkdir(parents=True)
    config = {"model_type": MODEL_TYPE, **asdict(checkpoint.config)}
    (folder / NETWORK_CONFIG).write_text(json.dumps(config, indent=2) + "\n")
    tensors = {name: tensor.contiguous() for name, tensor in checkpoint.network.items()}
    save_file(tensors, folder / WEIGHTS, metadata={"format": "pt"})


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


def read_run_config(file: Path) -> dict[str, Any]:
    """config.yaml as plain mappings, lists and scalars, whatever Python objects its tags ask for."""
    try:
        config = yaml.load(file.read_text(), Loader=_PlainLoader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{file}: expected YAML, got {error}") from error
    if not isinstance(config, dict):
        raise CheckpointError(f"{file}: expected a mapping, got {type(config).__name__}")
    return config


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


def _read_weights(folder: Path) -> dict[str, Tensor]:
    if (folder / WEIGHTS).is_file():
        return _read_file(folder / WEIGHTS)
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
    weight_map = _read_json(index).get("weight_map")
    if not isinstance(weight_map, dict):
        raise CheckpointError(f"{index}: expected a weight_map, got none")
    weights: dict[str, Tensor] = {}
    for name in sorted(set(weight_map.values())):
        if Path(name).name != name:
            raise CheckpointError(f"{index}: expected names of files beside it, got {name!r}")
        if not (index.parent / name).is_file():
            raise CheckpointError(f"{index}: names the shard {name}, which is not there")
        weights |= _read_file(index.parent / name)
    _check_keys(weight_map.keys(), weights.keys())
    return weights


def _read_file(file: Path) -> dict[str, Tensor]:
    try:
        return load_file(file)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{file}: expected a safetensors file, got {error}") from error


def _read_json(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{file}: expected JSON, got {error}") from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{file}: expected a JSON object, got {type(content).__name__}")
    return content


def _take_prefix(weights: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Moves the tensors under ``prefix`` out of ``weights``, without the prefix."""
    names = [name for name in weights if name.startswith(prefix)]
    return {name.removeprefix(prefix): weights.pop(name) for name in names}


def _rewind_config(folder: Path, weights: Mapping[str, Tensor]) -> RewindConfig:
    stated = _stated(folder)
    progress_tokens = weights.get("prog_token_A")
    try:
        hidden_dim, video_feature_dim = weights["video_proj.weight"].shape
        config = RewindConfig(
            video_feature_dim=video_feature_dim,
            text_feature_dim=weights["text_proj.weight"].shape[1],
            hidden_dim=hidden_dim,
            num_layers=len({name.split(".")[2] for name in weights if name.startswith("transformer.layers.")}),
            num_attention_heads=stated["num_attention_heads"],
            max_len=stated["max_len"] if progress_tokens is None else progress_tokens.shape[1],
            causal_mask=stated["causal_mask"],
            use_per_frame_progress_token=progress_tokens is not None,
            progress_bins=weights["progress_head.4.weight"].shape[0],
            has_similarity="similarity_head.0.weight" in weights,
        )
    except KeyError as error:
        raise CheckpointError(f"{folder}: expected a ReWiND checkpoint, which has {error}") from error
    if config.num_attention_heads < 1 or config.hidden_dim % config.num_attention_heads:
        heads = f"a divisor of the hidden width {config.hidden_dim}"
        raise CheckpointError(f"{folder}: num_attention_heads: expected {heads}, got {config.num_attention_heads}")
    return config


def _stated(folder: Path) -> dict[str, Any]:
    """What config.json and config.yaml say of the network. Both may lack a field; neither may contradict the other."""
    sources = {}
    if (folder / NETWORK_CONFIG).is_file():
        sources[NETWORK_CONFIG] = _read_json(folder / NETWORK_CONFIG)
    run_config = next((f for f in (folder / RUN_CONFIG, folder.resolve().parent / RUN_CONFIG) if f.is_file()), None)
    if run_config is not None:
        model = read_run_config(run_config).get("model") or {}
        network = model.get("rewind") or {} if isinstance(model, dict) else model
        if not isinstance(network, dict):
            raise CheckpointError(f"{run_config}: model.rewind: expected a mapping, got {network!r}")
        sources[RUN_CONFIG] = network
    model_type = sources.get(NETWORK_CONFIG, {}).get("model_type", MODEL_TYPE)
    if model_type != MODEL_TYPE:
        raise CheckpointError(f"{folder / NETWORK_CONFIG}: model_type: expected {MODEL_TYPE}, got {model_type}")
    stated = dict(_STATED_DEFAULTS)
    for name, kind in _STATED_TYPES.items():
        values = {source: content[name] for source, content in sources.items() if name in content}
        for source, value in values.items():
            if type(value) is not kind:
                raise CheckpointError(f"{folder}: {name} in {source}: expected {kind.__name__}, got {value!r}")
        if name != "max_len" and len(set(values.values())) > 1:  # weights tell max_len where it matters
            raise CheckpointError(f"{folder}: {name}: expected {' and '.join(values)} to agree, got {values}")
        if values:
            stated[name] = next(iter(values.values()))
    return stated


def _check_keys(expected: Iterable[str], got: Iterable[str]) -> None:
    missing, unexpected = sorted(set(expected) - set(got)), sorted(set(got) - set(expected))
    if missing or unexpected:
        raise CheckpointError(f"{WEIGHTS}: missing keys: {missing or 'none'}; unexpected keys: {unexpected or 'none'}")


def _listing(folder: Path) -> str:
    return ", ".join(sorted(path.name for path in folder.iterdir())) or "nothing"
