# SPDX-License-Identifier: MIT
"""The ReWiND transformer: frame and text embeddings in; progress, success, preference, similarity out.

B rows, T frames of a trajectory, L tokens, D width, K progress bins (1: continuous progress).

A row is the token sequence ``[text] [first trajectory] ([second trajectory] [query])``. The order of frames
is known through the causal mask, the embedding added to each trajectory's first frame and, where the
checkpoint has them, a progress token behind each frame; there is no other positional encoding.
Architecture: ReWiND (https://arxiv.org/abs/2505.10911) as in the public implementation ``reward_fm``.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rfm.models.heads import PredictionHead
from rfm.models.linear import Linear, linear

FEED_FORWARD_RATIO = 4


@dataclass(frozen=True)
class RewindConfig:
    """What a checkpoint's network looks like; field names as in upstream's config.json where it has them.

    trained_frames: the most frames of a trajectory in training; None: the checkpoint does not say
    """

    video_feature_dim: int
    text_feature_dim: int
    hidden_dim: int
    num_layers: int
    num_attention_heads: int
    max_len: int
    causal_mask: bool
    use_per_frame_progress_token: bool
    progress_bins: int
    has_similarity: bool
    trained_frames: int | None = None

    @property
    def max_frames(self) -> int | None:
        """The longest trajectory the network can take; None: any length."""
        return self.max_len if self.use_per_frame_progress_token else None

    @property
    def tokens_per_frame(self) -> int:
        """Tokens that one frame adds to a row."""
        return 2 if self.use_per_frame_progress_token else 1

    def num_tokens(self, num_first: int, num_second: int) -> int:
        """L of a row of two trajectories of so many frames; num_second = 0: of one trajectory."""
        query = 1 if num_second else 0
        return 1 + self.tokens_per_frame * (num_first + num_second) + query


@dataclass(frozen=True)
class RewindBatch:
    """Rows of one kind, padded to their longest.

    text: float32 [B, Dt]
    first, second: float32 [B, T, Dv]; second is None in rows of one trajectory
    token_mask: bool [B, L], false at padding; None when there is none
    is_similarity: bool [B], asks for similarity rather than preference; None in rows of one trajectory
    """

    text: Tensor
    first: Tensor
    second: Tensor | None = None
    token_mask: Tensor | None = None
    is_similarity: Tensor | None = None

    def to(self, device: torch.device) -> RewindBatch:
        """The batch on ``device``."""
        tensors: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        moved: dict[str, Any] = {name: None if t is None else t.to(device) for name, t in tensors.items()}
        return RewindBatch(**moved)


@dataclass(frozen=True)
class RewindOutput:
    """Raw scores of a RewindBatch: progress logits [B, T, K], success logits [B, T], query logits [B]."""

    first_progress: Tensor
    first_success: Tensor
    second_progress: Tensor | None = None
    second_success: Tensor | None = None
    query: Tensor | None = None


class SelfAttention(nn.Module):
    """Multi-head attention of some tokens [B, Q, D] to all of their row [B, L, D], and the tokens themselves added.

    Parameters are named as nn.MultiheadAttention's.
    """

    def __init__(self, hidden_dim: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.in_proj_weight = nn.Parameter(torch.empty(3 * hidden_dim, hidden_dim))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * hidden_dim))
        self.out_proj = Linear(hidden_dim, hidden_dim)
        nn.init.xavier_uniform_(self.in_proj_weight)

    def forward(self, asking: Tensor, x: Tensor, mask: Tensor | None) -> Tensor:
        queries, keys, values = (
            part.unflatten(-1, (self.num_heads, -1)).transpose(1, 2) for part in self._projected(asking, x)
        )
        attended = F.scaled_dot_product_attention(queries, keys, values, attn_mask=mask)
        return linear(attended.transpose(1, 2).flatten(2), self.out_proj.weight, self.out_proj.bias, plus=asking)

    def _projected(self, asking: Tensor, x: Tensor) -> tuple[Tensor, ...]:
        weight, bias, width = self.in_proj_weight, self.in_proj_bias, x.shape[-1]
        if asking is x:
            return linear(x, weight, bias).chunk(3, dim=-1)
        queries = linear(asking, weight[:width], bias[:width])
        return (queries, *linear(x, weight[width:], bias[width:]).chunk(2, dim=-1))


class EncoderLayer(nn.Module):
    """Post-norm transformer layer with a ReLU feed-forward; parameters named as nn.TransformerEncoderLayer's."""

    def __init__(self, hidden_dim: int, num_heads: int) -> None:
        super().__init__()
        self.self_attn = SelfAttention(hidden_dim, num_heads)
        self.norm1 = nn.LayerNorm(hidden_dim)
        self.linear1 = Linear(hidden_dim, FEED_FORWARD_RATIO * hidden_dim)
        self.linear2 = Linear(FEED_FORWARD_RATIO * hidden_dim, hidden_dim)
        self.norm2 = nn.LayerNorm(hidden_dim)

    def forward(self, asking: Tensor, x: Tensor, mask: Tensor | None) -> Tensor:
        asking = self.norm1(self.self_attn(asking, x, mask))
        grown = linear(asking, self.linear1.weight, self.linear1.bias, relu=True)
        return self.norm2(linear(grown, self.linear2.weight, self.linear2.bias, plus=asking))


