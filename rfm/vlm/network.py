# SPDX-License-Identifier: MIT
"""Reward heads on a vision-language backbone of ``transformers``: RFM and Robometer checkpoints.

F frames (in video mode: temporal patches) and Q queries of all rows, L tokens, D width, K progress bins.
The heads read the last hidden states, behind the final norm: of a frame, pooled over a span of tokens, and of a query,
at its token.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import torch
from torch import Tensor, nn

from rfm.engine.graphs import Graphs
from rfm.engine.layers import PredictionHead, concatenated
from rfm.family import VideoPrompt, Weights
from rfm.vlm.backbone import BACKBONES
from rfm.vlm.batch import VlmBatch
from rfm.vlm.graphed import graphed_features, graphed_hidden_state
from rfm.vlm.qwen import KeyValues, check_attention, features, last_hidden_state
from rfm.vlm.tree_states import tree_hidden_states

Dtype: TypeAlias = Literal["float32", "bfloat16", "float16"]
Pooling: TypeAlias = Literal["mean", "boundary", "attention"]


@dataclass(frozen=True)
class BackboneConfig:
    """The configuration of a backbone, and the dtype of its parameters and heads.

    backbone: transformers' configuration (config.json)
    dtype: number type of the network on a GPU
    video_prompt: form of a Qwen3-VL's prompt with a video (``rfm.vlm.video_prompt``)
    weights: form of rounded layers (``rfm.vlm.rounded``); None: not rounded
    """

    backbone: dict[str, Any]
    dtype: Dtype
    video_prompt: VideoPrompt = field(default="bare", kw_only=True)
    weights: Weights | None = field(default=None, kw_only=True)

    @property
    def family(self) -> str:
        """The backbone's model_type, a key of BACKBONES."""
        return str(self.backbone["model_type"])

    @property
    def hidden_dim(self) -> int:
        """D, the width of the language model."""
        return int(self.backbone["text_config"]["hidden_size"])

    @property
    def torch_dtype(self) -> torch.dtype:
        """The torch type that ``dtype`` names."""
        return {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}[self.dtype]


@dataclass(frozen=True)
class VlmConfig(BackboneConfig):
    """The configuration of a checkpoint's network and prompts.

    multi_image: each frame is an image; else a trajectory is a video
    per_frame_progress_token: the state of an image is that of a progress token behind it
    frame_pooling: pools an image's tokens to its state, without progress tokens; boundary: takes the last token
    pooling_temperature: temperature of attention pooling
    average_temporal_patches: in video mode, a temporal patch's tokens are averaged; else the token behind them is read
    progress_in_preference: prompts for preference also ask for progress
    size_px: for videos: height and width to which every frame is resized first; null: each frame keeps its own
    trained_frames: most frames of a trajectory in training, by default also of clients; None: unknown
    """

    multi_image: bool
    per_frame_progress_token: bool
    frame_pooling: Pooling
    pooling_temperature: float
    average_temporal_patches: bool
    progress_bins: int
    has_similarity: bool
    progress_in_preference: bool
    size_px: tuple[int, int] | None
    base_model_id: str
    trained_frames: int | None = None
    has_preference: bool = True
    has_success: bool = True

    @property
    def pools_images(self) -> bool:
        """True if an image's tokens are pooled by ``frame_pooling``, which upstream uses only for images."""
        return self.multi_image and not self.per_frame_progress_token

    @property
    def pools_by_attention(self) -> bool:
        """True if the attention of frame_pool_attn weighs an image's tokens."""
        return self.pools_images and self.frame_pooling == "attention"


@dataclass(frozen=True)
class VlmOutput:
    """Logits: progress [F, K], success [F], preference and similarity [Q]; None without that head.

    made: features from the vision tower, [merged tokens, levels, D]; None: all shots are cached
    """

    progress: Tensor
    success: Tensor | None
    preference: Tensor | None
    similarity: Tensor | None
    made: Tensor | None = None


