# SPDX-License-Identifier: MIT
"""Reward heads on a vision-language backbone from ``transformers``: RFM and Robometer checkpoints.

F frames (in video mode: temporal patches) and Q queries in all rows, L tokens, width D, K progress bins.
The heads read the last hidden states, behind the final norm: for a frame, pooled over a token span; for a query,
at its token.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import torch
from torch import Tensor, nn

from rfm.engine.graphs import Graphs
from rfm.engine.layers import PredictionHead
from rfm.qwen.batch import VlmBatch
from rfm.qwen.network import BackboneConfig, qwen_states

Pooling: TypeAlias = Literal["mean", "boundary", "attention"]


@dataclass(frozen=True)
class VlmConfig(BackboneConfig):
    """The configuration of a checkpoint's network and prompts.

    multi_image: each frame is an image; else a trajectory is a video
    per_frame_progress_token: an image's state is that of a progress token behind it
    frame_pooling: how an image's tokens become its state without progress tokens; boundary: the last token
    pooling_temperature: temperature of attention pooling
    average_temporal_patches: in video mode, averages a temporal patch's tokens; else reads the token behind them
    progress_in_preference: prompts for preference also ask for progress
    size_px: for videos: height and width of resized frames; null: each keeps its own
    trained_frames: most frames of a trajectory in training, and clients' default
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
        """True if ``frame_pooling`` pools an image's tokens; upstream uses it only for images."""
        return self.multi_image and not self.per_frame_progress_token

    @property
    def pools_by_attention(self) -> bool:
        """True if frame_pool_attn's attention weighs an image's tokens."""
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
    """Backbone and heads, with upstream's head names."""

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
        """Return the logits for every frame and query in a batch on the network's device."""
        hidden, made = qwen_states(self.model, batch, graphs=self.graphs)
        frames = self._frame_states(hidden, batch.spans, batch.num_span_tokens)
        queries = hidden[batch.queries]
        return VlmOutput(
            self.progress_head(frames),
            self.success_head(frames).squeeze(-1) if self.config.has_success else None,
            self.preference_head(queries).squeeze(-1) if self.config.has_preference else None,
            self.similarity_head(queries).squeeze(-1) if self.config.has_similarity else None,
            made,
        )

    def _frame_states(self, hidden: Tensor, spans: Tensor, num_tokens: int) -> Tensor:
        """Return the pooled state per span, [F, D].

        Spans are packed one after the other, [num_tokens, D], so that a long span adds no padding to the others.
        """
        starts, stops = spans.unbind(dim=1)
        lengths = stops - starts
        span = torch.arange(len(spans), device=spans.device).repeat_interleave(lengths, output_size=num_tokens)
        offset = torch.arange(num_tokens, device=spans.device) - (lengths.cumsum(0) - lengths)[span]
        states = hidden[starts[span] + offset]
        if self.config.pools_by_attention:
            scores = self.frame_pool_attn(states).squeeze(-1) / self.config.pooling_temperature
            states = states * _softmax_of_each(scores, lengths, span).unsqueeze(-1)
            return _of_each("sum", states.float(), lengths).to(hidden.dtype)
        return (_of_each("sum", states.float(), lengths) / lengths[:, None]).to(hidden.dtype)


def _of_each(reduction: str, values: Tensor, lengths: Tensor) -> Tensor:
    """Return the sum or maximum per segment, float32 [N, ...] -> [F, ...]."""
    # unsafe: skips the length check, for which the host would wait
    return torch.segment_reduce(values, reduction, lengths=lengths, axis=0, unsafe=True)


def _softmax_of_each(scores: Tensor, lengths: Tensor, segment: Tensor) -> Tensor:
    """Return the softmax within segments, [N] -> [N], computed in float32; ``segment``: segment index per value."""
    largest = _of_each("max", scores.float(), lengths)
    weights = (scores.float() - largest[segment]).exp()
    return (weights / _of_each("sum", weights, lengths)[segment]).to(scores.dtype)
