# SPDX-License-Identifier: MIT
"""ReWiND checkpoints: one flat file of weights, the encoders' under a prefix.

Where configuration and weights disagree, the weights decide.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from safetensors.torch import save_file
from torch import Tensor

from rfm.checkpoint.files import (
    NETWORK_CONFIG,
    RUN_CONFIG,
    WEIGHTS,
    CheckpointError,
    check_shapes,
    find_run_config,
    frame_count,
    read_json,
    read_run_config,
    read_weights,
    take_prefix,
    trained_frames,
)
from rfm.models.rewind import RewindConfig, RewindTransformer

MODEL_TYPE = "rewind_transformer"
IMAGE_ENCODER_PREFIX = "image_encoder."
TEXT_ENCODER_PREFIX = "text_encoder."

# What the weights' shapes cannot tell, and what it is where a checkpoint does not say (older ones).
_STATED_DEFAULTS: dict[str, Any] = {"causal_mask": False, "max_len": 16}
_STATED_TYPES: dict[str, type] = {"num_attention_heads": int, "max_len": int, "causal_mask": bool}


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
        check_shapes(network.state_dict(), self.network)
        network.load_state_dict(self.network, strict=True)
        return network.eval().requires_grad_(False)


def load_rewind(folder: Path) -> RewindCheckpoint:
    """The checkpoint in a local folder. Raises CheckpointError."""
    weights = read_weights(folder)
    image_encoder = take_prefix(weights, IMAGE_ENCODER_PREFIX)
    text_encoder = take_prefix(weights, TEXT_ENCODER_PREFIX)
    config = _rewind_config(folder, weights)
    return RewindCheckpoint(config, weights, image_encoder, text_encoder)


def save_rewind(checkpoint: RewindCheckpoint, folder: Path) -> None:
    """Writes network and configuration in the layout that ``load_rewind`` reads, without encoders."""
    folder.mkdir(parents=True)
    config = {"model_type": MODEL_TYPE, **asdict(checkpoint.config)}
    (folder / NETWORK_CONFIG).write_text(json.dumps(config, indent=2) + "\n")
    tensors = {name: tensor.contiguous() for name, tensor in checkpoint.network.items()}
    save_file(tensors, folder / WEIGHTS, metadata={"format": "pt"})


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
            trained_frames=_trained_frames(folder),
        )
    except KeyError as error:
        raise CheckpointError(f"{folder}: expected a ReWiND checkpoint, which has {error}") from error
    if config.num_attention_heads < 1 or config.hidden_dim % config.num_attention_heads:
        heads = f"a divisor of the hidden width {config.hidden_dim}"
        raise CheckpointError(f"{folder}: num_attention_heads: expected {heads}, got {config.num_attention_heads}")
    return config


def _trained_frames(folder: Path) -> int | None:
    """As ``save_rewind`` wrote it to config.json, else as config.yaml tells it."""
    if (folder / NETWORK_CONFIG).is_file():
        saved = read_json(folder / NETWORK_CONFIG).get("trained_frames")
        if saved is not None:
            return frame_count(saved, f"{folder / NETWORK_CONFIG}: trained_frames")
    run_config = find_run_config(folder)
    return None if run_config is None else trained_frames(read_run_config(run_config), run_config)


def _stated(folder: Path) -> dict[str, Any]:
    """What config.json and config.yaml say of the network. Both may lack a field; neither may contradict the other."""
    sources = {}
    if (folder / NETWORK_CONFIG).is_file():
        sources[NETWORK_CONFIG] = read_json(folder / NETWORK_CONFIG)
    run_config = find_run_config(folder)
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