class VlmRewardModel(nn.Module):
    """Backbone and heads, with upstream's names of the heads."""

    graphs: Graphs | None = None

    def __init__(self, config: VlmConfig, backbone: nn.Module) -> None:
        super().__init__()
        self.config = config
        self.model = backbone
        width = config.hidden_dim
        self.progress_head = PredictionHead(width, config.progress_bins)
        if config.has_success:
            self.success_head = PredictionHead(width, 1)
        if config.has_preference:
            self.preference_head = PredictionHead(width, 1)
        if config.has_similarity:
            self.similarity_head = PredictionHead(width, 1)
        self.frame_pool_attn = nn.Linear(width, 1, bias=False)

    def forward(self, batch: VlmBatch) -> VlmOutput:
        """Return the logits of every frame and query in the batch, which is on the network's device."""
        hidden, made = qwen_states(self.model, batch, graphs=self.graphs)
        frames = self._frame_states(hidden, batch.spans, batch.num_span_tokens)
        queries = hidden[batch.query_rows, batch.query_tokens]
        return VlmOutput(
            self.progress_head(frames),
            self.success_head(frames).squeeze(-1) if self.config.has_success else None,
            self.preference_head(queries).squeeze(-1) if self.config.has_preference else None,
            self.similarity_head(queries).squeeze(-1) if self.config.has_similarity else None,
            made,
        )

    def _frame_states(self, hidden: Tensor, spans: Tensor, num_tokens: int) -> Tensor:
        """Return each span's pooled state, [F, D].

        The spans are packed one after the other, [num_tokens, D], so that a long span adds no padding to the others.
        """
        rows, starts, stops = spans.unbind(dim=1)
        lengths = stops - starts
        span = torch.arange(len(spans), device=spans.device).repeat_interleave(lengths, output_size=num_tokens)
        offset = torch.arange(num_tokens, device=spans.device) - (lengths.cumsum(0) - lengths)[span]
        states = hidden[rows[span], starts[span] + offset]
        if self.config.pools_by_attention:
            scores = self.frame_pool_attn(states).squeeze(-1) / self.config.pooling_temperature
            states = states * _softmax_of_each(scores, lengths, span).unsqueeze(-1)
            return _of_each("sum", states.float(), lengths).to(hidden.dtype)
        return (_of_each("sum", states.float(), lengths) / lengths[:, None]).to(hidden.dtype)


def qwen_states(
    backbone: Any, batch: VlmBatch, key_values: KeyValues | None = None, graphs: Graphs | None = None
) -> tuple[Tensor, Tensor | None]:
    """Return a Qwen backbone's last hidden states, and the features that its vision tower computed.

    The states have the shape [B, L, D], or [1, all tokens, D] for a batch with packs.

    key_values: receives the keys and values of all tokens, for ``next_hidden_state``
    graphs: for small batches; the language model uses none if ``key_values`` is given
    """
    made = None
    if batch.plan is not None:
        of_tower = backbone.visual, batch.inputs["pixel_values"], batch.plan
        made = features(*of_tower) if graphs is None else graphed_features(graphs, *of_tower)
    assert batch.layout is not None
    shots = [*([] if made is None else [made]), *batch.layout.kept.values()]
    merged = concatenated(shots)
    if batch.packs:
        return tree_hidden_states(backbone.language_model, batch.inputs, batch.packs, merged), made
    if graphs is not None and key_values is None:
        return graphed_hidden_state(graphs, backbone.language_model, batch.inputs, merged), made
    return last_hidden_state(backbone.language_model, batch.inputs, merged, key_values), made


def _of_each(reduction: str, values: Tensor, lengths: Tensor) -> Tensor:
    """Return the sum or maximum of each segment, float32 [N, ...] -> [F, ...]."""
    # unsafe: without a check of the lengths, for which the host would wait
    return torch.segment_reduce(values, reduction, lengths=lengths, axis=0, unsafe=True)


def _softmax_of_each(scores: Tensor, lengths: Tensor, segment: Tensor) -> Tensor:
    """Return the softmax within segments, [N] -> [N], computed in float32; ``segment``: index for each value."""
    largest = _of_each("max", scores.float(), lengths)
    weights = (scores.float() - largest[segment]).exp()
    return (weights / _of_each("sum", weights, lengths)[segment]).to(scores.dtype)


def build_backbone(config: BackboneConfig, dtype: torch.dtype) -> nn.Module:
    """Return the backbone with uninitialised weights in ``dtype``; buffers keep their own dtype."""
    try:
        import transformers
    except ImportError as error:
        raise ImportError('vision-language checkpoints need transformers: pip install ".[vlm]"') from error
    network = getattr(transformers, BACKBONES[config.family])
    settings = network.config_class.from_dict(config.backbone)
    with _no_init_weights():
        backbone: nn.Module = network._from_config(settings, dtype=dtype, attn_implementation="sdpa")
    check_attention(backbone)
    return backbone


def _no_init_weights() -> AbstractContextManager[None]:
    """Return transformers' switch, which moved between its major versions."""
    try:
        from transformers.initialization import no_init_weights
    except ImportError:
        from transformers.modeling_utils import no_init_weights
    return no_init_weights()
