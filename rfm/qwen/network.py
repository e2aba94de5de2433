# SPDX-License-Identifier: MIT
"""A Qwen backbone from ``transformers``: its configuration, and its pass over a batch.

The vision tower and the language model become CUDA graphs: both depend only on tensors and on the plan's constants, and
never wait for the host. Trunks and leaves: each layer computes the trunks, keeps their keys and values, and then
computes every pack call, whose tokens see them. So memory holds the keys and values of only one layer. B trunks, L
tokens, width D.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final, Literal, TypeAlias

import torch
from torch import Tensor, nn

from rfm.config import VideoPrompt, Weights
from rfm.engine.graphs import Graphs
from rfm.engine.layers import changed, concatenated
from rfm.files import CheckpointError
from rfm.qwen.backbone import (
    UNIT,
    KeyValues,
    Part,
    VisionPlan,
    features,
    run_layers,
)
from rfm.qwen.batch import VlmBatch
from rfm.qwen.leaves import Packs
from rfm_client.contract.checks import require

QWEN_2_5 = "qwen2_5_vl"
BACKBONES = {QWEN_2_5: "Qwen2_5_VLModel", "qwen3_vl": "Qwen3VLModel"}
QWEN3 = "qwen3_vl"
BARE: Final = "bare"
WRAPPED: Final = "wrapped"
FULL_ATTENTION = "full_attention"
MAX_LAYERS = 1024  # building more would take hours, and no model has more
Dtype: TypeAlias = Literal["float32", "bfloat16", "float16"]


@dataclass(frozen=True)
class BackboneConfig:
    """The configuration of a backbone, and the dtype of its parameters and heads.

    backbone: transformers' configuration (config.json)
    dtype: number type of the network on a GPU
    video_prompt: form of a Qwen3-VL's prompt with a video (``rfm.published.qwen``)
    weights: number format for rounded layers (``rfm.qwen.rounded``); None: not rounded
    """

    backbone: dict[str, Any]
    dtype: Dtype
    video_prompt: VideoPrompt = field(default="bare", kw_only=True)
    weights: Weights | None = field(default=None, kw_only=True)

    @property
    def family(self) -> str:
        """The backbone's model_type, a key in BACKBONES."""
        return str(self.backbone["model_type"])

    @property
    def hidden_dim(self) -> int:
        """D, the width of the language model."""
        return int(self.backbone["text_config"]["hidden_size"])

    @property
    def torch_dtype(self) -> torch.dtype:
        """The torch type that ``dtype`` names."""
        return {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}[self.dtype]


def qwen_states(
    backbone: Any, batch: VlmBatch, key_values: KeyValues | None = None, graphs: Graphs | None = None
) -> tuple[Tensor, Tensor | None]:
    """Return a Qwen backbone's last hidden states, and the features that its vision tower computed.

    The states have the shape [all tokens, D]: the conversations' B * L, then those in the packs.

    key_values: receives the keys and values of all tokens, for ``next_hidden_state``
    graphs: for small batches; the language model uses none if ``key_values`` is given
    """
    made = None
    if batch.plan is not None:
        of_tower = backbone.visual, batch.inputs["pixel_values"], batch.plan
        made = features(*of_tower) if graphs is None else graphed_features(graphs, *of_tower)
    shots = [*([] if made is None else [made]), *batch.layout.kept.values()]
    merged = concatenated(shots)
    if batch.packs:
        return tree_hidden_states(backbone.language_model, batch.inputs, batch.packs, merged), made
    if graphs is not None and key_values is None:
        return graphed_hidden_state(graphs, backbone.language_model, batch.inputs, merged), made
    trunks = Part(backbone.language_model, batch.inputs, merged, key_values)
    return run_layers(backbone.language_model, trunks), made