class Encoder(nn.Module):
    """A stack of EncoderLayer, the last of which is computed for those tokens alone that are read."""

    def __init__(self, config: RewindConfig) -> None:
        super().__init__()
        layer = (config.hidden_dim, config.num_attention_heads)
        self.layers = nn.ModuleList(EncoderLayer(*layer) for _ in range(config.num_layers))

    def forward(self, x: Tensor, mask: Tensor | None, read: Tensor) -> Tensor:
        """[B, L, D] -> [B, R, D], the tokens at the positions ``read``, int64 [R]."""
        for layer in self.layers[:-1]:
            x = layer(x, x, mask)
        mask_of_read = mask if mask is None or mask.shape[-2] == 1 else mask[..., read, :]
        return self.layers[-1](x[:, read], x, mask_of_read)


class RewindTransformer(nn.Module):
    """The network; its state dict has upstream's names."""

    def __init__(self, config: RewindConfig) -> None:
        super().__init__()
        self.config = config
        width = config.hidden_dim
        self.video_proj = Linear(config.video_feature_dim, width)
        self.text_proj = Linear(config.text_feature_dim, width)
        self.first_embedding_A = nn.Parameter(torch.randn(1, 1, width))
        self.first_embedding_B = nn.Parameter(torch.randn(1, 1, width))
        if config.use_per_frame_progress_token:
            self.text_position_embedding = nn.Parameter(torch.randn(1, 1, width))
            self.prog_token_A = nn.Parameter(torch.randn(1, config.max_len, width))
            self.prog_token_B = nn.Parameter(torch.randn(1, config.max_len, width))
        self.transformer = Encoder(config)
        self.progress_head = PredictionHead(width, config.progress_bins)
        self.success_head = PredictionHead(width, 1)
        self.preference_token = nn.Parameter(torch.randn(1, 1, width))
        self.preference_head = PredictionHead(width, 1)
        if config.has_similarity:
            self.similarity_token = nn.Parameter(torch.randn(1, 1, width))
            self.similarity_head = PredictionHead(width, 1)

    def forward(self, batch: RewindBatch) -> RewindOutput:
        """Raw scores; those at padding positions mean nothing."""
        text = self.text_proj(batch.text).unsqueeze(1)
        if self.config.use_per_frame_progress_token:
            text = text + self.text_position_embedding
        tokens = [text, self._trajectory_tokens(batch.first, second=False)]
        if batch.second is not None:
            tokens += [self._trajectory_tokens(batch.second, second=True), self._query_tokens(batch)]
        x = torch.cat(tokens, dim=1)
        num_frames = [video.shape[1] for video in (batch.first, batch.second) if video is not None]
        read = self._read_positions(sum(num_frames), x)
        hidden = self.transformer(x, self._attention_mask(batch, x.shape[1]), read)

        parts = hidden.split([*num_frames, len(read) - sum(num_frames)], dim=1)
        first_progress, first_success = self._frame_scores(parts[0])
        if batch.second is None:
            return RewindOutput(first_progress, first_success)
        second_progress, second_success = self._frame_scores(parts[1])
        query = self._query_scores(parts[2].squeeze(1), batch)
        return RewindOutput(first_progress, first_success, second_progress, second_success, query)

    def _trajectory_tokens(self, video: Tensor, *, second: bool) -> Tensor:
        """[B, T, Dv] -> [B, T, D], or [B, 2T, D] with a progress token behind each frame."""
        frames = self.video_proj(video)
        frames[:, :1] += self.first_embedding_B if second else self.first_embedding_A
        if not self.config.use_per_frame_progress_token:
            return frames
        progress_tokens = self.prog_token_B if second else self.prog_token_A
        interleaved = torch.stack([frames, progress_tokens[:, : video.shape[1]].expand_as(frames)], dim=2)
        return interleaved.flatten(1, 2)

    def _query_tokens(self, batch: RewindBatch) -> Tensor:
        """[B, 1, D]: the token whose output answers the row's question."""
        if not self.config.has_similarity:
            return self.preference_token.expand(len(batch.text), -1, -1)
        assert batch.is_similarity is not None
        return torch.where(batch.is_similarity[:, None, None], self.similarity_token, self.preference_token)

    def _query_scores(self, hidden: Tensor, batch: RewindBatch) -> Tensor:
        """[B] logits of the query tokens' [B, D]."""
        preference = self.preference_head(hidden).squeeze(-1)
        if not self.config.has_similarity:
            return preference
        assert batch.is_similarity is not None
        return torch.where(batch.is_similarity, self.similarity_head(hidden).squeeze(-1), preference)

    def _frame_scores(self, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Progress [B, T, K] and success [B, T] logits from the tokens that carry the frames' states, [B, T, D]."""
        return self.progress_head(hidden), self.success_head(hidden).squeeze(-1)

    def _read_positions(self, num_frames: int, x: Tensor) -> Tensor:
        """int64, the tokens of [B, L, D] whose outputs are read: the last of each frame's, and the query."""
        step = self.config.tokens_per_frame
        positions = torch.arange(num_frames, device=x.device) * step + step
        has_query = x.shape[1] > 1 + num_frames * step
        return F.pad(positions, (0, 1), value=x.shape[1] - 1) if has_query else positions

    def _attention_mask(self, batch: RewindBatch, length: int) -> Tensor | None:
        """bool, broadcastable to [B, heads, L, L], true where a token may look; None: everywhere.

        Padding is never looked at, so a row's scores are those it has alone.
        """
        keys = None if batch.token_mask is None else batch.token_mask[:, None, None, :]
        if not self.config.causal_mask:
            return keys
        causal = torch.ones(length, length, dtype=torch.bool, device=batch.text.device).tril()
        return causal if keys is None else causal & keys