def build_backbone(config: BackboneConfig, dtype: torch.dtype) -> nn.Module:
    """Return the backbone with uninitialised weights in ``dtype``; buffers keep their own dtype.

    Raises CheckpointError for more than MAX_LAYERS layers, and for a language model with any layer but full attention.
    """
    try:
        import transformers
    except ImportError as error:
        raise ImportError('vision-language checkpoints need transformers: pip install ".[vlm]"') from error
    network = getattr(transformers, BACKBONES[config.family])
    for part, name in (("text_config", "num_hidden_layers"), ("vision_config", "depth")):
        count = config.backbone[part].get(name, 0)
        require(f"{part}.{name}", count <= MAX_LAYERS, f"at most {MAX_LAYERS}", count, CheckpointError)
    settings = network.config_class.from_dict(config.backbone)
    with _no_init_weights():
        backbone: nn.Module = network._from_config(settings, dtype=dtype, attn_implementation="sdpa")
    kinds = set(getattr(settings.get_text_config(), "layer_types", None) or [FULL_ATTENTION])
    if kinds != {FULL_ATTENTION}:  # other layers do not attend to all earlier tokens
        raise CheckpointError.at("text_config.layer_types", f"{FULL_ATTENTION} alone", sorted(kinds))
    return backbone


def _no_init_weights() -> AbstractContextManager[None]:
    """Return transformers' switch, which moved between its major versions."""
    try:
        from transformers.initialization import no_init_weights
    except ImportError:
        from transformers.modeling_utils import no_init_weights
    return no_init_weights()


LANGUAGE_INPUTS = ("input_ids", "position_ids", "visual_tokens", "visual_features")


def graphed_features(graphs: Graphs, visual: Any, patches: Tensor, plan: VisionPlan) -> Tensor:
    """Return ``rfm.qwen.backbone.features``, computed by a CUDA graph if the shapes recur."""
    of_plan = [value for value in vars(plan).values() if isinstance(value, Tensor)]

    def vision(patches: Tensor, *parts: Tensor) -> Tensor:
        left = iter(parts)
        return features(visual, patches, changed(plan, lambda _: next(left)))

    return graphs(vision, [patches, *of_plan], ("vision", plan.shots, plan.windows), len(patches) // UNIT)


def graphed_hidden_state(graphs: Graphs, language: Any, inputs: dict[str, Tensor], features: Tensor) -> Tensor:
    """Return the hidden states behind the final norm, computed by a CUDA graph if the shapes recur."""

    def hidden_state(features: Tensor, *of_batch: Tensor) -> Tensor:
        inputs = dict(zip(LANGUAGE_INPUTS, of_batch, strict=True))
        return run_layers(language, Part(language, inputs, features))

    tensors = [features, *(inputs[name] for name in LANGUAGE_INPUTS)]
    return graphs(hidden_state, tensors, "language", inputs["input_ids"].numel())


class TrunkKeyValues:
    """A ``Cache`` of one layer's trunks."""

    of_trunks: tuple[Tensor, ...] = ()

    def update(self, keys: Tensor, values: Tensor, layer: int) -> tuple[Tensor, Tensor]:
        """Keep the trunks' keys and values, [B, heads, L, D / heads], and return them."""
        self.of_trunks = keys, values
        return keys, values


@dataclass(frozen=True)
class PackKeyValues:
    """A ``Cache`` for the tokens in a call, which see trunks and packs."""

    trunks: TrunkKeyValues
    packs: Packs

    def update(self, keys: Tensor, values: Tensor, layer: int) -> tuple[Tensor, Tensor]:
        """Return the packs' keys and values behind those of their trunks."""
        before = [each[self.packs.trunks, :, : self.packs.num_keys] for each in self.trunks.of_trunks]
        return torch.cat([before[0], keys], dim=2), torch.cat([before[1], values], dim=2)


def tree_hidden_states(language: Any, inputs: dict[str, Tensor], packs: Sequence[Packs], features: Tensor) -> Tensor:
    """Return the hidden states behind the final norm, trunks first, then call by call, [all tokens, D].

    language, inputs, features: the trunks' arguments for ``rfm.qwen.backbone.Part``
    """
    trunks, is_kept = TrunkKeyValues(), len(packs) == 1
    # Keep the mask for a single call. Rebuild several masks in each layer, so that memory holds one.
    calls = [
        Part(language, each.inputs, features, PackKeyValues(trunks, each), cache(each.mask) if is_kept else each.mask)
        for each in packs
    ]
    return run_layers(language, Part(language, inputs, features, trunks), *calls)
